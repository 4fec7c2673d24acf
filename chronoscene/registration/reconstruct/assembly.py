"""From files of the work folder to a `Registered`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from chronoscene.colmap.model import read_model
from chronoscene.geodesy import Georeference
from chronoscene.registration.photos.photo import Capture
from chronoscene.registration.reconstruct.gps_priors import Positions
from chronoscene.registration.result import CrossMatches, HeldOutTracks, Registered, Route
from chronoscene.scene import Camera, Frame, Points

FEW_FEATURES = 100


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """All that a `Registered` is made of, besides the model and what was held out."""

    periods: Mapping[str, int]
    """Of every photo that went into the features, by name."""
    labels: tuple[str, ...]
    dates: tuple[str | None, ...]
    positions: Mapping[str, NDArray[np.float64]]
    """ENU by name."""
    positions_used: frozenset[str]
    georeference: Georeference | None
    route: Route
    images_root: Path
    frozen: Mapping[str, Frame]
    """Images of the scene whose poses and cameras are kept to the last bit, by name."""


def assemble(model_folder: Path, held_out: Path, parts: Assembly) -> Registered:
    """Read a model and what was held out; photos without a pose are left to the caller."""
    model = read_model(model_folder)
    points = without_twins(model.points)
    names = tuple(image.name for image in model.images)
    tracks = read_held_out(held_out, names, parts.periods)
    periods = np.array([parts.periods[name] for name in names], np.int64)
    nowhere = np.full(3, np.nan)
    return Registered(
        names=names,
        periods=periods,
        cam_from_world=np.stack([_pose(parts, i.name, i.cam_from_world) for i in model.images]),
        cameras=tuple(_camera(parts, i.name, i.camera) for i in model.images),
        points=points.xyz,
        colors=points.rgb,
        track_start=points.track_start,
        track_image=points.track_frame.astype(np.int64),
        track_xy=points.track_xy,
        unregistered={},
        unregistered_periods={},
        route=parts.route,
        gps_enu=np.array([parts.positions.get(n, nowhere) for n in names]).reshape(-1, 3),
        gps_used=np.array([n in parts.positions_used for n in names], bool),
        georeference=parts.georeference,
        num_periods=len(parts.labels),
        labels=parts.labels,
        dates=parts.dates,
        held_out=cross_matches(tracks, periods),
        held_out_tracks=tracks,
        images_root=str(parts.images_root),
    )


def without_twins(points: Points) -> Points:
    """Points of which no two are observed at one pixel of one image; the longer track stays.

    SIFT gives a place several keypoints where it has several orientations, and each of them can
    become a point: the same point twice.
    """
    lengths = np.diff(points.track_start)
    row = np.repeat(np.arange(len(points)), lengths)
    place = np.column_stack([points.track_frame, points.track_xy])
    _, pixel = np.unique(place, axis=0, return_inverse=True)
    count = len(points) + int(pixel.max(initial=-1)) + 1
    graph = coo_matrix((np.ones(len(row)), (row, len(points) + pixel.ravel())), (count, count))
    group = connected_components(graph, directed=False)[1][: len(points)]
    order = np.lexsort((np.arange(len(points)), -lengths, group))
    first = np.ones(len(points), bool)
    first[1:] = np.diff(group[order]) != 0
    keep = np.zeros(len(points), bool)
    keep[order[first]] = True
    return points.select(keep)


def _pose(parts: Assembly, name: str, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return parts.frozen[name].cam_from_world if name in parts.frozen else pose


def _camera(parts: Assembly, name: str, camera: Camera) -> Camera:
    """Cameras of the scene keep their ids; those of new photos get ids after them."""
    if not parts.frozen:
        return camera
    if name in parts.frozen:
        return parts.frozen[name].camera
    last = max(frame.camera.camera_id for frame in parts.frozen.values())
    return replace(camera, camera_id=last + camera.camera_id)


def position_map(captures: tuple[Capture, ...], found: Positions) -> dict[str, NDArray[np.float64]]:
    """Positions in metres by name, believed or not."""
    return {
        capture.name: enu
        for capture, enu in zip(captures, found.enu, strict=True)
        if np.isfinite(enu).all()
    }


def read_held_out(path: Path, names: tuple[str, ...], periods: Mapping[str, int]) -> HeldOutTracks:
    """Held-out tracks that registered images of at least two periods see."""
    with np.load(path) as data:
        known: dict[str, str] = json.loads(bytes(data["names"]).decode())
        track, image, xy = data["track"], data["image"], data["xy"]
    index = {name: i for i, name in enumerate(names)}
    slot = {int(image_id): index.get(name, -1) for image_id, name in known.items()}
    place = np.array([slot[i] for i in image.tolist()], np.int64)
    keep = place >= 0
    track, place, xy = track[keep], place[keep], xy[keep]
    if not len(track):
        return HeldOutTracks.empty()
    period = np.array([periods[name] for name in names], np.int64)[place]
    low, high = np.full(track.max() + 1, np.iinfo(np.int64).max), np.full(track.max() + 1, -1)
    np.minimum.at(low, track, period)
    np.maximum.at(high, track, period)
    across = (high > low)[track]
    order = np.lexsort((place[across], track[across]))
    track, place, xy = track[across][order], place[across][order], xy[across][order]
    start = np.append(np.flatnonzero(np.diff(track, prepend=-1)), len(track))
    return HeldOutTracks(start.astype(np.int64), place, xy)


def cross_matches(tracks: HeldOutTracks, periods: NDArray[np.int64]) -> tuple[CrossMatches, ...]:
    """Held-out tracks as matches between images of different periods, by pair of images."""
    rows: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    starts = tracks.start.tolist()
    for t, (first, last) in enumerate(pairwise(starts)):
        for a in range(first, last):
            for b in range(a + 1, last):
                i, j = int(tracks.image[a]), int(tracks.image[b])
                if periods[i] == periods[j]:
                    continue
                item = (a, b, t) if periods[i] < periods[j] else (b, a, t)
                key = (int(tracks.image[item[0]]), int(tracks.image[item[1]]))
                rows.setdefault(key, []).append(item)
    found = []
    for (i, j), items in sorted(rows.items()):
        a_, b_, t_ = (np.array(column, np.int64) for column in zip(*items, strict=True))
        found.append(CrossMatches(i, j, tracks.xy[a_], tracks.xy[b_], t_))
    return tuple(found)


def reasons(
    names: Mapping[str, int],
    registered: set[str],
    keypoints: Mapping[str, int],
    partners: Mapping[str, int],
    left: list[list[str]],
) -> dict[str, str]:
    """Why each image that has no pose has none, as far as it can be said."""
    part_of = {name: len(group) for group in left for name in group}
    found = {}
    for name in sorted(set(names) - registered):
        count, matched = keypoints.get(name, 0), partners.get(name, 0)
        if count < FEW_FEATURES:
            found[name] = f"{count} features only: blurred, dark, or without texture"
        elif name in part_of:
            found[name] = f"in a model of {part_of[name]} images that could not be placed"
        elif not matched:
            found[name] = f"none of its {count} features are matched in any other photo"
        else:
            found[name] = (
                f"matched with {matched} photos, but too few of the matches agree with a pose"
            )
    return found
