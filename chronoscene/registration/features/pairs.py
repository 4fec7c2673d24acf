"""Choice of the image pairs to match. Worker process only.

Few images are matched exhaustively. Many are matched with their neighbours in space (by GPS), in
time (by the order in which they were taken) and in appearance (by a global descriptor), within
every period and between every two, so that no period depends on a single link.

The global descriptor is VLAD over SIFT: residuals to the nearest of a few visual words, summed by
word, power- and length-normalised (Jegou et al. 2010; Arandjelovic and Zisserman 2013). The words
are learnt from the images themselves, so nothing has to be downloaded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import quiet, read_features, write_pairs
from chronoscene.scene.geometry import camera_centre

SPATIAL_NEIGHBOURS = 10
SEQUENTIAL_NEIGHBOURS = 4
SIMILAR_NEIGHBOURS = 6
"""Neighbours of each image in its period and, except in the sequence, in every other period."""

POSED_NEIGHBOURS, POSED_CANDIDATES = 12, 60
"""Neighbours of an image with a known pose in every period, and the nearest they are chosen of."""

LEAST_COSINE = 0.25
"""Cosine of the angle between the directions of view of neighbours: 75 degrees. SIFT features are
lost long before."""

WORDS = 64
MAX_TRAINING = 20_000
ITERATIONS = 10
MAX_DESCRIPTORS = 2_000  # Of an image: those of the largest features, which are the most stable

Pair = tuple[int, int]


def choose_pairs(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Choose the pairs to match, and write their list.

    Arguments: ``database``, ``pairs`` (list file), ``images`` (each with ``name``, ``period``,
    ``enu`` or null, ``taken`` or null), ``exhaustive_limit``.
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
    write_pairs(Path(arguments["pairs"]), [(names[i], names[j]) for i, j in ordered])
    across = sum(int(periods[i] != periods[j]) for i, j in ordered)
    return {"pairs": len(ordered), "across_periods": across, "kinds": counts}


def _positions(images: Sequence[Mapping[str, Any]]) -> Array:
    """Positions in metres, NaN where unknown. [N, 3]"""
    nowhere = [np.nan] * 3
    return np.array([image["enu"] or nowhere for image in images], np.float64).reshape(-1, 3)


def _ordered(pairs: Iterable[Pair]) -> set[Pair]:
    return {(min(i, j), max(i, j)) for i, j in pairs if i != j}


def spatial_pairs(enu: Array, periods: Ints) -> set[Pair]:
    """Pair images with their nearest in every period, in plan view: GPS heights are poor."""
    from scipy.spatial import cKDTree  # takes longer to load than few images to pair

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


def posed_pairs(poses: Array, periods: Ints) -> set[Pair]:
    """Pair images with the nearest of every period that look in a similar direction.

    Args:
        poses: cam_from_world. [N, 4, 4]
        periods: [N]
    """
    from scipy.spatial import cKDTree

    found: list[Pair] = []
    centres, axes = camera_centre(poses), poses[:, 2, :3]
    for target in np.unique(periods).tolist():
        members = np.flatnonzero(periods == target)
        wanted = min(POSED_CANDIDATES, len(members))
        _, nearest = cKDTree(centres[members]).query(centres, k=range(1, wanted + 1))
        for i, row in enumerate(members[nearest]):
            alike = row[(axes[row] @ axes[i] > LEAST_COSINE) & (row != i)]
            found += [(i, j) for j in alike[:POSED_NEIGHBOURS].tolist()]
    return _ordered(found)


def sequential_pairs(images: Sequence[Mapping[str, Any]], periods: Ints) -> set[Pair]:
    """Pair images with those taken next in their period; by name where times are unknown."""
    found: list[Pair] = []
    for period in np.unique(periods).tolist():
        members = np.flatnonzero(periods == period).tolist()
        if all(images[i]["taken"] for i in members):
            members.sort(key=lambda i: (images[i]["taken"], images[i]["name"]))
        for place, i in enumerate(members):
            found += [(i, j) for j in members[place + 1 : place + 1 + SEQUENTIAL_NEIGHBOURS]]
    return _ordered(found)


def similar_pairs(descriptors: NDArray[np.float32], periods: Ints) -> set[Pair]:
    """Pair images with the most similar ones of every period, by unit vectors [N, D]."""
    found: list[Pair] = []
    similarity = descriptors @ descriptors.T
    np.fill_diagonal(similarity, -np.inf)
    for target in np.unique(periods).tolist():
        members = np.flatnonzero(periods == target)
        order = np.argsort(-similarity[:, members], axis=1, kind="stable")[:, :SIMILAR_NEIGHBOURS]
        for i, row in enumerate(members[order].tolist()):
            found += [(i, j) for j in row]
    return _ordered(found)


def global_descriptors(database: str | Path, names: Sequence[str]) -> NDArray[np.float32]:
    """Global descriptors of images, unit length, zero without features. [N, WORDS * D]

    Descriptors are read anew for each use: those of thousands of photos fill gigabytes.
    """
    shapes = [_local(database, name).shape for name in names]
    columns = max(width for _, width in shapes)
    ends = np.cumsum([count if width == columns else 0 for count, width in shapes])
    rng = np.random.default_rng(0)
    rows = training_rows(int(ends[-1]), rng)
    training = np.zeros((len(rows), columns), np.float32)
    for name, end, (count, width) in zip(names, ends, shapes, strict=True):
        mine = (rows >= end - count) & (rows < end)
        if width == columns and mine.any():
            training[mine] = _local(database, name)[rows[mine] - (end - count)]
    words = visual_words(training, rng)
    nothing = np.zeros((0, columns), np.float32)
    local = (
        _local(database, name) if width == columns else nothing
        for name, (_, width) in zip(names, shapes, strict=True)
    )
    return np.stack([vlad(descriptors, words) for descriptors in local])


def training_rows(count: int, rng: np.random.Generator) -> Ints:
    """Rows of descriptors by which words are learnt: all, or a sample of many."""
    if count <= MAX_TRAINING:
        return np.arange(count)
    return rng.choice(count, MAX_TRAINING, replace=False)


def _local(database: str | Path, name: str) -> NDArray[np.float32]:
    """Descriptors of the largest features of an image, with unit length. [K, D]"""
    with pycolmap.Database.open(str(database)) as opened:
        image = opened.read_image_with_name(name)
        assert image is not None
        keypoints, data = read_features(opened, image.image_id)
    data = data.astype(np.float32)
    size = np.ones(len(data))
    if keypoints.shape[1] == 6:
        size = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    data = data[np.argsort(-size, kind="stable")[:MAX_DESCRIPTORS]]
    return data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-6)


def visual_words(descriptors: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Cluster centres of descriptors, by Lloyd's algorithm. [K, D]"""
    count = min(WORDS, max(1, len(descriptors)))
    if not len(descriptors):
        return np.zeros((1, descriptors.shape[1]), np.float32)
    words = descriptors[rng.choice(len(descriptors), count, replace=False)].copy()
    for _ in range(ITERATIONS):
        nearest = assign(descriptors, words)
        for word in range(count):
            members = descriptors[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def assign(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> Ints:
    """Nearest word of each descriptor. [K]"""
    scores = descriptors @ words.T - 0.5 * (words**2).sum(axis=1)
    return np.asarray(scores.argmax(axis=1), np.int64)


def vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Global descriptor of an image. [WORDS * D]"""
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest = assign(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    sums /= np.maximum(norms, 1e-12)
    vector = np.sign(sums) * np.sqrt(np.abs(sums))
    length = float(np.linalg.norm(vector))
    return np.asarray((vector / max(length, 1e-12)).ravel(), np.float32)
