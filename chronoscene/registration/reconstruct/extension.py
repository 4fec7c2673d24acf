"""A scene extended by a new period: the old frames and points stay, tracks grow and are added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.result import Registered
from chronoscene.scene import Frame, Period, Points, Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.splits import default_tests, split_of
from chronoscene.scene.tracks import track_owners

SAME_PIXELS = 1.0  # Observations in one image that are nearer to each other can be of one point

SAME_ERROR = 4.0
"""Pixels. They are of one point if it projects this near to where the new images see it."""


def add_period(scene: Scene, new: Scene, registered: Registered) -> Scene:
    """Add the last period of a registration to the scene that it extends.

    Frames of the scene stay as they are, points as in `extend_tracks`.

    Args:
        scene: The scene before.
        new: Old and new images, with points that were triangulated from both.
        registered: The registration that ``new`` was made of.
    """
    old_names = {f.name for f in scene.frames}
    added_period = scene.num_periods
    spare = 1 + max(f.image_id for f in scene.frames)
    added = [f for f in new.frames if f.name not in old_names]
    tests = default_tests({f.name: 0 for f in added})
    fresh = [
        replace(f, image_id=spare + i, period=added_period, split=split_of(f.name, tests))
        for i, f in enumerate(added)
    ]
    frames = tuple(sorted((*scene.frames, *fresh), key=lambda f: f.name))
    points = extend_tracks(scene, new, frames)
    label = registered.labels[added_period]
    period = Period(added_period, label, registered.dates[added_period])
    return replace(
        new, frames=frames, points=points, periods=(*scene.periods, period), world=scene.world
    )


def extend_tracks(scene: Scene, new: Scene, frames: Sequence[Frame]) -> Points:
    """Points of both scenes, with tracks over ``frames``.

    Old points stay, with their ids. New points are those that a new image sees. Where one is an
    old point, its observations by new images extend the track of that point.

    Args:
        scene: The old scene.
        new: As in `add_period`.
        frames: All frames, sorted by name; those of both scenes are among them.
    """
    index = {frame.name: i for i, frame in enumerate(frames)}
    a, b = scene.points, new.points
    before = _Sightings.of(scene, index)
    again = _Sightings.of(new, index)
    by_new = ~np.isin(again.frame, [index[f.name] for f in scene.frames])
    target = _same_points(before, again.select(~by_new), len(b))
    target[_misfits(a.xyz, target, again.select(by_new), frames)] = -1

    is_new = np.zeros(len(b), bool)
    is_new[again.point[by_new]] = True
    is_new &= target < 0
    number = np.where(target < 0, np.cumsum(is_new) - 1 + len(a), target)
    added = again.select(is_new[again.point] | (by_new & (target[again.point] >= 0)))
    point = np.concatenate([before.point, number[added.point]])
    frame = np.concatenate([before.frame, added.frame])
    order = np.argsort(point, kind="stable")
    # An image observes a point once: the first observation counts.
    key = point * len(frames) + frame
    order = order[np.sort(np.unique(key[order], return_index=True)[1])]
    count = int(is_new.sum())
    first_id = 1 + int(a.ids.max(initial=0))
    return Points(
        ids=np.concatenate([a.ids, first_id + np.arange(count)]),
        xyz=np.concatenate([a.xyz, b.xyz[is_new]]),
        rgb=np.concatenate([a.rgb, b.rgb[is_new]]),
        error=np.concatenate([a.error, b.error[is_new]]),
        track_start=np.searchsorted(point[order], np.arange(len(a) + count + 1)).astype(np.int64),
        track_frame=frame[order].astype(np.int32),
        track_xy=np.concatenate([a.track_xy, added.xy])[order],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """Observations of points (O observations)."""

    point: Ints
    frame: Ints
    xy: Array

    @classmethod
    def of(cls, scene: Scene, index: Mapping[str, int]) -> _Sightings:
        """Observations of a scene; ``index`` numbers the frames by name."""
        frame = np.array([index[f.name] for f in scene.frames], np.int64)
        points = scene.points
        return cls(track_owners(points.track_start), frame[points.track_frame], points.track_xy)

    def select(self, rows: Mask) -> _Sightings:
        return _Sightings(self.point[rows], self.frame[rows], self.xy[rows])


def _same_points(before: _Sightings, again: _Sightings, count: int) -> Ints:
    """Old point that each new point shares most of its old observations with; -1 without. [count]

    Args:
        before: Of the old points.
        again: Of the new points by the same images.
        count: Number of new points.
    """
    shared = np.full(len(again.point), -1, np.int64)
    for frame in np.unique(again.frame).tolist():
        mine, theirs = np.flatnonzero(again.frame == frame), before.select(before.frame == frame)
        if not len(theirs.point):
            continue
        distance, nearest = cKDTree(theirs.xy).query(again.xy[mine])
        near = distance < SAME_PIXELS
        shared[mine[near]] = theirs.point[nearest[near]]
    target = np.full(count, -1, np.int64)
    observed = np.bincount(again.point, minlength=count)
    found = shared >= 0
    pairs, counts = np.unique(
        np.column_stack([again.point[found], shared[found]]), axis=0, return_counts=True
    )
    most = 2 * counts > observed[pairs[:, 0]]
    target[pairs[most, 0]] = pairs[most, 1]
    return target


def _misfits(xyz: Array, target: Ints, added: _Sightings, frames: Sequence[Frame]) -> Ints:
    """New points whose old point does not project to where new images see it.

    Args:
        xyz: Old points. [N, 3]
        target: Old point of each new point, or -1.
        added: Of the new points by new images.
        frames: All frames.
    """
    added = added.select(target[added.point] >= 0)
    bad = [np.zeros(0, np.int64)]
    for i in np.unique(added.frame).tolist():
        mine = added.select(added.frame == i)
        pose = frames[i].cam_from_world
        local = xyz[target[mine.point]] @ pose[:3, :3].T + pose[:3, 3]
        error = np.linalg.norm(project_points(frames[i].camera, local) - mine.xy, axis=1)
        bad.append(mine.point[~(error < SAME_ERROR)])
    return np.concatenate(bad)
