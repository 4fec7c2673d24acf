"""Models that share no image: found, laid into one frame, and merged. Worker process only.

A unit is a model in a frame of its own: of a period, or a part of a joint model that did not hold
together. Units are joined along the strongest links; a link is a set of matches between points of
two units. Where appearance defeats matching, GPS places a unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.alignment import (
    Alignment,
    GpsAlignment,
    PointPairs,
    align_by_points,
    align_to_gps,
)
from chronoscene.registration.reconstruct.model_edits import image_pose, merge, sorted_ids
from chronoscene.scene.geometry import Sim3

LEAST_POSITIONS = 6
"""Positions that agree in a unit that is placed by GPS alone: three fit whatever they are."""

LEAST_PAIRS = 12
"""Pairs of points below which no alignment is tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """Positions by image name."""

    enu: Mapping[str, Sequence[float]]
    """Metres."""
    sigma: Mapping[str, Sequence[float]]
    """Metres."""

    @classmethod
    def of(cls, data: Mapping[str, Any] | None) -> Priors:
        return cls({}, {}) if data is None else cls(data["enu"], data["sigma"])


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """A model and how it is called in the log."""

    label: str
    model: pycolmap.Reconstruction
    period: int | None = None
    """The period that it is a model of; None where it is of several."""
    is_largest: bool = True
    """Whether it is the largest of its period."""

    @property
    def size(self) -> int:
        return int(self.model.num_reg_images())


@dataclass(frozen=True, slots=True, eq=False)
class Combined:
    """Units in one frame."""

    model: pycolmap.Reconstruction
    used: tuple[str, ...]
    """Labels of the units in it."""
    left: tuple[tuple[str, ...], ...]
    """Names of the images of each unit that could not be placed."""
    unplaced: tuple[str, ...]
    """Names of images that are in the model, but lie in a frame of their own."""
    remarks: tuple[str, ...]


def combine(
    units: Sequence[Unit],
    matches: Mapping[tuple[int, int], NDArray[np.int64]],
    priors: Priors,
    database: str | Path,
    *,
    keep_unplaced: bool = False,
) -> Combined:
    """Lay units into the frame of the largest and merge them.

    Args:
        units: At least one.
        matches: Verified matches of all pairs of images, by image ids of the database. [M, 2]
        priors: Positions, where known.
        database: Where all images are known.
        keep_unplaced: Whether whole periods that cannot be placed come into the model nevertheless,
            each as it lies in its own frame: tie points will place them.
    """
    remarks: list[str] = []
    links = find_links(units, matches)
    for (i, j), link in sorted(links.items()):
        remarks.append(_describe(units[i], units[j], link))
    root = max(range(len(units)), key=lambda i: (units[i].size, -i))
    placed = place_by_links(len(units), root, links)
    _place_by_gps(units, placed, root, priors, remarks)
    left = [i for i in range(len(units)) if i not in placed]
    remarks += [f"{units[i].label}: {units[i].size} images could not be placed" for i in left]
    there = {units[i].period for i in placed}
    loose = [i for i in left if units[i].is_largest and units[i].period not in there]
    loose = [i for i in loose if keep_unplaced and units[i].period is not None]
    placed |= {i: Sim3.identity() for i in loose}
    remarks += [f"{units[i].label}: kept in a frame of its own, for tie points" for i in loose]
    left = [i for i in left if i not in loose]
    order = sorted(placed)
    model = merge([units[i].model for i in order], [placed[i] for i in order], database)
    return Combined(
        model=model,
        used=tuple(units[i].label for i in order),
        left=tuple(_names(units[i]) for i in left),
        unplaced=tuple(name for i in loose for name in _names(units[i])),
        remarks=tuple(remarks),
    )


def _names(unit: Unit) -> tuple[str, ...]:
    return tuple(str(unit.model.images[i].name) for i in sorted_ids(unit.model))


def _describe(a: Unit, b: Unit, link: Alignment) -> str:
    verdict = "used" if link.is_trustworthy else "not trusted"
    return (
        f"{b.label} in {a.label}: {int(link.inliers.sum())} of {len(link.inliers)} pairs of points "
        f"agree, in {link.cells} places, median {link.median_pixels:.2f} px, scale "
        f"{link.target_from_source.scale:.4f}: {verdict}"
    )


def find_links(
    units: Sequence[Unit], matches: Mapping[tuple[int, int], NDArray[np.int64]]
) -> dict[tuple[int, int], Alignment]:
    """Alignment of unit j in unit i, for i < j with enough matches."""
    owner = {n: k for k, unit in enumerate(units) for n in unit.model.reg_image_ids()}
    between: dict[tuple[int, int], list[tuple[int, int, NDArray[np.int64]]]] = {}
    for (a, b), pairs in matches.items():
        i, j = owner.get(a), owner.get(b)
        if i is None or j is None or i == j:
            continue
        item = (a, b, pairs) if i < j else (b, a, pairs[:, ::-1])
        between.setdefault((min(i, j), max(i, j)), []).append(item)
    links = {}
    for (i, j), items in sorted(between.items()):
        joined = point_pairs(units[j].model, units[i].model, items)
        alignment = align_by_points(joined) if len(joined) >= LEAST_PAIRS else None
        if alignment is not None:
            links[i, j] = alignment
    return links


