"""Damaged scenes of every format by the thousand: our errors or a result, and nothing else.

Each case damages one or two files of a good scene, then reads, converts and sometimes undistorts
it.
"""

import copy
import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from fuzzing import FLOATS, WORDS, damage_bytes, damaged_files, many_cases
from PIL import Image

from chronoscene.colmap.model import PosedImage
from chronoscene.convert import convert
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import FORMATS, detect, read_scene, writable_formats
from chronoscene.formats.chronoscene import check_image
from chronoscene.formats.shared.ply import read_points
from chronoscene.images.exif import capture_times
from chronoscene.images.undistortion import CameraChange, move_pixels, pinhole_camera, sampling_map
from chronoscene.scene import Camera
from chronoscene.scene.cameras import CAMERA_MODELS, MODEL_NAMES
from chronoscene.scene.split_making import SplitSettings, make_split
from chronoscene.undistort import undistort

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, on damaged files

VALUES = (
    None, True, -1, 0, 2**70, 1.5, float("nan"), float("inf"), "", "../../outside/secret.png",
    "/etc/passwd", "C:\\x.png", "a\0b", "\ud800", "x" * 5000, "a/" * 2000, [], [[]], {}, "images",
    [[0] * 4] * 4, [[1e200] * 4] * 4, ["../outside/secret.png"], "points.ply", "transforms.json",
)  # fmt: skip
"""What may stand anywhere in a JSON file."""


def damage_words(rng, data):
    """Some words of a text replaced, dropped or repeated, or those of a line."""
    separator = rng.choice([b" ", b"\n", b","])
    words = data.split(separator)
    for _ in range(rng.choice([1, 1, 2, 5])):
        at = rng.randrange(len(words))
        words[at : at + rng.randrange(2)] = rng.choice([[rng.choice(WORDS)], [words[at]] * 2, []])
        words = words or [b""]
    return separator.join(words)


def damage_json(rng, data):
    """Some values, or names of keys, replaced."""
    document = json.loads(data)
    for _ in range(rng.choice([1, 1, 2, 5])):
        inner = document
        while True:
            key = rng.choice(list(inner) if isinstance(inner, dict) else range(len(inner)))
            if rng.random() < 0.3 or not isinstance(inner[key], dict | list) or not inner[key]:
                break
            inner = inner[key]
        change = rng.randrange(4)
        if change == 0:
            del inner[key]
        elif change == 1 and isinstance(inner, list):
            inner.insert(0, copy.deepcopy(inner[key]))
        else:
            inner[key] = copy.deepcopy(rng.choice(VALUES))
        if not document:
            break
    return json.dumps(document).encode()


def damage(rng, path, data):
    """Another content of a file, damaged in a way that suits its kind."""
    kind = rng.random()
    if path.suffix == ".json" and kind < 0.7:
        return damage_json(rng, data)
    if path.suffix in (".txt", ".json") and kind < 0.9:
        return damage_words(rng, data)
    return damage_bytes(rng, data)


@pytest.fixture
def run_damaged(tmp_path):
    """Factory of a loop over damaged files of a folder, each of which a function is to survive."""
    (tmp_path / "outside").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "outside/secret.png")

    def loop(files, count, survive):
        refused = 0

        def run(rng):
            nonlocal refused
            try:
                with damaged_files(rng, files, damage):
                    survive(rng)
            except ChronoSceneError as error:
                assert "Traceback" not in str(error) and "\n" not in str(error)
                assert all((error.place, error.expected, error.found, error.todo))
                assert len(error.found) < 2000 and len(error.expected) < 2000
                refused += 1

        many_cases(count, run)
        assert refused

    return loop


def times_of(scene):
    return capture_times(scene.images_root, [f.name for f in scene.frames])


