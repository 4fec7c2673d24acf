"""A scene that gets a period: nothing of what was there changes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.formats import read_scene
from chronoscene.registration.reconstruct.extension import extend_tracks
from chronoscene.scene import Points, Scene


@pytest.fixture
def scene(make_scene_folder: Callable[..., Path]) -> Scene:
    return read_scene(make_scene_folder())


def split_off(scene: Scene, kept: list[int]) -> Scene:
    """The scene with some of its frames only, and the points that they see."""
    points = scene.points
    slot = {frame: i for i, frame in enumerate(kept)}
    rows = np.repeat(np.arange(len(points)), np.diff(points.track_start))
    mine = np.isin(points.track_frame, kept)
    lengths = np.bincount(rows[mine], minlength=len(points))
    start = np.concatenate([[0], np.cumsum(lengths)])
    frames = np.array([slot[f] for f in points.track_frame[mine].tolist()], np.int32)
    fewer = replace(points, track_start=start, track_frame=frames, track_xy=points.track_xy[mine])
    return replace(scene, frames=tuple(scene.frames[i] for i in kept), points=fewer)


def tracks(points: Points, names: list[str]) -> dict[int, set[str]]:
    spans = zip(points.track_start[:-1], points.track_start[1:], strict=True)
    return {
        int(i): {names[f] for f in points.track_frame[a:b].tolist()}
        for i, (a, b) in zip(points.ids, spans, strict=True)
    }


def test_old_points_get_the_observations_of_new_images(scene: Scene) -> None:
    old = split_off(scene, [0, 1])
    grown = extend_tracks(old, scene, scene.frames)
    assert grown.xyz.tobytes() == old.points.xyz.tobytes()
    assert grown.ids.tolist() == old.points.ids.tolist()
    names = [f.name for f in scene.frames]
    assert tracks(grown, names) == tracks(scene.points, names)


def test_new_points_are_those_that_new_images_see(scene: Scene) -> None:
    old = split_off(scene, [0, 1])
    half = np.arange(15)
    fewer = replace(
        old.points,
        ids=old.points.ids[half],
        xyz=old.points.xyz[half],
        rgb=old.points.rgb[half],
        error=old.points.error[half],
        track_start=old.points.track_start[:16],
        track_frame=old.points.track_frame[: old.points.track_start[15]],
        track_xy=old.points.track_xy[: old.points.track_start[15]],
    )
    grown = extend_tracks(replace(old, points=fewer), scene, scene.frames)
    assert len(grown) == 30
    assert grown.ids[:15].tolist() == fewer.ids.tolist()
    assert (grown.ids[15:] > fewer.ids.max()).all()
    names = [f.name for f in scene.frames]
    new = {frozenset(seen) for i, seen in tracks(grown, names).items() if i > fewer.ids.max()}
    assert new == {frozenset(names)}


def test_a_point_that_moved_does_not_join_the_old_one(scene: Scene) -> None:
    old = split_off(scene, [0, 1])
    moved = old.points.xyz.copy()
    moved[4] += 1.0
    old = replace(old, points=replace(old.points, xyz=moved))
    grown = extend_tracks(old, scene, scene.frames)
    assert len(grown) == 31
    names = [f.name for f in scene.frames]
    assert tracks(grown, names)[int(old.points.ids[4])] == set(names[:2])
