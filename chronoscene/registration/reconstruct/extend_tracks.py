"""A scene that gets images and points: nothing that was there changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from chronoscene.scene import Frame, Points, Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.tracks import track_owners

SAME_PIXELS = 1.0
"""Two observations in one image this near to each other are of one point..."""

SAME_ERROR = 4.0
"""...if the point projects into the new images this near to their observations, in pixels."""

Ints = NDArray[np.int64]


def extend_tracks(scene: Scene, new: Scene, frames: Sequence[Frame]) -> Points:
    """Points of both scenes, with tracks over ``frames``.

    New points are those that a new image sees. Where one is an old point, its observations by new
    images extend the track of that point.

    Args:
        scene: The old scene.
        new: Old and new images, with points that were triangulated from both.
        frames: All frames, sorted by name; those of both scenes are among them.
    """
    index = {frame.name: i for i, frame in enumerate(frames)}
    a, b = scene.points, new.points
    old_frame = np.array([index[f.name] for f in scene.frames], np.int64)
    a_point, a_frame = track_owners(a.track_start), old_frame[a.track_frame]
    b_point = track_owners(b.track_start)
    b_frame = np.array([index[f.name] for f in new.frames], np.int64)[b.track_frame]
    by_new = ~np.isin(b_frame, old_frame)
    target = _same_points(a, a_point, a_frame, b, b_point, b_frame, by_new)
    target[_misfits(a, target, b, b_point, b_frame, by_new, frames)] = -1

    is_new = np.zeros(len(b), bool)
    is_new[b_point[by_new]] = True
    is_new &= target < 0
    number = np.where(target < 0, np.cumsum(is_new) - 1 + len(a), target)
    rows = np.flatnonzero(is_new[b_point] | (by_new & (target[b_point] >= 0)))
    point = np.concatenate([a_point, number[b_point[rows]]])
    frame = np.concatenate([a_frame, b_frame[rows]])
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
        track_xy=np.concatenate([a.track_xy, b.track_xy[rows]])[order],
    )


def _same_points(
    a: Points,
    a_point: Ints,
    a_frame: Ints,
    b: Points,
    b_point: Ints,
    b_frame: Ints,
    by_new: NDArray[np.bool_],
) -> Ints:
    """Old point that each new point shares most of its old observations with; -1 without. [b]"""
    shared = np.full(len(b_point), -1, np.int64)
    for frame in np.unique(b_frame[~by_new]).tolist():
        mine, theirs = np.flatnonzero(b_frame == frame), np.flatnonzero(a_frame == frame)
        if not len(theirs):
            continue
        distance, nearest = cKDTree(a.track_xy[theirs]).query(b.track_xy[mine])
        near = distance < SAME_PIXELS
        shared[mine[near]] = a_point[theirs[nearest[near]]]
    target = np.full(len(b), -1, np.int64)
    observed = np.bincount(b_point[~by_new], minlength=len(b))
    found = shared >= 0
    pairs, counts = np.unique(
        np.column_stack([b_point[found], shared[found]]), axis=0, return_counts=True
    )
    most = 2 * counts > observed[pairs[:, 0]]
    target[pairs[most, 0]] = pairs[most, 1]
    return target


def _misfits(
    a: Points,
    target: Ints,
    b: Points,
    b_point: Ints,
    b_frame: Ints,
    by_new: NDArray[np.bool_],
    frames: Sequence[Frame],
) -> Ints:
    """New points whose old point does not project to where new images see it."""
    bad = [np.zeros(0, np.int64)]
    for i in np.unique(b_frame[by_new]).tolist():
        mine = np.flatnonzero((b_frame == i) & (target[b_point] >= 0))
        pose = frames[i].cam_from_world
        local = a.xyz[target[b_point[mine]]] @ pose[:3, :3].T + pose[:3, 3]
        error = np.linalg.norm(project_points(frames[i].camera, local) - b.track_xy[mine], axis=1)
        bad.append(b_point[mine[~(error < SAME_ERROR)]])
    return np.concatenate(bad)
