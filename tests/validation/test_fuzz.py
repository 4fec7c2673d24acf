"""Damaged files by the thousand: no exception, no hang, no blow-up, nothing read elsewhere.

``CHRONOSCENE_FUZZ_SECONDS`` is the time for all of it (default 16), ``CHRONOSCENE_FUZZ_SEED`` the
first seed; a failure names the seed of its case.
"""

import os
import random
import resource
import shutil
import struct
import sys
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from chronoscene.colmap.model import read_raw_model
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import read_scene
from chronoscene.validation.checks.pixels import read_header, read_pixels_of
from chronoscene.validation.repair.fix import fix_scene
from chronoscene.validation.run import validate_scene

pytestmark = [  # Pillow's, on damaged files
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning"),
]

SECONDS = float(os.environ.get("CHRONOSCENE_FUZZ_SECONDS", "16"))
SEED = int(os.environ.get("CHRONOSCENE_FUZZ_SEED", "0"))

SLOWEST = 10.0
"""Seconds of computing for one case; a good one takes a thousandth."""

MEMORY = 1_000_000
"""Kilobytes by which the process may grow."""

NUMBERS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (float("nan"), float("inf"), -1e308, 1e308, 5e-324, 0.0, -0.0, 1e17)
WORDS = (
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"99999999999999999999",
    b"../../outside/secret.png",
    b"\0",
)

TEXTS = ("sparse/split.txt", "sparse/0/test.txt", "sparse/periods.json", "sparse/world.json")

opened: list[str] = []
"""Paths below ``outside`` that were opened."""


def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], str | bytes):
        name = os.fsdecode(arguments[0])
        if os.sep + "outside" + os.sep in name:
            opened.append(name)


sys.addaudithook(watch)


