"""Focal lengths of the metadata, where images leave them open and where they do not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from chronoscene.colmap.model import read_model
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.lens import _adjusted as full
from chronoscene.registration.reconstruct.routes import joint
from chronoscene.scene.geometry import camera_centre, look_at

Array = NDArray[np.float64]

FOCAL, SIZE = 800.0, (1000, 750)
HEIGHT = 50.0


def flight(
    write_database: Callable[..., dict[str, Any]],
    folder: Path,
    model: str,
    lens: tuple[float, ...],
    start: float,
) -> dict[str, Any]:
    """Arguments of a route for 12 photos straight down on flat ground, through a real lens.

    Args:
        write_database: Fixture.
        folder: Of the database.
        model: Camera model of the database.
        lens: ``k1, k2, p1, p2`` of the true one.
        start: Focal length in the database.
    """
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-35, 85, (2400, 2)), rng.normal(0, 0.3, 2400)])
    poses = []
    for i in range(12):
        place = np.array([15.0 * (i % 4), 20.0 * (i // 4), HEIGHT + rng.normal(0, 0.2)])
        target = np.array([*(place[:2] + rng.normal(0, 0.3, 2)), 0.0])
        poses.append(look_at(place, target, roll=np.pi * (i // 4 % 2) + 0.01 * rng.normal()))
    true = pycolmap.Camera(
        model="OPENCV", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, 500, 375, *lens]
    )
    camera = pycolmap.Camera.create_from_model_name(1, model, start, *SIZE)
    sees = [rng.uniform(size=len(ground)) < 0.8 for _ in poses]
    arguments = write_database(folder, poses, ground, sees, true, camera)
    names = sorted(arguments["periods"])
    enu = {n: camera_centre(p).tolist() for n, p in zip(names, poses, strict=True)}
    sigma = {n: [0.02, 0.02, 0.03] for n in names}
    return arguments | {"priors": {"enu": enu, "sigma": sigma}}


def found(arguments: dict[str, Any]) -> tuple[float, float]:
    """Focal length, and height of the cameras above the ground."""
    model = read_model(Path(arguments["out"]))
    centres = camera_centre(np.stack([i.cam_from_world for i in model.images]))
    height = np.median(centres[:, 2]) - np.median(model.points.xyz[:, 2])
    return float(model.images[0].camera.K[0, 0]), float(height)


LENS = (-0.12, 0.09, 0.0, 0.0)


@pytest.mark.slow
def test_a_stated_focal_length_is_held_where_flat_ground_leaves_it_open(
    tmp_path: Path, write_database: Callable[..., Any]
) -> None:
    free = flight(write_database, tmp_path / "free", "SIMPLE_RADIAL", LENS, FOCAL)
    joint(free, lambda *_: None)
    focal, height = found(free)
    assert abs(focal / FOCAL - 1) > 0.25  # so the case is one
    assert abs(height / HEIGHT - 1) > 0.25
    stated = flight(write_database, tmp_path / "stated", "SIMPLE_RADIAL", LENS, FOCAL)
    stated["focals"] = dict.fromkeys(stated["periods"], (FOCAL, 0.005))
    result = joint(stated, lambda *_: None)
    focal, height = found(stated)
    assert result["held"] and focal == FOCAL
    assert height == pytest.approx(HEIGHT, rel=0.07)
    assert any("fits as well and is held" in r for r in result["remarks"])


class Adjusted(NamedTuple):
    """A flight after a trial of the full model of the lens."""

    remarks: list[str]
    focal_and_height: tuple[float, float]
    fits: int
    """Times that the full model was fitted."""


def adjusted(
    write_database: Callable[..., Any], folder: Path, lens: tuple[float, ...], sample: int
) -> Adjusted:
    """Trial on so many of the points."""
    module = "chronoscene.registration.reconstruct.lens"
    case = flight(write_database, folder, "SIMPLE_RADIAL", lens, FOCAL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{module}.MIN_PHOTOS", 12)
        patch.setattr(f"{module}.SAMPLE", sample)
        patch.setattr(f"{module}._adjusted", spy := Mock(side_effect=full))
        remarks = joint(case | {"full_lens": True}, lambda *_: None)["remarks"]
    return Adjusted(remarks, found(case), spy.call_count)


@pytest.mark.parametrize(
    ("lens", "gains"),
    [(LENS, True), pytest.param((-0.05, 0.0, 0.0, 0.0), False, marks=pytest.mark.slow)],
)
def test_a_full_model_of_the_lens_is_taken_where_part_of_the_points_shows_a_gain(
    tmp_path: Path, write_database: Callable[..., Any], lens: tuple[float, ...], gains: bool
) -> None:
    whole = adjusted(write_database, tmp_path / "all", lens, sample=10**6)
    assert any(("lens: focal" if gains else "gain nothing") in r for r in whole.remarks)
    if gains:
        assert whole.focal_and_height == pytest.approx((FOCAL, HEIGHT), rel=0.03)
        assert any("all coefficients of the lens" in r for r in whole.remarks)
    part = adjusted(write_database, tmp_path / "sample", lens, sample=300)
    assert part[:2] == whole[:2]
    assert (whole.fits, part.fits) == (1, gains)


def test_a_wrong_focal_length_in_the_metadata_does_no_harm(make_case: Callable[..., Any]) -> None:
    case = make_case(points=150)
    camera = read_camera(case.database)
    case.extra = {"focals": dict.fromkeys(case.periods, (0.7 * camera, 0.02))}
    result = case.run(joint)
    assert not result["held"]
    assert any("it is needed" in r for r in result["remarks"])
    assert all(degrees < 0.1 and share < 0.002 for degrees, share in case.errors().values())


def read_camera(database: Path) -> float:
    with pycolmap.Database.open(str(database)) as opened:
        return float(opened.read_all_cameras()[0].mean_focal_length())
