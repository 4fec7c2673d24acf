"""What cameras have in view, against plain definitions."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.data.skeletons.dataset import write_skeleton
from chronoscene.formats import read_scene
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.statistics.measures import DEPTH_PERCENTILE, REACH_FACTOR, in_view, reproject

PINHOLE = Camera(1, "PINHOLE", 100, 100, (50.0, 50.0, 50.0, 50.0))
"""Sees 45 degrees to every side."""


def scene_of(camera: Camera, poses: list[np.ndarray], points: list, owners: list[int]) -> Scene:
    """One camera per period, each of which observes the points that it owns."""
    owned = np.array(owners)
    return Scene(
        name="views",
        root=None,  # type: ignore[arg-type]
        images_root=None,  # type: ignore[arg-type]
        frames=tuple(
            Frame(f"{i}.png", i + 1, camera, pose, i, "train") for i, pose in enumerate(poses)
        ),
        points=replace(
            Points.empty(),
            ids=np.arange(len(points)),
            xyz=np.array(points, float),
            track_start=np.arange(len(points) + 1),
            track_frame=owned.astype(np.int32),
            track_xy=np.zeros((len(points), 2)),
        ),
        periods=tuple(Period(i, str(i)) for i in range(len(poses))),
        split_rule="rule",
        format="chronoscene",
    )


def views(scene: Scene) -> list[list[float | None]]:
    seen = scene.count_views() > 0
    return [list(row) for row in in_view(scene, seen, reproject(scene).depth)]


def moved(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = -x
    return pose


def test_shares_without_any_common_point() -> None:
    mine = [(0, 0, 10), (9, 0, 10), (-9, 0, 10), (0, 9, 10)]
    theirs = [(12, 0, 10), (20, 0, 10)]
    scene = scene_of(PINHOLE, [np.eye(4), moved(15)], mine + theirs, [0] * 4 + [1] * 2)
    assert views(scene) == [[1.0, 0.25], [0.0, 1.0]]


def test_what_is_behind_or_too_far_is_not_in_view() -> None:
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    near, far = [(0, 0, 10), (1, 0, 10)], [(0, 0, -10), (0, 0, -200)]
    scene = scene_of(PINHOLE, [np.eye(4), turned], near + far, [0, 0, 1, 1])
    assert views(scene) == [[1.0, 0.0], [0.0, 1.0]]
    ahead = scene_of(PINHOLE, [np.eye(4), moved(0)], [*near, (0, 0, 14), (0, 0, 16)], [0, 0, 1, 1])
    assert views(ahead) == [[1.0, 1.0], [0.5, 1.0]]  # up to 15 = 1.5 times 10


def test_a_period_that_sees_nothing_may_look_at_the_same_place() -> None:
    scene = scene_of(PINHOLE, [np.eye(4), moved(1)], [(0, 0, 10), (1, 0, 10)], [0, 0])
    assert views(scene) == [[1.0, 1.0], [None, None]]


def test_distortion_does_not_fold_the_outside_into_the_image() -> None:
    # x (1 - 0.3 x^2) is largest at 1.05, and zero again at 1.83.
    camera = Camera(1, "SIMPLE_RADIAL", 60, 60, (50.0, 30.0, 30.0, -0.3))
    points = [(0, 0, 10), (0.5, 0, 10), (18, 0, 10)]
    scene = scene_of(camera, [np.eye(4)], points, [0, 0, 0])
    assert views(scene) == [[pytest.approx(2 / 3)]]


def test_equals_plain_loops(tmp_path) -> None:
    write_skeleton(tmp_path / "place", [(12, 250), (7, 120), (9, 300)], seed=5)
    scene = read_scene(tmp_path / "place")
    seen, found = scene.count_views() > 0, reproject(scene)
    period = np.array([f.period for f in scene.frames])[scene.points.track_frame]
    for b in range(3):
        reach = REACH_FACTOR * np.percentile(found.depth[period == b], DEPTH_PERCENTILE)
        for a in range(3):
            hits = []
            for xyz in scene.points.xyz[seen[:, a]]:
                hit = False
                for frame in scene.select(period=b):
                    local = (frame.cam_from_world @ [*xyz, 1.0])[:3]
                    x, y, _ = frame.camera.K @ local / local[2]
                    inside = 0 <= x <= frame.camera.width and 0 <= y <= frame.camera.height
                    hit |= inside and 0 < local[2] <= reach
                hits.append(hit)
            share = in_view(scene, seen, found.depth)[a][b]
            assert share == pytest.approx(np.mean(hits))
