"""Focal lengths of the metadata, where images leave them open and where they do not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chronoscene.colmap.model import read_model
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.routes import joint
from chronoscene.scene.geometry import camera_centre, look_at

Array = NDArray[np.float64]

FOCAL, SIZE = 800.0, (1000, 750)
HEIGHT = 50.0


def silent(what: str, done: int, total: int) -> None:
    """No progress."""


def flight(folder: Path, model: str, lens: tuple[float, ...], start: float) -> dict[str, Any]:
    """Arguments of a route for 12 photos straight down on flat ground, through a real lens.

    Args:
        folder: Of the database.
        model: Camera model of the database.
        lens: ``k1, k2, p1, p2`` of the true one.
        start: Focal length in the database.
    """
    rng = np.random.default_rng(3)
    (folder / "photos").mkdir(parents=True)
    true = pycolmap.Camera(
        model="OPENCV", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, 500, 375, *lens]
    )
    ground = np.column_stack([rng.uniform(-35, 85, (2400, 2)), rng.normal(0, 0.3, 2400)])
    poses, names = [], []
    for i in range(12):
        place = np.array([15.0 * (i % 4), 20.0 * (i // 4), HEIGHT + rng.normal(0, 0.2)])
        target = np.array([*(place[:2] + rng.normal(0, 0.3, 2)), 0.0])
        poses.append(look_at(place, target, roll=np.pi * (i // 4 % 2) + 0.01 * rng.normal()))
        names.append(f"{i:02d}.jpg")
    with pycolmap.Database.open(str(folder / "mapping.db")) as database:
        camera = pycolmap.Camera.create_from_model_name(1, model, start, *SIZE)
        camera.has_prior_focal_length = True
        database.write_camera(camera)
        seen = [
            _write(database, n, p, true, ground, rng) for n, p in zip(names, poses, strict=True)
        ]
        for i, a in enumerate(seen):
            for j in range(i + 1, len(seen)):
                _match(database, i + 1, j + 1, a, seen[j])
    enu = {n: camera_centre(p).tolist() for n, p in zip(names, poses, strict=True)}
    return {
        "database": str(folder / "mapping.db"),
        "photos": str(folder / "photos"),
        "periods": dict.fromkeys(names, 0),
        "priors": {"enu": enu, "sigma": dict.fromkeys(names, [0.02, 0.02, 0.03])},
        "keep_unplaced": False,
        "out": str(folder / "model"),
        "scratch": str(folder / "scratch"),
        "threads": 1,
    }


def _write(
    database: Any, name: str, pose: Array, camera: Any, ground: Array, rng: np.random.Generator
) -> dict[int, int]:
    """Write an image and its keypoints; the keypoint of each point that it sees."""
    local = ground @ pose[:3, :3].T + pose[:3, 3]
    xy = np.array([camera.img_from_cam(p) for p in local], np.float64)
    inside = ((xy > 0) & (xy < SIZE)).all(axis=1) & (rng.uniform(size=len(xy)) < 0.8)
    rows = np.flatnonzero(inside)
    image = pycolmap.Image(name=name, camera_id=1)
    image_id = database.write_image(image)
    database.write_keypoints(
        image_id, (xy[rows] + rng.normal(0, 0.3, (len(rows), 2))).astype(np.float32)
    )
    return {int(k): i for i, k in enumerate(rows)}


def _match(database: Any, i: int, j: int, a: dict[int, int], b: dict[int, int]) -> None:
    pairs = np.array([(a[k], b[k]) for k in sorted(a.keys() & b.keys())], np.uint32)
    if len(pairs) < 20:
        return
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = pairs
    database.write_matches(i, j, pairs)
    database.write_two_view_geometry(i, j, geometry)


def found(arguments: dict[str, Any]) -> tuple[float, float]:
    """Focal length, and height of the cameras above the ground."""
    model = read_model(Path(arguments["out"]))
    centres = camera_centre(np.stack([i.cam_from_world for i in model.images]))
    height = np.median(centres[:, 2]) - np.median(model.points.xyz[:, 2])
    return float(model.images[0].camera.K[0, 0]), float(height)


LENS = (-0.12, 0.09, 0.0, 0.0)


def test_a_stated_focal_length_is_held_where_flat_ground_leaves_it_open(tmp_path: Path) -> None:
    free = flight(tmp_path / "free", "SIMPLE_RADIAL", LENS, FOCAL)
    joint(free, silent)
    focal, height = found(free)
    assert abs(focal / FOCAL - 1) > 0.25  # so the case is one
    assert abs(height / HEIGHT - 1) > 0.25
    stated = flight(tmp_path / "stated", "SIMPLE_RADIAL", LENS, FOCAL)
    stated["focals"] = dict.fromkeys(stated["periods"], (FOCAL, 0.005))
    result = joint(stated, silent)
    focal, height = found(stated)
    assert result["held"] and focal == FOCAL
    assert height == pytest.approx(HEIGHT, rel=0.07)
    assert any("fits as well and is held" in r for r in result["remarks"])


def test_a_full_model_of_the_lens_gives_focal_length_and_height(tmp_path: Path) -> None:
    case = flight(tmp_path, "OPENCV", LENS, FOCAL / 1.1)
    case["focals"] = dict.fromkeys(case["periods"], (FOCAL, 0.005))
    assert not joint(case, silent)["held"]
    focal, height = found(case)
    assert focal == pytest.approx(FOCAL, rel=0.03)
    assert height == pytest.approx(HEIGHT, rel=0.03)


def test_a_wrong_focal_length_in_the_metadata_does_no_harm(make_case: Callable[..., Any]) -> None:
    case = make_case(points=200)
    camera = read_camera(case.database)
    case.extra = {"focals": dict.fromkeys(case.periods, (0.7 * camera, 0.02))}
    result = joint(case.arguments(), silent)
    assert not result["held"]
    assert any("it is needed" in r for r in result["remarks"])
    assert all(degrees < 0.1 and share < 0.002 for degrees, share in case.errors().values())


def read_camera(database: Path) -> float:
    with pycolmap.Database.open(str(database)) as opened:
        return float(opened.read_all_cameras()[0].mean_focal_length())
