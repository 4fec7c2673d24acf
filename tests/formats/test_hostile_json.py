"""Any value anywhere in a file of poses: our error, or a scene that can be written."""

import copy
import json
import random

import pytest

from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene

VALUES = (
    None, True, -1, 0, 1, 10**30, 10**400, 1.5, float("nan"), float("inf"), "", "x", "../x", "/x",
    "a\0b", "\ud800", "images", ".", [], [1], [[1]], {}, {"a": 1}, [[0] * 4] * 4, "9" * 5000,
    [None] * 3, [{}] * 3, "p.ply",
)  # fmt: skip

EXTRA = {
    "applied_scale": 2.0,
    "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
    "train_filenames": [f"images/{i}.png" for i in range(5)],
    "test_filenames": ["images/5.png"],
    "periods": [{"id": 0, "label": "a"}, {"id": 1, "date": "2016"}],
    "world": {"unit": "metre", "crs": None, "offset": [0, 0, 0]},
    "camera_model": "OPENCV",
    "k1": 0.0,
    "distortion_params": [0, 0],
    "is_fisheye": False,
}


def places(data, path=()):
    """Paths to every value of a document, the document itself included."""
    yield path
    if isinstance(data, (dict, list)):
        for key in data if isinstance(data, dict) else range(len(data)):
            yield from places(data[key], (*path, key))


def replaced(data, path, value):
    if not path:
        return value
    data = copy.deepcopy(data)
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return data


@pytest.mark.parametrize("name", ["nerfstudio", "matrixcity", "level"])
def test_any_value_anywhere(nerfstudio_folder, raw_city, level, tmp_path, name):
    folder, file = {
        "nerfstudio": lambda: (nerfstudio_folder([f"{i}.png" for i in range(6)], **EXTRA), ""),
        "matrixcity": lambda: (raw_city(["block_A", "block_B"]), "block_A"),
        "level": lambda: (level(), "add"),
    }[name]()
    chosen = {"nerfstudio": "nerfstudio", "matrixcity": "matrixcity", "level": "cl-splats"}[name]
    (path,) = (folder / file).glob("transforms*.json")
    data = json.loads(path.read_text())
    if name == "nerfstudio":
        for i, frame in enumerate(data["frames"]):
            frame |= {"time": i / 5, "colmap_im_id": i + 1, "mask_path": "m.png"}
        (folder / "m.png").touch()
    rng, refused = random.Random(0), 0
    everywhere = list(places(data))
    keys = [p for p in everywhere if len(p) <= 1 or p[0] != "frames"]
    for step in range(300):
        place = rng.choice(keys if step % 2 else everywhere)
        path.write_text(json.dumps(replaced(data, place, rng.choice(VALUES))))
        try:
            scene = read_scene(folder, format=chosen)
            our_format.write(scene, tmp_path / f"out{step}", image_source="none")
        except ChronoSceneError:
            refused += 1
    assert 50 < refused < 300
