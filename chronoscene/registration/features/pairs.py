"""Which pairs of images to match. Runs in the worker process only.

Few images are matched exhaustively. Many are matched with neighbours: in space by GPS, in time by
the order in which they were taken, and in appearance by a global descriptor. Each is done within
every period and between every two periods, so that no period hangs on one thread.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from chronoscene.registration.features.database import quiet, write_pairs
from chronoscene.registration.features.retrieval import global_descriptors
from chronoscene.registration.worker import Report

SPATIAL_NEIGHBOURS = 10
SEQUENTIAL_NEIGHBOURS = 4
SIMILAR_NEIGHBOURS = 6
"""Of each image, within its period, and again in every other period (no sequence there)."""

Pair = tuple[int, int]


def choose_pairs(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Write the list of pairs to match.

    Arguments: ``database``, ``out`` (list file), ``images`` (each with ``name``, ``period``,
    ``enu`` or null, ``taken`` or null), ``exhaustive_limit``, ``skip`` (periods whose images are
    only matched with others; may be empty).
    """
    quiet()
    images = arguments["images"]
    names = [image["name"] for image in images]
    periods = np.array([image["period"] for image in images])
    counts: dict[str, int] = {}
    if len(images) <= arguments["exhaustive_limit"]:
        chosen = {(i, j) for i in range(len(images)) for j in range(i + 1, len(images))}
        counts["exhaustive"] = len(chosen)
    else:
        report("similar images", 0, 1)
        descriptors = global_descriptors(arguments["database"], names)
        kinds = {
            "neighbours in space": spatial_pairs(_positions(images), periods),
            "neighbours in time": sequential_pairs(images, periods),
            "similar images": similar_pairs(descriptors, periods),
        }
        chosen = set()
        for kind, pairs in kinds.items():
            counts[kind] = len(pairs - chosen)
            chosen |= pairs
    ordered = sorted(chosen)
    write_pairs(Path(arguments["out"]), [(names[i], names[j]) for i, j in ordered])
    across = sum(int(periods[i] != periods[j]) for i, j in ordered)
    return {"pairs": len(ordered), "across_periods": across, "kinds": counts}


def _positions(images: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    """Positions in metres, NaN where unknown. [N, 3]"""
    nowhere = [np.nan] * 3
    return np.array([image["enu"] or nowhere for image in images], np.float64).reshape(-1, 3)


def _ordered(pairs: Iterable[Pair]) -> set[Pair]:
    return {(min(i, j), max(i, j)) for i, j in pairs if i != j}


def spatial_pairs(enu: NDArray[np.float64], periods: NDArray[np.int64]) -> set[Pair]:
    """Each image with its nearest in every period, on the map: heights of GPS are poor."""
    found: list[Pair] = []
    known = np.flatnonzero(np.isfinite(enu).all(axis=1))
    for target in np.unique(periods).tolist():
        members = known[periods[known] == target]
        if not len(members):
            continue
        wanted = min(SPATIAL_NEIGHBOURS + 1, len(members))
        _, nearest = cKDTree(enu[members, :2]).query(enu[known, :2], k=range(1, wanted + 1))
        for i, row in zip(known.tolist(), members[nearest].tolist(), strict=True):
            found += [(i, j) for j in row]
    return _ordered(found)


def sequential_pairs(images: Sequence[Mapping[str, Any]], periods: NDArray[np.int64]) -> set[Pair]:
    """Each image with those taken next in its period; by name where times are unknown."""
    found: list[Pair] = []
    for period in np.unique(periods).tolist():
        members = np.flatnonzero(periods == period).tolist()
        if all(images[i]["taken"] for i in members):
            members.sort(key=lambda i: (images[i]["taken"], images[i]["name"]))
        for place, i in enumerate(members):
            found += [(i, j) for j in members[place + 1 : place + 1 + SEQUENTIAL_NEIGHBOURS]]
    return _ordered(found)


def similar_pairs(descriptors: NDArray[np.float32], periods: NDArray[np.int64]) -> set[Pair]:
    """Each image with the most similar ones of every period, by unit vectors [N, D]."""
    found: list[Pair] = []
    similarity = descriptors @ descriptors.T
    np.fill_diagonal(similarity, -np.inf)
    for target in np.unique(periods).tolist():
        members = np.flatnonzero(periods == target)
        order = np.argsort(-similarity[:, members], axis=1, kind="stable")[:, :SIMILAR_NEIGHBOURS]
        for i, row in enumerate(members[order].tolist()):
            found += [(i, j) for j in row]
    return _ordered(found)
