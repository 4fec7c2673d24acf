"""Samples of every format, made from one exact scene; writers here share no code with ours."""

import json
import pickle
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from chronoscene.formats import read_scene
from chronoscene.scene import Scene

Builder = Callable[..., Path]

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl(cam_from_world: np.ndarray) -> list[list[float]]:
    """Camera-to-world matrix with OpenGL axes."""
    return (np.linalg.inv(cam_from_world) @ FLIP).tolist()


def intrinsics(scene: Scene) -> dict:
    camera = scene.frames[0].camera
    fx, fy, cx, cy = camera.params
    return {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def write_json(path: Path, data: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))


def write_ply(path: Path, scene: Scene) -> None:
    """Positions as floats and colours, binary."""
    lines = ["ply", "format binary_little_endian 1.0", "comment a sample"]
    lines += [f"element vertex {len(scene.points)}"]
    lines += [f"property float {c}" for c in "xyz"]
    lines += [f"property uchar {c}" for c in ("red", "green", "blue")]
    rows = zip(scene.points.xyz.tolist(), scene.points.rgb.tolist(), strict=True)
    body = b"".join(struct.pack("<3f3B", *xyz, *rgb) for xyz, rgb in rows)
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)


@pytest.fixture
def exact(make_scene_folder) -> Callable[[list[str]], Scene]:
    """Factory of an exact scene with images of the given names, in a folder of its own."""
    count = iter(range(100))

    def make(names: list[str]) -> Scene:
        periods = {name: i % 2 for i, name in enumerate(names)}
        return read_scene(make_scene_folder(periods, name=f"exact{next(count)}"))

    return make


@pytest.fixture
def colmap_folder(make_scene_folder) -> Builder:
    """Factory of plain COLMAP folders: a model and images, no periods."""

    def make(names: list[str], name: str = "plain", **options) -> Path:
        folder = make_scene_folder({n: i % 2 for i, n in enumerate(names)}, name=name, **options)
        (folder / "sparse/split.txt").unlink()
        return folder

    return make


@pytest.fixture
def nerfstudio_folder(exact, tmp_path) -> Builder:
    """Factory of folders with ``transforms.json``; keyword arguments are keys of the file."""

    def make(names: list[str], name: str = "studio", periods: bool = True, **keys) -> Path:
        scene, root = exact(names), tmp_path / name
        shutil.copytree(scene.images_root, root / "images")
        frames = [
            {
                "file_path": f"images/{f.name}",
                "transform_matrix": opengl(f.cam_from_world),
                **({"period": f.period} if periods else {}),
            }
            for f in reversed(scene.frames)
        ]
        write_ply(root / "points.ply", scene)
        data = {**intrinsics(scene), "ply_file_path": "points.ply", **keys, "frames": frames}
        write_json(root / "transforms.json", data)
        return root

    return make


@pytest.fixture
def raw_city(exact, tmp_path) -> Builder:
    """Factory of raw MatrixCity folders with the given blocks, each of three images."""

    def make(blocks: list[str], name: str = "city") -> Path:
        root = tmp_path / name
        names = [f"{i:04d}.png" for i in range(3)]
        for block in blocks:
            scene = exact(names)
            shutil.copytree(scene.images_root, root / block)
            frames = []
            for i, frame in enumerate(scene.frames):
                pose = np.array(opengl(frame.cam_from_world))
                pose[:3, :3] /= 100
                frames.append({"frame_index": i, "rot_mat": pose.tolist()})
            write_json(root / block / "transforms.json", {"camera_angle_x": 1.0, "frames": frames})
        return root

    return make


@pytest.fixture
def level(exact, tmp_path) -> Builder:
    """Factory of rendered CL-Splats levels with the given changes."""

    def make(changes: tuple[str, ...] = ("add", "move"), name: str = "Level-1") -> Path:
        root = tmp_path / name
        for part in ("", *changes):
            scene = exact(["r_0.png", "r_1.png", "r_2.png"])
            shutil.copytree(scene.images_root, root / part / "images")
            frames = [
                {
                    "file_path": f"images/{f.name.removesuffix('.png')}",
                    "transform_matrix": opengl(f.cam_from_world),
                }
                for f in scene.frames
            ]
            data = {"camera_angle_x": 1.1, "frames": frames}
            write_json(root / part / "transforms_train.json", data)
        return root

    return make


class Bomb:
    """Pickles to a call that creates a file: proof that somebody loaded it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture
def pointz(colmap_folder, tmp_path) -> Builder:
    """Factory of NeuSC folders; their pickle would create ``tmp_path / "exploded"``."""

    def make(names: list[str], train: list[str] | None = None) -> Path:
        plain, root = colmap_folder(names, name="plain5"), tmp_path / "5pointz"
        (root / "dense").mkdir(parents=True)
        (plain / "images").rename(root / "dense/images")
        (plain / "sparse/0").rename(root / "dense/sparse")
        shutil.rmtree(plain)
        (root / "annots").mkdir()
        bomb = pickle.dumps(Bomb(tmp_path / "exploded"))
        (root / "annots/cam_dict.npy").write_bytes(b"\x93NUMPY\x01\x00" + bomb)
        (root / "annots/cam_dict.pkl").write_bytes(bomb)
        if train is not None:
            (root / "annots/train.txt").write_text("\n".join(train))
        return root

    return make


DATED = [f"20{9 + i // 3:02d}-0{1 + i % 3}-1{i % 3}_{i:04d}.png" for i in range(12)]
"""Four years, three dates in each."""


@pytest.fixture
def builders(
    make_scene_folder, colmap_folder, nerfstudio_folder, raw_city, level, pointz
) -> dict[str, Builder]:
    """Format name to a function that makes a small valid scene of two periods or more."""
    tasks = [f"{task}/{i}.png" for task in ("t1", "t2") for i in range(3)]
    days = [f"day_{day}_{i:02d}.png" for day in (0, 3) for i in range(5)]
    return {
        "chronoscene": make_scene_folder,
        "cl-splats": lambda: colmap_folder(days),
        "colmap-folders": lambda: colmap_folder(tasks),
        "matrixcity": lambda: raw_city(["before/block_A", "after/block_A"]),
        "nerfstudio": lambda: nerfstudio_folder([f"{i}.png" for i in range(6)]),
        "neusc": lambda: pointz(DATED),
        "wat": lambda: colmap_folder(tasks, name="kitchen"),
    }
