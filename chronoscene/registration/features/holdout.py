"""Tracks that take no part in the estimation, so that the result can be tested on them.

Matches are joined to tracks over all images. A share of the tracks that two periods see is drawn,
and all their matches are removed from the database that the mapper reads, within periods too: a
held-out track cannot affect any pose.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import replacing
from chronoscene.registration.features.database import (
    copy_database,
    keypoints_of,
    quiet,
    remove_journals,
    verified_matches,
)
from chronoscene.scene.tracks import seen_by_period

MIN_LEFT = 16  # A pair of images keeps at least this many matches: sparse pairs stay useful


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Keypoints of all images joined by matches, flat."""

    image: Ints
    """Image id of each keypoint that has a match. [K]"""
    keypoint: Ints
    """Its index in the image. [K]"""
    track: Ints
    """[K]"""
    offset: Mapping[int, int]
    """Index of keypoint 0 of an image in the numbering that `node_track` has."""
    node_track: Ints
    """Track of every keypoint of every image; -1 without matches."""

    def of(self, image: int, keypoints: Ints) -> Ints:
        """Track of keypoints of an image."""
        return self.node_track[self.offset[image] + keypoints]


def build_tracks(matches: Mapping[tuple[int, int], Ints], keypoints: Mapping[int, Array]) -> Tracks:
    """Join matches to tracks: the connected components of keypoints.

    SIFT gives several keypoints at one pixel where it finds several orientations. They count as
    one, or the mapper would know a held-out track by its other keypoints.

    Args:
        matches: Keypoint indices by pair of image ids. [M, 2]
        keypoints: Pixels of the keypoints of each image. [K, 2]
    """
    ids = sorted(keypoints)
    starts = np.cumsum([0, *(len(keypoints[i]) for i in ids)])
    offset = {image: int(start) for image, start in zip(ids, starts, strict=False)}
    total = int(starts[-1])
    nothing = np.zeros(0, np.int64)
    # Nodes are keypoints, numbered over all images; several at one pixel are the first of them.
    alias = np.concatenate([nothing, *(offset[i] + first_at_place(keypoints[i]) for i in ids)])
    edges = [np.add(pairs, (offset[i], offset[j])) for (i, j), pairs in matches.items()]
    first, second = alias[np.concatenate([nothing.reshape(0, 2), *edges])].T
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(total, total))
    _, labels = connected_components(graph, directed=False)
    used = np.unique(np.concatenate([first, second]))
    node_track = np.full(total, -1, np.int64)
    node_track[used] = np.unique(labels[used], return_inverse=True)[1]
    slot = np.searchsorted(starts, used, side="right") - 1
    return Tracks(
        image=np.array(ids, np.int64)[slot],
        keypoint=used - starts[slot],
        track=node_track[used],
        offset=offset,
        node_track=node_track[alias],
    )


def first_at_place(xy: Array) -> Ints:
    """Index of the first keypoint at the position of each keypoint. [K, 2] -> [K]"""
    if not len(xy):
        return np.zeros(0, np.int64)
    _, first, inverse = np.unique(xy, axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[inverse.ravel()], np.int64)