def point_pairs(
    source: pycolmap.Reconstruction,
    target: pycolmap.Reconstruction,
    items: Sequence[tuple[int, int, NDArray[np.int64]]],
) -> PointPairs:
    """Points of two models that matches join, each pair of points once.

    Args:
        source: Model of the second image of each item.
        target: Model of the first.
        items: Image ids (target, source) and keypoint indices. [M, 2]
    """
    seen: set[tuple[int, int]] = set()
    rows: dict[str, list[Any]] = {name: [] for name in PointPairs.__slots__}
    for a, b, pairs in items:
        in_target, in_source = target.images[a], source.images[b]
        points_a, points_b = _point_ids(in_target), _point_ids(in_source)
        for ka, kb in pairs.tolist():
            key = (points_a[ka], points_b[kb])
            if key[0] < 0 or key[1] < 0 or key in seen:
                continue
            seen.add(key)
            rows["target"].append(target.points3D[key[0]].xyz)
            rows["source"].append(source.points3D[key[1]].xyz)
            for side, model, image, k in (
                ("target", target, in_target, ka),
                ("source", source, in_source, kb),
            ):
                camera = model.cameras[image.camera_id]
                rows[f"{side}_ray"].append(camera.cam_from_img(image.points2D[k].xy))
                rows[f"{side}_focal"].append(camera.mean_focal_length())
                rows[f"{side}_pose"].append(image_pose(image))
    return _as_pairs(rows)


def _as_pairs(rows: Mapping[str, Sequence[Any]]) -> PointPairs:
    shapes = {"pose": (-1, 4, 4), "ray": (-1, 2), "focal": (-1,), "source": (-1, 3)}
    arrays = {
        name: np.array(values, np.float64).reshape(shapes.get(name.rpartition("_")[2], (-1, 3)))
        for name, values in rows.items()
    }
    rays = np.hstack([arrays["source_ray"], arrays["target_ray"]])
    return PointPairs(**arrays).select(np.flatnonzero(np.isfinite(rays).all(axis=1)))


def _point_ids(image: pycolmap.Image) -> list[int]:
    """Point of each keypoint; -1 without one."""
    return [p.point3D_id if p.has_point3D() else -1 for p in image.points2D]


def place_by_links(
    count: int, root: int, links: Mapping[tuple[int, int], Alignment]
) -> dict[int, Sim3]:
    """Frame of the root from that of each unit, along a tree of the strongest links (Prim)."""
    placed = {root: Sim3.identity()}
    while len(placed) < count:
        best: tuple[int, int, Alignment, bool] | None = None
        for (i, j), link in sorted(links.items()):
            if (i in placed) == (j in placed) or not link.is_trustworthy:
                continue
            if best is None or link.inliers.sum() > best[2].inliers.sum():
                best = (i, j, link, i in placed)
        if best is None:
            return placed
        i, j, link, forward = best
        if forward:
            placed[j] = chain(placed[i], link.target_from_source)
        else:
            placed[i] = chain(placed[j], link.target_from_source.inverse())
    return placed


def chain(a: Sim3, b: Sim3) -> Sim3:
    """First ``b``, then ``a``."""
    return Sim3(
        a.scale * b.scale,
        a.rotation @ b.rotation,
        a.scale * a.rotation @ b.translation + a.translation,
    )


def _place_by_gps(
    units: Sequence[Unit],
    placed: dict[int, Sim3],
    root: int,
    priors: Priors,
    remarks: list[str],
) -> None:
    """Place what no link reached, if its positions and those of the root are good enough."""
    missing = [i for i in range(len(units)) if i not in placed]
    if not missing or not priors.enu:
        return
    base = gps_alignment(units[root].model, priors)
    if base is None or not _places_alone(base):
        remarks.append(f"{units[root].label}: its GPS does not fix a frame")
        return
    for i in missing:
        found = gps_alignment(units[i].model, priors)
        if found is None or not _places_alone(found):
            remarks.append(f"{units[i].label}: its GPS does not fix a frame")
            continue
        placed[i] = chain(base.enu_from_model.inverse(), found.enu_from_model)
        remarks.append(
            f"{units[i].label}: no matches with the others hold; placed by GPS alone, whose rms "
            f"residual is {found.rms:.2f} m"
        )


def _places_alone(found: GpsAlignment) -> bool:
    return found.is_useful and int(found.inliers.sum()) >= LEAST_POSITIONS


def gps_alignment(model: pycolmap.Reconstruction, priors: Priors) -> GpsAlignment | None:
    """How a model lies in the frame of the priors; rows in the order of `registered_names`."""
    ids = sorted_ids(model)
    names = [str(model.images[i].name) for i in ids]
    nowhere = [np.nan] * 3
    enu = np.array([priors.enu.get(name, nowhere) for name in names], np.float64).reshape(-1, 3)
    poses = np.stack([image_pose(model.images[i]) for i in ids])
    return align_to_gps(poses, enu, np.ones(len(enu), bool))
