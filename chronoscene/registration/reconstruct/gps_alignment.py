"""A model against the GPS positions of its images, and in their frame. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.alignment import fit_sim3
from chronoscene.registration.reconstruct.models import as_pycolmap, image_pose, sorted_ids
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3, fit_robustly, scale_deviation

MAX_SCALE_ERROR = 0.1
"""Relative standard deviation of the scale above which GPS does not determine it."""

MAX_METRE_ERROR = 0.05
"""The same, above which the unit of a model is not called a metre."""

MAX_TILT_ERROR = 1.5
"""Degrees. Heights that leave a larger tilt open say less about it than the horizon of the photos:
those of many drones and phones scatter over tens of metres."""

PRECISE_SHARE, PRECISE_FACTOR = 0.3, 4.0
"""Positions count if their stated deviation is at most so many times that of the best ones, of
which there is this share: those with RTK among others, phones with a clear view of the sky."""

LINE_RATIO = 0.05
"""Cameras that spread less than this across their line do not fix the rotation around it."""


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """GPS positions by image name."""

    enu: Mapping[str, Sequence[float]]
    """Metres."""
    sigma: Mapping[str, Sequence[float]]
    """Metres."""

    @classmethod
    def of(cls, data: Mapping[str, Any] | None) -> Priors:
        return cls({}, {}) if data is None else cls(data["enu"], data["sigma"])


@dataclass(frozen=True, slots=True, eq=False)
class GpsAlignment:
    """Alignment of a model to the frame of the GPS positions."""

    enu_from_model: Sim3
    inliers: Mask
    """Positions that agree with the model. [N]"""
    residuals: Array
    """Metres, NaN without a position. [N]"""
    rms: float
    """Root mean square residual of the inliers, metres; horizontal, if heights are not used."""
    axes: Array
    """The same per axis: east, north and up. [3]"""
    scale_error: float
    """Relative standard deviation of the scale, from the residuals."""
    on_a_line: bool
    """True if the cameras lie on a line, and the rotation around it is that of the horizon."""
    by_horizon: bool
    """True if heights are too noisy to say how the model is tilted: its horizon is level."""

    @property
    def is_useful(self) -> bool:
        """True if the positions determine scale and rotation well enough."""
        return bool(self.inliers.sum() >= 3 and self.scale_error < MAX_SCALE_ERROR)


def align_to_gps(poses: Array, enu: Array) -> GpsAlignment | None:
    """Fit a robust similarity from camera centres to GPS positions.

    Args:
        poses: ``cam_from_world`` of the model. [N, 4, 4]
        enu: Metres; NaN where unknown. [N, 3]

    Returns:
        None with fewer than three positions.
    """
    use = np.flatnonzero(np.isfinite(enu).all(axis=1))
    if len(use) < 3:
        return None
    found = _in_space(poses, enu, use)
    tilt = np.inf if found is None else _tilt_error(found, enu)
    if (found is None or not found.on_a_line) and tilt > MAX_TILT_ERROR:
        found = _by_horizon(poses, enu, use) or found
    return found


def _in_space(poses: Array, enu: Array, use: Ints) -> GpsAlignment | None:
    """Fit to positions in all three axes."""
    centres = camera_centre(poses)
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
        refined = refined or fit_sim3(centres[near], enu[near])
        if refined is None:
            break
        similarity = refined
    return _described(similarity, centres, enu, near, on_a_line=on_a_line)


def _described(
    similarity: Sim3,
    centres: Array,
    enu: Array,
    near: Ints,
    *,
    on_a_line: bool = False,
    by_horizon: bool = False,
) -> GpsAlignment:
    """An alignment and its residuals; `near` are the inliers."""
    difference = similarity.apply(centres) - enu
    inliers = np.zeros(len(enu), bool)
    inliers[near] = True
    used = 2 if by_horizon else 3
    axes = np.sqrt(np.mean(difference[near] ** 2, axis=0))
    return GpsAlignment(
        enu_from_model=similarity,
        inliers=inliers,
        residuals=np.linalg.norm(difference[:, :used], axis=1),
        rms=float(np.linalg.norm(axes[:used])),
        axes=axes,
        scale_error=scale_deviation(difference[near, :used], enu[near, :used]),
        on_a_line=on_a_line,
        by_horizon=by_horizon,
    )


def _tilt_error(found: GpsAlignment, enu: Array) -> float:
    """Standard deviation of the tilt that heights leave open, in degrees."""
    flat = enu[found.inliers][:, :2]
    across = float(np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)[-1])
    return float(np.degrees(np.arctan2(found.axes[2], across)))


def _by_horizon(poses: Array, enu: Array, use: Ints) -> GpsAlignment | None:
    """Fit to horizontal positions, with the horizon of the photos level.

    Photos are upright, or on their side, or look down: what fits the positions best.
    """
    flat = np.array([1.0, 1.0, 0.0])
    centres = camera_centre(poses)
    best: tuple[float, Sim3, Ints] | None = None
    for up in _possible_ups(poses[use]):
        turn = _turn_up(up)
        upright = centres @ turn.T
        found = fit_robustly(upright[use] * flat, enu[use] * flat)
        if found is None or found[0].matrix[2, 2] <= 0:
            continue  # a plan that fits from below only
        plan, distance = found[0].to_sim3(), found[1]
        median = max(float(np.median(distance)), 1e-9)
        if best is None or median < best[0]:
            near = use[distance <= 4.0 * median]
            height = np.median(enu[near, 2] - plan.scale * upright[near, 2])
            shift = np.array([*plan.translation[:2], height])
            best = median, Sim3(plan.scale, plan.rotation @ turn, shift), near
    if best is None:
        return None
    return _described(best[1], centres, enu, best[2], by_horizon=True)


def _possible_ups(poses: Array) -> list[Array]:
    """Upward directions of a model, in the order in which they are likely."""
    down = -poses[:, 2, :3].mean(axis=0)
    aside = poses.copy()  # photos on their side, as phones store them
    aside[:, 0, :3], aside[:, 1, :3] = poses[:, 1, :3], -poses[:, 0, :3]
    turned = upright_direction(aside)
    return [up for up in (upright_direction(poses), down, turned, -turned) if up.any()]


def _turn_up(up: Array) -> Array:
    """Rotation that takes a direction to the zenith. [3, 3]"""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.align_vectors([[0, 0, 1]], [up])[0].as_matrix())


def _first_guess(poses: Array, enu: Array) -> Sim3 | None:
    """Fit a similarity on which most positions agree; on a line, its rotation may be wrong."""
    centres = camera_centre(poses)
    result = fit_robustly(centres, enu)
    if result is not None:
        return result[0].to_sim3()
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


def _median_distance(sim: Sim3, centres: Array, enu: Array) -> float:
    return float(np.median(np.linalg.norm(sim.apply(centres) - enu, axis=1)))


def is_line(positions: Array) -> bool:
    """Return True if positions lie along a line, seen from above."""
    flat = positions[:, :2] - positions[:, :2].mean(axis=0)
    values = np.linalg.svd(flat, compute_uv=False)
    return bool(values[-1] < LINE_RATIO * values[0])


def _fit_with_horizon(poses: Array, enu: Array) -> Sim3 | None:
    """Fit a similarity in which the photos also are upright, or look straight down.

    Each camera gets a second point above it, as far up as the cameras are spread along the line.
    Photos of one heading fit both; the bends of the line decide.
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


