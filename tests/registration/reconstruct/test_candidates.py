"""Streets, and the choice among attempts to map them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.registration.generated import pose_errors
from chronoscene.colmap.model import read_model
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import verified_matches
from chronoscene.registration.reconstruct.alignment import Alignment
from chronoscene.registration.reconstruct.candidates import CERTAIN_INLIERS, support, weak_pairs
from chronoscene.registration.reconstruct.routes import joint
from chronoscene.scene.geometry import look_at
from chronoscene.scene.similarity import Sim3

Array = NDArray[np.float64]


def street(count: int) -> tuple[list[Array], Array, list[NDArray[np.bool_]]]:
    """Poses of a walk between two rows of houses, points of these, and which photo detects which.

    Nearly all points are detected in two photos in a row, as in real walks.
    """
    rng = np.random.default_rng(7)
    length = 2.5 * count + 30
    points = np.column_stack(
        [
            rng.uniform(0, length, 9000),
            rng.choice([-6.0, 6.0], 9000) + rng.normal(0, 0.3, 9000),
            rng.uniform(0, 8, 9000),
        ]
    )
    poses, sees = [], []
    first = rng.integers(-1, count, len(points))
    tracks = np.where(rng.uniform(size=len(points)) < 0.9, 2, 3)
    for i in range(count):
        place = np.array([2.5 * i, rng.normal(0, 0.2), 1.6])
        poses.append(look_at(place, place + rng.normal([10.0, 0.0, 0.0], [0.0, 0.5, 0.2])))
        ahead = points[:, 0] - place[0]
        sees.append((i >= first) & (i < first + tracks) & (ahead > 3) & (ahead < 60))
    return poses, points, sees


CAMERA = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=1000, height=750, params=[800.0, 500.0, 375.0, 0.0]
)


def test_a_walk_along_a_street_is_mapped(
    tmp_path: Path, write_database: Callable[..., dict[str, Any]]
) -> None:
    poses, points, sees = street(12)
    arguments = write_database(tmp_path, poses, points, sees, CAMERA)
    arguments["focals"] = dict.fromkeys(arguments["periods"], (800.0, 0.02))
    result = joint(arguments, lambda *_: None)
    assert result["model"]["images"] == len(poses)
    assert any("short tracks" in r for r in result["remarks"])
    found = {i.name: i.cam_from_world for i in read_model(Path(arguments["out"])).images}
    model = np.stack([found[name] for name in sorted(found)])
    _, moved = pose_errors(model, np.stack(poses), np.ones(len(poses), bool))
    assert moved.max() < 0.01 * 2.5 * len(poses)


def test_support_falls_with_every_wrong_pose(make_case: Callable[..., Any]) -> None:
    case = make_case()
    case.run(joint)
    model = pycolmap.Reconstruction(str(case.folder / "model"))
    _, matches = verified_matches(case.database)
    right = support(model, matches)
    some = pycolmap.Reconstruction(model)
    some.deregister_frame(some.images[1].frame_id)
    assert 0 < support(some, matches) < right
    image = model.images[1]
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.5, 0.0])), np.zeros(3))
    model.frames[image.frame_id].set_cam_from_world(
        image.camera_id, turned * image.cam_from_world()
    )
    assert support(model, matches) < support(some, matches)  # though it has one image more


def pair(first: int, count: int) -> NDArray[np.int64]:
    keypoints = np.arange(first, first + count)
    return np.column_stack([keypoints, keypoints])


def test_few_matches_of_two_dates_need_a_third_photo() -> None:
    """Images 1 and 2 are of one date, 3 and 4 of another."""
    period = {1: 0, 2: 0, 3: 1, 4: 1}
    matches = {
        (1, 2): pair(0, 20),
        (1, 3): pair(0, 20),
        (2, 3): pair(0, 20),
        (1, 4): pair(500, 20),
        (2, 4): pair(700, CERTAIN_INLIERS),
    }
    assert weak_pairs(matches, period) == [(1, 4)]


@pytest.mark.parametrize(("scale", "trusted"), [(0.3, True), (0.005, False), (200.0, False)])
def test_a_submodel_at_an_absurd_scale_is_refused(scale: float, trusted: bool) -> None:
    inliers = np.ones(40, bool)
    found = Alignment(Sim3.identity(), inliers, cells=9, median_pixels=1.0)
    scaled = replace(found, target_from_source=Sim3(scale, np.eye(3), np.zeros(3)))
    assert found.is_trustworthy and scaled.is_trustworthy == trusted