def eligible_tracks(tracks: Tracks, period_of: Mapping[int, int]) -> Ints:
    """Tracks of two periods or more, without two keypoints in one image, which are mismatched."""
    images, slot = np.unique(tracks.image, return_inverse=True)
    period = np.array([period_of[i] for i in images.tolist()], np.int64)
    count = int(tracks.track.max(initial=-1)) + 1
    shape = count, int(period.max(initial=-1)) + 1
    several = seen_by_period(tracks.track, period[slot], shape).sum(axis=1) > 1
    views, times = np.unique(tracks.track * len(images) + slot, return_counts=True)
    several[views[times > 1] // max(len(images), 1)] = False
    return np.flatnonzero(several)


def hold_out(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Write the database for mapping, and the file of held-out observations.

    Arguments: ``database``, ``out`` (database), ``held_out`` (npz), ``periods`` (by name),
    ``share``, ``seed``.
    """
    quiet()
    report("hold out", 0, 1)
    names, matches = verified_matches(arguments["database"])
    points = keypoints_of(arguments["database"])
    period_of = {i: arguments["periods"][name] for i, name in names.items()}
    tracks = build_tracks(matches, points)
    candidates = eligible_tracks(tracks, period_of)
    rng = np.random.default_rng(arguments["seed"])
    count = round(arguments["share"] * len(candidates))
    chosen = np.sort(rng.choice(candidates, count, replace=False))
    removed = _filtered_copy(Path(arguments["database"]), Path(arguments["out"]), tracks, chosen)
    _write_held_out(Path(arguments["held_out"]), tracks, removed, points, names)
    partners: dict[str, int] = dict.fromkeys(names.values(), 0)
    across: dict[tuple[int, int], list[int]] = {}
    for (i, j), pairs in matches.items():
        partners[names[i]] += 1
        partners[names[j]] += 1
        a, b = sorted((period_of[i], period_of[j]))
        if a != b:
            across.setdefault((a, b), []).append(len(pairs))
    counts = {f"{a}-{b}": found for (a, b), found in sorted(across.items())}
    return {
        "tracks_of_several_periods": len(candidates),
        "held_out": int(removed.sum()),
        "partners": partners,
        "verified_pairs_across": {key: len(found) for key, found in counts.items()},
        "matches_across": {key: sum(found) for key, found in counts.items()},
    }


def _filtered_copy(source: Path, target: Path, tracks: Tracks, chosen: Ints) -> Mask:
    """Copy a database without the matches of some tracks.

    Returns:
        Whether a track is held out. A track whose removal would leave a pair with fewer than
        `MIN_LEFT` matches stays in. [tracks]
    """
    held = np.zeros(int(tracks.track.max()) + 1 if len(tracks.track) else 0, bool)
    held[chosen] = True
    with replacing(target) as partial, ExitStack() as leaving:
        leaving.callback(remove_journals, partial)
        copy_database(source, partial)
        with pycolmap.Database.open(str(partial)) as opened:
            pair_ids, geometries = opened.read_two_view_geometries()
            pairs = [pycolmap.pair_id_to_image_pair(i) for i in pair_ids]
            for (i, _), geometry in zip(pairs, geometries, strict=True):
                track = tracks.of(i, _first_column(geometry))
                if (~held[track]).sum() < MIN_LEFT:
                    held[track] = False
            for (i, j), geometry in zip(pairs, geometries, strict=True):
                keep = ~held[tracks.of(i, _first_column(geometry))]
                if not keep.all():
                    geometry.inlier_matches = np.asarray(geometry.inlier_matches)[keep]
                    opened.update_two_view_geometry(i, j, geometry)
    return held


def _first_column(geometry: pycolmap.TwoViewGeometry) -> Ints:
    return np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)[:, 0]


def _write_held_out(
    path: Path, tracks: Tracks, held: Mask, points: Mapping[int, Array], names: Mapping[int, str]
) -> None:
    """Write the observations of held-out tracks: track, image and pixels."""
    mine = held[tracks.track] if len(held) else np.zeros(0, bool)
    order = np.flatnonzero(mine)[np.argsort(tracks.track[mine], kind="stable")]
    image, keypoint = tracks.image[order], tracks.keypoint[order]
    xy = np.array([points[i][k] for i, k in zip(image.tolist(), keypoint.tolist(), strict=True)])
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(
            file,
            track=np.unique(tracks.track[order], return_inverse=True)[1],
            image=image,
            xy=xy.reshape(-1, 2),
            names=np.frombuffer(json.dumps(dict(names)).encode(), np.uint8),
        )
        file.flush()
        os.fsync(file.fileno())