def _fit_upwards(poses: Array, enu: Array, up: Array) -> Sim3 | None:
    centres = camera_centre(poses)
    model_spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    world_spread = float(np.linalg.norm(enu - enu.mean(axis=0), axis=1).mean())
    source = np.concatenate([centres, centres + model_spread * up])
    target = np.concatenate([enu, enu + world_spread * np.array([0.0, 0.0, 1.0])])
    return fit_sim3(source, target)


def upright_direction(poses: Array) -> Array:
    """Upward unit vector, for photos taken without roll. [3]

    The horizontal axes of all images lie in the horizontal plane; where they are all parallel, the
    mean upward axis of the images decides.
    """
    right, down, forward = (poses[:, i, :3] for i in range(3))
    values, vectors = np.linalg.eigh(right.T @ right / len(poses))
    up = vectors[:, 0] if values[1] > 0.05 else -down.mean(axis=0)
    sense = float(-(down @ up).mean() - (forward @ up).mean())
    up = up if sense >= 0 else -up
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))


def gps_alignment(model: pycolmap.Reconstruction, priors: Priors) -> GpsAlignment | None:
    """Align a model to the frame of the priors; rows in the order of `sorted_ids`."""
    ids = sorted_ids(model)
    names = [str(model.images[i].name) for i in ids]
    nowhere = [np.nan] * 3
    enu = np.array([priors.enu.get(name, nowhere) for name in names], np.float64).reshape(-1, 3)
    sigma = np.array([priors.sigma.get(name, nowhere)[0] for name in names])
    if np.isfinite(sigma).any():
        enu[sigma > PRECISE_FACTOR * np.nanquantile(sigma, PRECISE_SHARE)] = np.nan
    poses = np.stack([image_pose(model.images[i]) for i in ids])
    return align_to_gps(poses, enu)


