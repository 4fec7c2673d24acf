"""Similarities between models that share no image, and between a model and GPS.

Between models, pairs of 3D points come from matches across them. Residuals are measured in pixels,
in both images of a match, because a threshold in world units means nothing in a model of unknown
scale and treats near and far points alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.registration.reconstruct.place_consensus import (
    cell_members,
    cell_weights,
    cells,
    draw,
)
from chronoscene.scene.geometry import Sim3, camera_centre
from chronoscene.scene.similarity import Similarity, fit, fit_robustly

TRIALS = 1_000
MOST_JUDGED = 4_000
"""Matches by which a trial is judged."""

SEARCH_PIXELS = 16.0
"""Residual of an inlier while searching: points of two models of their own are this uncertain."""

FINAL_PIXELS = 8.0
"""Residual of an inlier in the end."""

LEAST_INLIERS = 15
LEAST_CELLS = 4
"""Fewer, or all in few places, do not fix a similarity that can be trusted."""

MOST_SCALE_ERROR = 0.1
"""Relative standard deviation of the scale above which GPS says nothing useful about it."""

LINE_RATIO = 0.05
"""Cameras that spread less than this across their line do not fix the rotation around it."""


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """The same places in two models: M pairs, each with the observation that joined them."""

    source: NDArray[np.float64]
    """Points of the model that is to be moved. [M, 3]"""
    target: NDArray[np.float64]
    """[M, 3]"""
    source_pose: NDArray[np.float64]
    """``cam_from_world`` of the image that sees the source point, in its own model. [M, 4, 4]"""
    target_pose: NDArray[np.float64]
    """[M, 4, 4]"""
    source_ray: NDArray[np.float64]
    """Where it is seen, at depth 1 without distortion. [M, 2]"""
    target_ray: NDArray[np.float64]
    source_focal: NDArray[np.float64]
    """Pixels. [M]"""
    target_focal: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.source)

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> PointPairs:
        return PointPairs(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How one model lies in another."""

    target_from_source: Sim3
    inliers: NDArray[np.bool_]
    """[M]"""
    cells: int
    """Places in which there are inliers."""
    median_pixels: float
    """Median residual of the inliers."""

    @property
    def is_trustworthy(self) -> bool:
        """Whether enough pairs in enough places agree."""
        return int(self.inliers.sum()) >= LEAST_INLIERS and self.cells >= LEAST_CELLS


def align_by_points(pairs: PointPairs, *, seed: int = 0) -> Alignment | None:
    """Similarity on which most places agree; None if there is nothing to agree on."""
    if len(pairs) < 3:
        return None
    rng = np.random.default_rng(seed)
    cell = cells(pairs.target)
    members, weights = cell_members(cell), cell_weights(cell)
    judges = np.arange(len(pairs))
    if len(judges) > MOST_JUDGED:
        judges = rng.choice(len(judges), MOST_JUDGED, replace=False)
    judged, judged_weights = pairs.select(judges), weights[judges]
    best, most = None, 0.0
    for _ in range(TRIALS):
        sample = draw(rng, members, 3) if len(members) >= 3 else rng.choice(len(pairs), 3, False)
        candidate = _fit(pairs.source[sample], pairs.target[sample]) if sample is not None else None
        if candidate is None:
            continue
        agreed = float(judged_weights[residual_pixels(candidate, judged) < SEARCH_PIXELS].sum())
        if agreed > most:
            best, most = candidate, agreed
    return None if best is None else _polish(pairs, best, cell)


def _polish(pairs: PointPairs, best: Sim3, cell: NDArray[np.int64]) -> Alignment | None:
    """Least squares over the inliers, with a threshold that shrinks."""
    inliers = residual_pixels(best, pairs) < SEARCH_PIXELS
    for limit in (SEARCH_PIXELS, SEARCH_PIXELS, FINAL_PIXELS, FINAL_PIXELS):
        if inliers.sum() < 3:
            return None
        better = _fit(pairs.source[inliers], pairs.target[inliers])
        if better is None:
            return None
        now = residual_pixels(better, pairs) < limit
        if limit == SEARCH_PIXELS and now.sum() < inliers.sum():
            now = residual_pixels(best, pairs) < limit  # far points pull at a 3D fit
        else:
            best = better
        inliers = now
    residual = residual_pixels(best, pairs)
    median = float(np.median(residual[inliers])) if inliers.any() else np.inf
    return Alignment(best, inliers, len(np.unique(cell[inliers])), median)


def residual_pixels(target_from_source: Sim3, pairs: PointPairs) -> NDArray[np.float64]:
    """Larger of the two reprojection errors of each pair: each point in the other's image. [M]"""
    in_target = target_from_source.apply(pairs.source)
    in_source = target_from_source.inverse().apply(pairs.target)
    a = _reprojection(pairs.target_pose, in_target, pairs.target_ray) * pairs.target_focal
    b = _reprojection(pairs.source_pose, in_source, pairs.source_ray) * pairs.source_focal
    return np.maximum(a, b)


