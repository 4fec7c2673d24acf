"""Models that share no image: aligned in one frame, and merged. Worker process only.

A submodel is a model in a frame of its own: of a period, or one of several that a joint mapping
gave. Submodels are placed along the strongest links; a link is an alignment by matches between
points of two of them. Where appearance defeats matching, GPS places a submodel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.arrays import Ints
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.alignment import Alignment, PointPairs, align_by_points
from chronoscene.registration.reconstruct.gps_alignment import GpsAlignment, Priors, gps_alignment
from chronoscene.registration.reconstruct.models import (
    as_pycolmap,
    image_pose,
    known_images,
    set_pose,
    sorted_ids,
)
from chronoscene.scene.similarity import Sim3

MIN_POSITIONS = 6  # Consistent positions of a submodel that is placed by GPS alone: any three fit
MIN_PAIRS = 12  # Pairs of points below which no alignment is attempted


@dataclass(frozen=True, slots=True, eq=False)
class Submodel:
    """A model and its label in the log."""

    label: str
    model: pycolmap.Reconstruction
    period: int | None = None
    """The period that it is a model of; None for several."""
    is_largest: bool = True
    """True if it is the largest of its period."""

    @property
    def size(self) -> int:
        return int(self.model.num_reg_images())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(str(self.model.images[i].name) for i in sorted_ids(self.model))


@dataclass(frozen=True, slots=True, eq=False)
class Combined:
    """Submodels in one frame."""

    model: pycolmap.Reconstruction
    left: tuple[tuple[str, ...], ...]
    """Names of the images of each submodel that could not be placed."""
    unplaced: tuple[str, ...]
    """Names of images that are in the model, but in a frame of their own."""
    remarks: tuple[str, ...]


def combine(
    submodels: Sequence[Submodel],
    matches: Mapping[tuple[int, int], Ints],
    priors: Priors,
    database: str | Path,
    *,
    keep_unplaced: bool = False,
) -> Combined:
    """Place submodels in the frame of the largest and merge them.

    Args:
        submodels: At least one.
        matches: Verified matches of all pairs of images, by image ids of the database. [M, 2]
        priors: Positions, where known.
        database: With all images.
        keep_unplaced: True to merge whole periods that cannot be placed, too, each in its own
            frame: tie points will place them.
    """
    links = find_links(submodels, matches)
    remarks = [_describe(submodels[i], submodels[j], k) for (i, j), k in sorted(links.items())]
    root = max(range(len(submodels)), key=lambda i: (submodels[i].size, -i))
    placed = place_by_links(len(submodels), root, links)
    _place_by_gps(submodels, placed, root, priors, remarks)
    left = [s for i, s in enumerate(submodels) if i not in placed]
    remarks += [f"{s.label}: {s.size} images could not be placed" for s in left]
    there = {submodels[i].period for i in placed}
    loose = [s for s in left if keep_unplaced and s.period is not None]
    loose = [s for s in loose if s.is_largest and s.period not in there]
    remarks += [f"{s.label}: kept in a frame of its own, for tie points" for s in loose]
    frames = {
        s: placed.get(i, Sim3.identity())
        for i, s in enumerate(submodels)
        if i in placed or s in loose
    }
    return Combined(
        model=merge(frames, database),
        left=tuple(s.names for s in left if s not in loose),
        unplaced=tuple(name for s in loose for name in s.names),
        remarks=tuple(remarks),
    )


def merge(frames: Mapping[Submodel, Sim3], database: str | Path) -> pycolmap.Reconstruction:
    """Merge models that share no image, each transformed by its similarity.

    Every image and camera gets its id in the database, whatever its id in its own submodel; images
    are found by name. Points are left out: they are triangulated again from all matches, which
    merges their tracks. Of a camera in several submodels, the calibration of the one with most
    images is taken.
    """
    merged = known_images(database)
    ids = {str(image.name): i for i, image in merged.images.items()}
    calibrated: set[int] = set()
    for submodel in sorted(frames, key=lambda s: -s.size):
        model = pycolmap.Reconstruction(submodel.model)
        model.transform(as_pycolmap(frames[submodel]))
        for old in sorted_ids(model):
            image = merged.images[ids[str(model.images[old].name)]]
            if image.camera_id not in calibrated:
                params = model.cameras[model.images[old].camera_id].params
                merged.cameras[image.camera_id].params = params.tolist()
            set_pose(merged, image.image_id, model.images[old].cam_from_world())
        calibrated |= {merged.images[i].camera_id for i in merged.reg_image_ids()}
    return merged


def _describe(a: Submodel, b: Submodel, link: Alignment) -> str:
    verdict = "used" if link.is_trustworthy else "not trusted"
    return (
        f"{b.label} aligned to {a.label}: {int(link.inliers.sum())} of {len(link.inliers)} pairs "
        f"of points agree, in {link.cells} cells, median {link.median_pixels:.2f} px, scale "
        f"{link.target_from_source.scale:.4f}: {verdict}"
    )


def find_links(
    submodels: Sequence[Submodel], matches: Mapping[tuple[int, int], Ints]
) -> dict[tuple[int, int], Alignment]:
    """Align submodel j to submodel i, for i < j with enough matches."""
    owner = {n: k for k, submodel in enumerate(submodels) for n in submodel.model.reg_image_ids()}
    between: dict[tuple[int, int], list[tuple[int, int, Ints]]] = {}
    for (a, b), pairs in matches.items():
        i, j = owner.get(a), owner.get(b)
        if i is None or j is None or i == j:
            continue
        item = (a, b, pairs) if i < j else (b, a, pairs[:, ::-1])
        between.setdefault((min(i, j), max(i, j)), []).append(item)
    links = {}
    for (i, j), items in sorted(between.items()):
        joined = point_pairs(submodels[j].model, submodels[i].model, items)
        alignment = None if joined is None else align_by_points(joined)
        if alignment is not None:
            links[i, j] = alignment
    return links


def point_pairs(
    source: pycolmap.Reconstruction,
    target: pycolmap.Reconstruction,
    items: Sequence[tuple[int, int, Ints]],
) -> PointPairs | None:
    """Pairs of points of two models that matches join, each once; None if they are too few.

    Args:
        source: Model of the second image of each item.
        target: Model of the first.
        items: Image ids (target, source) and keypoint indices. [M, 2]
    """
    in_target = {a: _views(target, target.images[a]) for a in {a for a, _, _ in items}}
    in_source = {b: _views(source, source.images[b]) for b in {b for _, b, _ in items}}
    seen: set[tuple[int, int]] = set()
    rows = []
    for a, b, pairs in items:
        for ka, kb in pairs.tolist():
            if ka not in in_target[a] or kb not in in_source[b]:
                continue
            (point_a, view_a), (point_b, view_b) = in_target[a][ka], in_source[b][kb]
            if (point_a, point_b) not in seen:
                seen.add((point_a, point_b))
                rows.append([x for both in zip(view_b, view_a, strict=True) for x in both])
    if len(rows) < MIN_PAIRS:
        return None
    return PointPairs(*(np.array(column) for column in zip(*rows, strict=True)))


def _views(model: pycolmap.Reconstruction, image: pycolmap.Image) -> dict[int, tuple[int, Any]]:
    """Point id, and (point, pose, ray, focal length), of keypoints that have a point and a ray."""
    camera, pose, points = model.cameras[image.camera_id], image_pose(image), model.points3D
    rays, focal = camera.cam_from_img(image.points2D), camera.mean_focal_length()
    return {
        k: (p.point3D_id, (points[p.point3D_id].xyz, pose, ray, focal))
        for k, (p, ray) in enumerate(zip(image.points2D, rays, strict=True))
        if p.has_point3D() and np.isfinite(ray).all()
    }


def place_by_links(
    count: int, root: int, links: Mapping[tuple[int, int], Alignment]
) -> dict[int, Sim3]:
    """Place submodels in the frame of the root, along a maximum spanning tree (Prim)."""
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
            placed[j] = placed[i] @ link.target_from_source
        else:
            placed[i] = placed[j] @ link.target_from_source.inverse()
    return placed


def _place_by_gps(
    submodels: Sequence[Submodel],
    placed: dict[int, Sim3],
    root: int,
    priors: Priors,
    remarks: list[str],
) -> None:
    """Place submodels without links, if their positions and those of the root are good enough."""
    missing = [i for i in range(len(submodels)) if i not in placed]
    if not missing or not priors.enu:
        return
    base = _frame_by_gps(submodels[root], priors, remarks)
    if base is None:
        return
    for i in missing:
        found = _frame_by_gps(submodels[i], priors, remarks)
        if found is None:
            continue
        placed[i] = base.enu_from_model.inverse() @ found.enu_from_model
        remarks.append(
            f"{submodels[i].label}: not linked to the others by matches; placed by GPS alone, rms "
            f"residual {found.rms:.2f} m"
        )


def _frame_by_gps(submodel: Submodel, priors: Priors, remarks: list[str]) -> GpsAlignment | None:
    found = gps_alignment(submodel.model, priors)
    if found is None or not found.is_useful or found.inliers.sum() < MIN_POSITIONS:
        remarks.append(f"{submodel.label}: its GPS does not determine a frame")
        return None
    return found
