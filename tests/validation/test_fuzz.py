"""Damaged files by the thousand: no exception, no hang, no blow-up, nothing read elsewhere."""

import resource
import shutil
import struct

import pytest
from fuzzing import damage_bytes, damaged_files, many_cases, opened
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from chronoscene.colmap.model import read_raw_model
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import read_scene
from chronoscene.validation.folder.pixels import read_header, read_pixels_of
from chronoscene.validation.repair.fix import fix_scene
from chronoscene.validation.run import validate_scene

pytestmark = [  # Pillow's, on damaged files
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning"),
]

TEXTS = ("sparse/split.txt", "sparse/0/test.txt", "sparse/periods.json", "sparse/world.json")


def check(root, *, decode=False):
    """What must hold for any scene."""
    report = validate_scene(root, decode=decode)
    assert "CS000" not in {f.code for f in report.findings}, report.findings
    try:
        read_scene(root)
    except ChronoSceneError as error:
        assert "Traceback" not in str(error)
        assert report.count("error"), str(error)


def check_damaged(root, files, count, *, decode=False):
    """Check a scene again and again, with one or two of its files damaged."""

    def run(rng):
        with damaged_files(rng, files, lambda rng, _, data: damage_bytes(rng, data)):
            check(root, decode=decode)

    many_cases(count, run)


@pytest.fixture
def fuzzed(scene, tmp_path):
    """A good scene with every text file, and a file outside that its names could lead to."""
    (tmp_path / "outside").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "outside/secret.png")
    scene.write("sparse/periods.json", '[{"id": 0, "date": "2016"}, {"id": 1, "label": "b"}]')
    scene.write("sparse/world.json", '{"unit": "metre", "offset": [0, 0, 0]}')
    return scene


@pytest.mark.parametrize("form", ["binary", "rigs", "text"])
def test_models(fuzzed, form):
    if form != "text":
        fuzzed.to_binary(classic=form == "binary")
    files = sorted(p for p in fuzzed.path("sparse/0").iterdir() if p.name != "test.txt")
    check_damaged(fuzzed.root, files, 25)


@pytest.mark.parametrize("form", [".bin", ".txt"])
def test_readers_alone(fuzzed, form):
    """Many more cases than whole scenes allow: only the files of the model are read."""
    if form == ".bin":
        fuzzed.to_binary(classic=False)
    folder = fuzzed.path("sparse/0")
    good = {path: path.read_bytes() for path in sorted(folder.glob(f"*{form}"))}

    def read(rng):
        path = rng.choice(list(good))
        path.write_bytes(damage_bytes(rng, good[path]))
        model = read_raw_model(folder)
        for part, kind in ((model.images, "images"), (model.points, "points3D")):
            assert part is not None or kind in "".join(d.file for d in model.damages)
        path.write_bytes(good[path])

    many_cases(200, read)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp", "gif", "bmp"])
def test_headers_alone(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.effect_noise((40, 30), 50).convert("RGB").save(path)
    good = path.read_bytes()

    def read(rng):
        path.write_bytes(damage_bytes(rng, good))
        header = read_header(path)
        assert header.problem or min(header.size) > 0
        read_pixels_of(path)

    many_cases(60, read)


def test_texts(fuzzed):
    check_damaged(fuzzed.root, [fuzzed.path(place) for place in TEXTS], 40)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp", "gif"])
def test_images(fuzzed, suffix):
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    exif.get_ifd(0x8769).update({0x9003: "2016:05:03 12:00:00", 0xA405: 28})
    exif.get_ifd(0x8825).update({1: "N", 2: (48, 7, 30.5), 3: "E", 4: (11, 0, 0.5)})
    image = Image.open(fuzzed.path("images/a000.png"))
    options = {} if suffix == "gif" else {"exif": exif}
    fuzzed.save("a000.png", image, as_name=f"a000.{suffix}", **options)
    files = [fuzzed.path(f"images/a000.{suffix}")]
    check_damaged(fuzzed.root, files, 6, decode=True)


def test_announced_amounts_are_not_allocated(fuzzed):
    fuzzed.to_binary(classic=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for stem in ("cameras", "images", "points3D", "rigs", "frames"):
        path = fuzzed.path(f"sparse/0/{stem}.bin")
        good = path.read_bytes()
        for number in (10**6, 10**12, 2**63, 2**64 - 1):
            path.write_bytes(struct.pack("<Q", number) + good[8:])
            check(fuzzed.root)
        path.write_bytes(good)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


NAMES = st.one_of(
    st.sampled_from(["a000.png", "a001", "../../outside/secret.png", "/etc/passwd", "C:\\a.png"]),
    st.text(max_size=30),
)


@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(NAMES, st.one_of(st.integers(), st.text(max_size=5)))), st.lists(NAMES))
def test_any_split_and_test_list(fuzzed, lines, tests):
    split = "\n".join(f"{name} {period}" for name, period in lines)
    fuzzed.write("sparse/split.txt", split.encode("utf-8", "surrogatepass"))
    fuzzed.write("sparse/0/test.txt", "\n".join(tests).encode("utf-8", "surrogatepass"))
    opened.clear()
    check(fuzzed.root)
    assert not opened


def test_corrections_of_damaged_scenes(fuzzed, tmp_path):
    """A corrected copy of anything can be made and checked."""
    fuzzed.to_binary()
    files = sorted(p for p in fuzzed.path("sparse").rglob("*") if p.is_file())

    def run(rng):
        with damaged_files(rng, files, lambda rng, _, data: damage_bytes(rng, data)):
            shutil.rmtree(out := tmp_path / "fixed", ignore_errors=True)
            repairs = fix_scene(fuzzed.root, out)
            after = {f.code for f in validate_scene(out).findings}
            assert "CS000" not in after and not {r.code for r in repairs} & after, repairs

    many_cases(25, run)