def _reprojection(
    poses: NDArray[np.float64], points: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance at depth 1; infinite behind the camera. [M]"""
    local = np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
    depth = local[:, 2]
    ahead = depth > 1e-12
    projected = local[:, :2] / np.where(ahead, depth, 1.0)[:, None]
    return np.where(ahead, np.linalg.norm(projected - rays, axis=1), np.inf)


def _fit(source: NDArray[np.float64], target: NDArray[np.float64]) -> Sim3 | None:
    found = fit(source, target)
    return None if found is None else as_sim3(found)


def as_sim3(similarity: Similarity) -> Sim3:
    """The same transformation as scale, rotation and translation."""
    scale = similarity.scale
    return Sim3(scale, similarity.matrix / scale, similarity.translation)


@dataclass(frozen=True, slots=True, eq=False)
class GpsAlignment:
    """How a model lies in the frame of the GPS positions."""

    enu_from_model: Sim3
    inliers: NDArray[np.bool_]
    """Positions that agree with the model. [N]"""
    residuals: NDArray[np.float64]
    """Metres, NaN without a position. [N]"""
    rms: float
    """Of the inliers, metres."""
    scale_error: float
    """Relative standard deviation of the scale, from the residuals."""
    on_a_line: bool
    """Whether the rotation around the line of the cameras came from the horizon of the photos."""

    @property
    def is_useful(self) -> bool:
        """Whether the positions say enough about scale and rotation."""
        return bool(self.inliers.sum() >= 3 and self.scale_error < MOST_SCALE_ERROR)


def align_to_gps(
    poses: NDArray[np.float64], enu: NDArray[np.float64], believed: NDArray[np.bool_]
) -> GpsAlignment | None:
    """Robust similarity from camera centres to GPS positions.

    Args:
        poses: ``cam_from_world`` of the model. [N, 4, 4]
        enu: Metres; NaN where unknown. [N, 3]
        believed: Positions to use. [N]

    Returns:
        None with fewer than three positions.
    """
    centres = camera_centre(poses)
    use = np.flatnonzero(believed & np.isfinite(enu).all(axis=1))
    if len(use) < 3:
        return None
    similarity = _first_guess(poses[use], enu[use])
    if similarity is None:
        return None
    residuals = np.full(len(enu), np.nan)
    on_a_line = False
    for _ in range(3):
        residuals[use] = np.linalg.norm(similarity.apply(centres[use]) - enu[use], axis=1)
        limit = 4.0 * max(float(np.nanmedian(residuals)), 1e-9)
        near = use[residuals[use] <= limit]
        on_a_line = is_line(enu[near])
        refined = _fit_with_horizon(poses[near], enu[near]) if on_a_line else None
        refined = refined or _fit(centres[near], enu[near])
        if refined is None:
            break
        similarity = refined
    inliers = np.zeros(len(enu), bool)
    inliers[near] = True
    rms = float(np.sqrt(np.mean(residuals[near] ** 2)))
    spread = float(np.sqrt(((enu[near] - enu[near].mean(axis=0)) ** 2).sum(axis=1).mean()))
    scale_error = rms / max(spread * np.sqrt(len(near)), 1e-12)
    return GpsAlignment(similarity, inliers, residuals, rms, scale_error, on_a_line)


def _first_guess(poses: NDArray[np.float64], enu: NDArray[np.float64]) -> Sim3 | None:
    """Similarity on which most positions agree, whatever it does around a line."""
    centres = camera_centre(poses)
    result = fit_robustly(centres, enu)
    if result is not None:
        return as_sim3(result[0])
    best: Sim3 | None = None
    for i in range(len(enu)):  # all on one line exactly: any two fix scale and direction
        pair = [i, (i + len(enu) // 2) % len(enu)]
        guess = _fit_with_horizon(poses[pair], enu[pair])
        if guess is not None and (
            best is None
            or _median_distance(guess, centres, enu) < _median_distance(best, centres, enu)
        ):
            best = guess
    return best


def _median_distance(sim: Sim3, centres: NDArray[np.float64], enu: NDArray[np.float64]) -> float:
    return float(np.median(np.linalg.norm(sim.apply(centres) - enu, axis=1)))


def is_line(positions: NDArray[np.float64]) -> bool:
    """Whether positions lie along a line, on the map."""
    flat = positions[:, :2] - positions[:, :2].mean(axis=0)
    values = np.linalg.svd(flat, compute_uv=False)
    return bool(values[-1] < LINE_RATIO * values[0])


def _fit_with_horizon(poses: NDArray[np.float64], enu: NDArray[np.float64]) -> Sim3 | None:
    """Similarity in which the photos also stand upright, or else look straight down.

    Each camera gets a second point above it, as far up as the cameras are spread along the line.
    Photos of one heading fit both; what the positions say of the bends in the line decides.
    """
    forward = poses[:, 2, :3].mean(axis=0)
    down = -forward / max(float(np.linalg.norm(forward)), 1e-12)
    found = [_fit_upwards(poses, enu, up) for up in (upright_direction(poses), down)]
    centres = camera_centre(poses)
    return min(
        (sim for sim in found if sim is not None),
        key=lambda sim: float(np.linalg.norm(sim.apply(centres) - enu)),
        default=None,
    )


def _fit_upwards(
    poses: NDArray[np.float64], enu: NDArray[np.float64], up: NDArray[np.float64]
) -> Sim3 | None:
    centres = camera_centre(poses)
    model_spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    world_spread = float(np.linalg.norm(enu - enu.mean(axis=0), axis=1).mean())
    source = np.concatenate([centres, centres + model_spread * up])
    target = np.concatenate([enu, enu + world_spread * np.array([0.0, 0.0, 1.0])])
    return _fit(source, target)


def upright_direction(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector that is up, if photos are taken without roll. [3]

    The horizontal axes of all images lie in the horizontal plane; where they are all parallel, the
    mean upward axis of the images decides.
    """
    right, down, forward = (poses[:, i, :3] for i in range(3))
    values, vectors = np.linalg.eigh(right.T @ right / len(poses))
    up = vectors[:, 0] if values[1] > 0.05 else -down.mean(axis=0)
    sense = float(-(down @ up).mean() - (forward @ up).mean())
    up = up if sense >= 0 else -up
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))
