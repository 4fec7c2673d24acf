"""A scene that gets images and points without losing any: nothing that was there changes."""

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
"""...if the point projects into the new images this near to what they see, in pixels."""


def grow_points(scene: Scene, new: Scene, frames: Sequence[Frame]) -> Points:
    """Points of both scenes, with tracks over ``frames``.

    Args:
        scene: The old scene.
        new: Old and new images, with points that were triangulated from both.
        frames: All frames, sorted by name; those of both scenes are among them.
    """
    index = {frame.name: i for i, frame in enumerate(frames)}
    old_frame = np.array([index[f.name] for f in scene.frames], np.int64)
    new_frame = np.array([index[f.name] for f in new.frames], np.int64)
    is_old = np.zeros(len(frames), bool)
    is_old[old_frame] = True
    a, b = scene.points, new.points
    a_frame, b_frame = old_frame[a.track_frame], new_frame[b.track_frame]
    b_point = track_owners(b.track_start)
    wanted = np.zeros(len(b), bool)
    wanted[b_point[~is_old[b_frame]]] = True
    target = _same_points(scene, a_frame, b_point, b_frame, b.track_xy, is_old)
    target = _check(scene.points, target, b_point, b_frame, b, frames, is_old)
    joins, is_new = wanted & (target >= 0), wanted & (target < 0)
    return _concatenate(a, b, a_frame, b_frame, b_point, target, joins, is_new, is_old)


def _same_points(
    scene: Scene,
    a_frame: NDArray[np.int64],
    b_point: NDArray[np.int64],
    b_frame: NDArray[np.int64],
    b_xy: NDArray[np.float64],
    is_old: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Old point that each new point shares most of its old observations with; -1 without.

    [new points]
    """
    a = scene.points
    a_point = track_owners(a.track_start)
    shared = np.full(len(b_point), -1, np.int64)
    for frame in np.unique(b_frame[is_old[b_frame]]).tolist():
        mine, theirs = np.flatnonzero(b_frame == frame), np.flatnonzero(a_frame == frame)
        if not len(theirs):
            continue
        distance, nearest = cKDTree(a.track_xy[theirs]).query(b_xy[mine])
        near = distance < SAME_PIXELS
        shared[mine[near]] = a_point[theirs[nearest[near]]]
    target = np.full(int(b_point.max(initial=-1)) + 1, -1, np.int64)
    observed = np.bincount(b_point[is_old[b_frame]], minlength=len(target))
    found = shared >= 0
    pairs, counts = np.unique(
        np.column_stack([b_point[found], shared[found]]), axis=0, return_counts=True
    )
    most = 2 * counts > observed[pairs[:, 0]]
    target[pairs[most, 0]] = pairs[most, 1]
    return target


def _check(
    old: Points,
    target: NDArray[np.int64],
    b_point: NDArray[np.int64],
    b_frame: NDArray[np.int64],
    b: Points,
    frames: Sequence[Frame],
    is_old: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Undo pairs whose old point does not lie where new images see it."""
    target = np.concatenate([target, np.full(len(b) - len(target), -1, np.int64)])
    bad = np.zeros(len(b), bool)
    for i in np.unique(b_frame[~is_old[b_frame]]).tolist():
        mine = np.flatnonzero((b_frame == i) & (target[b_point] >= 0))
        if len(mine):
            pose = frames[i].cam_from_world
            local = old.xyz[target[b_point[mine]]] @ pose[:3, :3].T + pose[:3, 3]
            seen = project_points(frames[i].camera, local)
            error = np.linalg.norm(seen - b.track_xy[mine], axis=1)
            bad[b_point[mine[~(error < SAME_ERROR)]]] = True
    return np.where(bad, -1, target)


def _concatenate(
    a: Points,
    b: Points,
    a_frame: NDArray[np.int64],
    b_frame: NDArray[np.int64],
    b_point: NDArray[np.int64],
    target: NDArray[np.int64],
    joins: NDArray[np.bool_],
    is_new: NDArray[np.bool_],
    is_old: NDArray[np.bool_],
) -> Points:
    """Old points with longer tracks, then new ones."""
    a_point = track_owners(a.track_start)
    joined = joins[b_point] & ~is_old[b_frame]
    fresh = is_new[b_point]
    number = np.cumsum(is_new) - 1 + len(a)
    point = np.concatenate([a_point, target[b_point[joined]], number[b_point[fresh]]])
    frame = np.concatenate([a_frame, b_frame[joined], b_frame[fresh]])
    xy = np.concatenate([a.track_xy, b.track_xy[joined], b.track_xy[fresh]])
    order = np.argsort(point, kind="stable")
    point, frame, xy = point[order], frame[order], xy[order]
    once = np.ones(len(point), bool)
    seen = np.unique(point * (int(frame.max(initial=0)) + 1) + frame, return_index=True)[1]
    once[:] = False
    once[seen] = True
    point, frame, xy = point[once], frame[once], xy[once]
    count = len(a) + int(is_new.sum())
    start = np.searchsorted(point, np.arange(count + 1))
    first_id = 1 + int(a.ids.max(initial=0))
    return Points(
        ids=np.concatenate([a.ids, first_id + np.arange(int(is_new.sum()))]),
        xyz=np.concatenate([a.xyz, b.xyz[is_new]]),
        rgb=np.concatenate([a.rgb, b.rgb[is_new]]),
        error=np.concatenate([a.error, b.error[is_new]]),
        track_start=start.astype(np.int64),
        track_frame=frame.astype(np.int32),
        track_xy=xy,
    )