def to_gps_frame(
    model: pycolmap.Reconstruction, priors: Priors, remarks: list[str]
) -> tuple[bool, Priors]:
    """Transform a model into the frame of its GPS positions if they determine one.

    Args:
        model: Changed in place.
        priors: Positions of its images.
        remarks: Added to.

    Returns:
        Whether it was transformed, and the priors that agree with the model.
    """
    nothing = Priors({}, {})
    if not priors.enu:
        remarks.append("no GPS: the scale and the frame are arbitrary")
        return False, nothing
    found = gps_alignment(model, priors)
    if found is None:
        remarks.append("fewer than 3 registered photos have GPS: no frame")
        return False, nothing
    horizontal, vertical = float(np.linalg.norm(found.axes[:2])), float(found.axes[2])
    remark = (
        f"GPS against poses: rms {horizontal:.2f} m horizontal, {vertical:.2f} m vertical, scale "
        f"known to {found.scale_error:.1%}"
    )
    if found.scale_error >= MAX_METRE_ERROR or not found.is_useful:
        remarks.append(f"{remark}: not accurate enough for metres; the model keeps its own scale")
        return False, nothing
    remarks.append(remark)
    model.transform(as_pycolmap(found.enu_from_model))
    if found.on_a_line:
        remarks.append("cameras lie on a line: the rotation around it is taken from the horizon")
    if found.by_horizon:
        remarks.append("GPS heights are too noisy to level the model: its horizon is level instead")
    names = [str(model.images[i].name) for i in sorted_ids(model)]
    for name, residual, good in zip(names, found.residuals, found.inliers, strict=True):
        if np.isfinite(residual) and not good:
            remarks.append(f"{name}: GPS is {residual:.1f} m from its pose: not used")
    return True, _agreeing(model, priors, found)


def _agreeing(model: pycolmap.Reconstruction, priors: Priors, found: GpsAlignment) -> Priors:
    """The priors of inliers of an aligned model, as uncertain as their residuals.

    What receivers state is optimistic: stated deviations are scaled to the residuals of this very
    model, along each axis. Heights that do not level the model are replaced by its own.
    """
    names = {str(model.images[i].name): i for i in sorted_ids(model)}
    agreeing = [name for name, good in zip(names, found.inliers, strict=True) if good]
    stated = np.array([priors.sigma[name] for name in agreeing])
    centres = np.array([model.images[names[name]].projection_center() for name in agreeing])
    position = np.array([priors.enu[name] for name in agreeing])
    if found.by_horizon:
        position[:, 2], stated[:, 2] = centres[:, 2], stated[:, 0]
    ratio = np.sqrt(np.mean(((centres - position) / stated) ** 2, axis=0))
    ratio[:2] = np.linalg.norm(ratio[:2]) / np.sqrt(2)
    if found.by_horizon:
        ratio[2] = ratio[0]
    sigma = np.maximum(stated * np.maximum(ratio, 1.0), 1e-3)
    return Priors(
        dict(zip(agreeing, position.tolist(), strict=True)),
        dict(zip(agreeing, sigma.tolist(), strict=True)),
    )