def use(rng, folder, name, out):
    """What a user may do with a scene; whatever is written has to be in ``out``."""
    shutil.rmtree(out, ignore_errors=True)
    beside = sorted(folder.parent.iterdir())
    try:
        if rng.random() < 0.2:
            detect(folder)
        scene = read_scene(folder, format=name)
        strategy = rng.choice(["stratified", "blocked", "date"])
        try:
            make_split(scene, SplitSettings(strategy), times_of(scene))
        except ChronoSceneError as error:
            assert "\n" not in str(error)
        if rng.random() < 0.2:
            undistort(scene, out, center=rng.random() < 0.5, threads=1)
            read_again(out, "chronoscene")
        else:
            source = rng.choice(["copy", "link", "symlink", "none"])
            target = rng.choice(writable_formats())
            convert(folder, out, source_format=name, target=target, image_source=source)
            if target != "nerfstudio" or source != "none":  # it leaves frames without image out
                read_again(out, target)
    finally:
        assert {p for p in folder.parent.iterdir() if p != out} == {p for p in beside if p != out}


def read_again(out, name):
    """What we write we can read."""
    try:
        read_scene(out, format=name)
    except ChronoSceneError as error:
        raise AssertionError(f"{name} was written and is refused: {error}") from error


def damageable(folder):
    """All files but images, of which one is enough."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and "cam_dict" not in p.name)
    images = [p for p in files if p.suffix == ".png"]
    return [p for p in files if p.suffix != ".png"] + images[:1]


@pytest.fixture
def variants(builders, colmap_folder, level, tmp_path):
    """Scenes of every format, as text and with all optional files; by name and format."""

    def of_text():
        names = [f"{task}/{i}.png" for task in ("t1", "t2") for i in range(3)]
        return colmap_folder(names, name="text", form="text", tests=["t1/0.png"])

    def of_level():
        root = level()
        data = json.loads((root / "add/transforms_train.json").read_text())
        for file, frames in (("test", data["frames"][:1]), ("train", data["frames"][1:])):
            text = json.dumps(data | {"frames": frames})
            (root / f"add/transforms_{file}.json").write_text(text)
        return root

    def of_studio():
        root = builders["nerfstudio"]()
        data = json.loads((root / "transforms.json").read_text())
        data |= {
            "applied_scale": 2.0,
            "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        }
        data |= {"world": {"unit": "metre"}, "periods": [{"id": 0}, {"id": 1, "label": "b"}]}
        data |= {"train_filenames": [f["file_path"] for f in data["frames"][1:]]}
        data |= {"test_filenames": [data["frames"][0]["file_path"]], "k1": 0.01}
        for i, frame in enumerate(data["frames"]):
            frame |= {"colmap_im_id": i + 1, "time": frame["period"] / 2, "mask_path": "m.png"}
        (root / "transforms.json").write_text(json.dumps(data))
        Image.new("L", (64, 48), 255).save(root / "m.png")
        return root

    def of_pointz():
        root = builders["neusc"]()
        names = "\n".join(sorted(p.name for p in (root / "dense/images").iterdir()))
        (root / "annots/train.txt").write_text(names)
        (root / "trash.txt").write_text(names.splitlines()[3])
        return root

    def of_city():
        root = builders["matrixcity"]()
        data = json.loads((root / "before/block_A/transforms.json").read_text())
        for frame in data["frames"]:
            frame["file_path"] = f"../../before/block_A/{frame.pop('frame_index'):04d}.png"
            pose = frame["transform_matrix"] = frame.pop("rot_mat")
            pose[:3] = [[x * 100 for x in row[:3]] + [row[3]] for row in pose[:3]]
        shutil.rmtree(root / "after")
        (root / "before/block_A/transforms.json").unlink()
        for part in ("train", "test"):
            folder = root / "pose" / "block_A"
            folder.mkdir(parents=True, exist_ok=True)
            chosen = data["frames"][1:] if part == "train" else data["frames"][:1]
            (folder / f"transforms_{part}.json").write_text(json.dumps(data | {"frames": chosen}))
        return root

    return {
        **{name: (name, make) for name, make in builders.items()},
        "text": ("colmap-folders", of_text),
        "level": ("cl-splats", of_level),
        "nerfstudio": ("nerfstudio", of_studio),
        "neusc": ("neusc", of_pointz),
        "prepared": ("matrixcity", of_city),
    }


VARIANTS = (*sorted(FORMATS), "text", "level", "prepared")


@pytest.mark.parametrize("variant", VARIANTS)
def test_damaged_scenes(variants, run_damaged, tmp_path, variant):
    name, make = variants[variant]
    folder = make()
    out = tmp_path / "out"
    use(random.Random(0), folder, name, out)  # it is good
    run_damaged(damageable(folder), 30, lambda rng: use(rng, folder, name, out))
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".bmp"])
def test_damaged_images_are_undistorted_or_refused(colmap_folder, run_damaged, tmp_path, suffix):
    folder = colmap_folder(["a/0.png", "b/0.png"], form="text")
    (folder / "sparse/0/cameras.txt").write_text("1 OPENCV 64 48 50 52 30 25.5 0.1 0 0 0\n")
    images = folder / "sparse/0/images.txt"
    images.write_text(images.read_text().replace(".png", suffix))
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    exif.get_ifd(0x8769).update({0x9003: "2016:05:03 12:00:00", 0xA405: 28})
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 7.0, 30.5)})
    exif[0x8769] = exif[0x8825] = 0  # where the blocks are; Pillow fills it in
    files = []  # plain ones are small, so that their heads are hit
    for path in sorted((folder / "images").rglob("*.png")):
        files.append(path.with_suffix(suffix))
        Image.new("RGB", (64, 48), "red").save(files[-1], exif=exif)
    scene = read_scene(folder)

    def survive(rng):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        make_split(scene, SplitSettings("date"), times_of(scene))
        undistort(scene, tmp_path / "out", center=rng.random() < 0.5, threads=1)
        again = read_scene(tmp_path / "out")
        make_split(again, SplitSettings("date"), times_of(again))

    run_damaged(files, 50, survive)


def test_any_camera_is_undistorted_or_refused(run_damaged):
    def survive(rng):
        name = MODEL_NAMES[rng.randrange(len(MODEL_NAMES))]
        size = rng.choice([(64, 48), (1, 1), (640, 480), (1, 5000)])
        params = [rng.gauss(0, 0.1) for _ in CAMERA_MODELS[name].params]
        if rng.random() < 0.8 and len(params) > 2:
            focals = CAMERA_MODELS[name].num_focals
            params[:focals] = [rng.uniform(10, 900)] * focals
            params[focals : focals + 2] = [rng.uniform(0, side) for side in size]
        for _ in range(rng.choice([0, 0, 1, 2])):
            params[rng.randrange(len(params))] = rng.choice(FLOATS)
        camera = Camera(1, name, *size, tuple(params))
        check_image("place", PosedImage(1, "a.png", camera, np.eye(4)))
        change = CameraChange(camera, pinhole_camera(camera, center=rng.random() < 0.3))
        assert min(change.target.width, change.target.height) > 0
        sampling_map(change)
        sampling_map.cache_clear()
        xy = np.random.default_rng(0).uniform(-10, 700, (20, 2))
        assert move_pixels(change, xy).shape == (20, 2)

    run_damaged([], 50, survive)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_damaged_point_clouds(run_damaged, tmp_path, form):
    path = tmp_path / "points.ply"
    if form == "ascii":
        header = ["ply", "format ascii 1.0", "element vertex 50", "property float x"]
        header += ["property float y", "property float z", "property uchar red"]
        header += ["property uchar green", "property uchar blue", "end_header"]
        path.write_text("\n".join([*header, *(f"{i} {i / 3} -{i} 1 2 3" for i in range(50))]))
    else:
        header = "ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
        header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(header.encode() + bytes(50 * 24))
    assert len(read_points(path)) == 50
    run_damaged([path], 100, lambda rng: read_points(path))


def test_points_that_a_header_only_claims(tmp_path):
    path = Path(tmp_path / "points.ply")
    for count in (10**6, 10**12, 2**63, 10**30):
        for form in ("ascii", "binary_little_endian"):
            path.write_text(
                f"ply\nformat {form} 1.0\nelement vertex {count}\nproperty float x\n"
                "property float y\nproperty float z\nend_header\n0 0 0\n"
            )
            with pytest.raises(ChronoSceneError, match=f"expected {count} vertices"):
                read_points(path)