def mutate(rng, data):
    """A few random changes of some bytes."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 5, 20])):
        if not data:
            return rng.randbytes(rng.randrange(40))
        at = rng.randrange(len(data))
        kind = rng.randrange(9)
        if kind == 0:
            data[at] = rng.randrange(256)
        elif kind == 1:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            del data[at : at + rng.randrange(1, 64)]
        elif kind == 4:
            data[at:at] = rng.randbytes(rng.randrange(1, 64))
        elif kind == 5:
            data[at : at + 8] = struct.pack("<Q", rng.choice(NUMBERS))
        elif kind == 6:
            data[at : at + 8] = struct.pack("<d", rng.choice(FLOATS))
        elif kind == 7:
            data[at:at] = data[rng.randrange(len(data)) :][: rng.randrange(1, 200)]
        else:
            words = bytes(data).split(b" ")
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            data = bytearray(b" ".join(words))
    return bytes(data)


def check(root, case, *, decode=False):
    """What must hold for any scene."""
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report = validate_scene(root, decode=decode)
    assert "CS000" not in {f.code for f in report.findings}, (case, report.findings)
    try:
        read_scene(root)
    except ChronoSceneError as error:
        assert "Traceback" not in str(error)
        assert report.count("error"), (case, str(error))
    assert time.process_time() - began < SLOWEST, case
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY, case
    assert not opened, (case, opened)


def many_cases(seconds, run):
    """Run cases, each with its own random numbers, until the time is over; name one that fails."""
    end, seed = time.monotonic() + seconds, SEED
    while time.monotonic() < end or seed < SEED + 20:
        try:
            run(random.Random(seed))
        except BaseException as error:
            error.add_note(f"CHRONOSCENE_FUZZ_SEED={seed}")
            raise
        seed += 1
    print(f"{seed - SEED} cases")  # shown by pytest -rP


def run_cases(root, files, seconds, *, decode=False):
    """Damage one or two files at a time until the time is over."""

    def run(rng):
        chosen = rng.sample(files, min(len(files), rng.choice([1, 1, 2])))
        good = {path: path.read_bytes() for path in chosen}
        damaged = {path: mutate(rng, data) for path, data in good.items()}
        try:
            for path, data in damaged.items():
                path.write_bytes(data)
            check(root, damaged, decode=decode)
        finally:
            for path, data in good.items():
                path.write_bytes(data)

    many_cases(seconds, run)


@pytest.fixture
def fuzzed(scene, tmp_path):
    """A good scene with every text file, and a file outside that its names could lead to."""
    (tmp_path / "outside").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "outside/secret.png")
    scene.write("sparse/periods.json", '[{"id": 0, "date": "2016"}, {"id": 1, "label": "b"}]')
    scene.write("sparse/world.json", '{"unit": "metre", "offset": [0, 0, 0]}')
    opened.clear()
    return scene


@pytest.mark.parametrize("form", ["binary", "rigs", "text"])
def test_models(fuzzed, form):
    if form != "text":
        fuzzed.to_binary(classic=form == "binary")
    files = sorted(p for p in fuzzed.path("sparse/0").iterdir() if p.name != "test.txt")
    run_cases(fuzzed.root, files, SECONDS / 8)


@pytest.mark.parametrize("form", [".bin", ".txt"])
def test_readers_alone(fuzzed, form):
    """Many more cases than whole scenes allow: only the files of the model are read."""
    if form == ".bin":
        fuzzed.to_binary(classic=False)
    folder = fuzzed.path("sparse/0")
    good = {path: path.read_bytes() for path in sorted(folder.glob(f"*{form}"))}

    def read(rng):
        path = rng.choice(list(good))
        path.write_bytes(mutate(rng, good[path]))
        model = read_raw_model(folder)
        for part, kind in ((model.images, "images"), (model.points, "points3D")):
            assert part is not None or kind in "".join(d.file for d in model.damages)
        path.write_bytes(good[path])

    many_cases(SECONDS / 10, read)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp", "gif", "bmp"])
def test_headers_alone(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.effect_noise((40, 30), 50).convert("RGB").save(path)
    good = path.read_bytes()

    def read(rng):
        path.write_bytes(mutate(rng, good))
        header = read_header(path)
        assert header.problem or min(header.size) > 0
        read_pixels_of(path)

    many_cases(SECONDS / 60, read)


def test_texts(fuzzed):
    run_cases(fuzzed.root, [fuzzed.path(place) for place in TEXTS], SECONDS / 8)


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
    run_cases(fuzzed.root, files, SECONDS / 20, decode=True)


def test_announced_amounts_are_not_allocated(fuzzed):
    fuzzed.to_binary(classic=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for stem in ("cameras", "images", "points3D", "rigs", "frames"):
        path = fuzzed.path(f"sparse/0/{stem}.bin")
        good = path.read_bytes()
        for number in (10**6, 10**12, 2**63, 2**64 - 1):
            path.write_bytes(struct.pack("<Q", number) + good[8:])
            check(fuzzed.root, (stem, number))
        path.write_bytes(good)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


NAMES = st.one_of(
    st.sampled_from(["a000.png", "a001", "../../outside/secret.png", "/etc/passwd", "C:\\a.png"]),
    st.text(max_size=30),
)


@settings(max_examples=int(10 * SECONDS), suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(NAMES, st.one_of(st.integers(), st.text(max_size=5)))), st.lists(NAMES))
def test_any_split_and_test_list(fuzzed, lines, tests):
    split = "\n".join(f"{name} {period}" for name, period in lines)
    fuzzed.write("sparse/split.txt", split.encode("utf-8", "surrogatepass"))
    fuzzed.write("sparse/0/test.txt", "\n".join(tests).encode("utf-8", "surrogatepass"))
    check(fuzzed.root, (split, tests))


def test_corrections_of_damaged_scenes(fuzzed, tmp_path):
    """A corrected copy of anything can be made and checked."""
    fuzzed.to_binary()
    files = sorted(p for p in fuzzed.path("sparse").rglob("*") if p.is_file())

    def run(rng):
        path = rng.choice(files)
        good = path.read_bytes()
        path.write_bytes(mutate(rng, good))
        shutil.rmtree(out := tmp_path / "fixed", ignore_errors=True)
        repairs = fix_scene(fuzzed.root, out)
        after = {f.code for f in validate_scene(out).findings}
        assert "CS000" not in after and not {r.code for r in repairs} & after, repairs
        path.write_bytes(good)

    many_cases(SECONDS / 10, run)
    assert not opened
