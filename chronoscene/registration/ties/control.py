"""Ground control against a model: what agrees, what contradicts the rest, adjustment with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.residuals import clicks_of, place_clicks
from chronoscene.registration.ties.tie_points import TiePoints
from chronoscene.scene.similarity import Sim3, fit, fit_few

LIMIT = 3.0  # Standard deviations within which coordinates agree with a model

AGREEING = 5.0
"""Factor by which a point must spoil the fit of the others to be named as contradicting them."""

CONTRADICTION = "control contradicts itself: "
"""Start of the remarks on points that `contradictions` names."""

LEAST_SIGMA = 0.02
"""World units: control without a stated accuracy is not taken to be better than this."""


def fit_control(
    source: Array, target: Array, sigma: Sequence[Array | None]
) -> tuple[Sim3, Mask] | None:
    """Fit a similarity to control; return it and the points used, None if undetermined.

    Points stated to be rough are not wrong where others fit better.

    Args:
        source: Places in the model. [N, 3]
        target: Surveyed coordinates. [N, 3]
        sigma: Stated standard deviations of these, or None. [N]
    """
    found = fit_few(source, target)
    if found is None:
        return None
    move, used = found
    stated = np.array([0.0 if s is None else float(np.linalg.norm(s)) for s in sigma])
    distance = np.linalg.norm(move.apply(source) - target, axis=1)
    return move, np.asarray(used | (distance <= LIMIT * stated))


def contradictions(names: Sequence[str], source: Array, target: Array) -> list[str]:
    """Name points without which the others fit a similarity far better, with both errors.

    Args:
        names: [N]
        source: Places in the model. [N, 3]
        target: Surveyed coordinates in metres. [N, 3]
    """
    whole = fit(source, target)
    if whole is None or len(names) < 4:
        return []
    before = _rms(whole.apply(source) - target)
    found = []
    for i, name in enumerate(names):
        rest = np.arange(len(names)) != i
        without = fit(source[rest], target[rest])
        if without is None:
            continue
        errors = without.apply(source) - target
        own, others = float(np.linalg.norm(errors[i])), _rms(errors[rest])
        if others * AGREEING < before and own > AGREEING * others:
            found.append(
                (others, f"{name} is {own:.3g} m off, and the others fit to {others:.2g} m")
            )
    return [text for _, text in sorted(found)]


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def control_arguments(
    model: Registered, points: TiePoints, used: Sequence[str]
) -> list[dict[str, Any]]:
    """Control for `adjustment.adjust_with_control`.

    Without a stated accuracy, a point counts as exact as the similarity fits all of these.

    Args:
        model: In the frame of the control.
        points: All points.
        used: Names of the control to adjust with.
    """
    clicks, _ = clicks_of(model, points)
    known, sigma = points.located(model.georeference), points.sigmas()
    placed = place_clicks(clicks.rays)
    names = [clicks.names[t] for t in placed.track]
    misfit = [xyz - known[n] for n, xyz in zip(names, placed.xyz, strict=True) if n in used]
    square = np.mean(np.square(misfit), axis=0) if misfit else np.zeros(3)
    level = np.sqrt([square[:2].mean(), square[:2].mean(), square[2]])
    result = []
    for name in used:
        rows = np.flatnonzero(clicks.rays.track == clicks.names.index(name)).tolist()
        image = [model.names[i] for i in clicks.rays.image[rows].tolist()]
        result.append(
            {
                "name": name,
                "xyz": known[name].tolist(),
                "sigma": sigma.get(name, np.maximum(level, LEAST_SIGMA)).tolist(),
                "clicks": [[n, *clicks.xy[i].tolist()] for n, i in zip(image, rows, strict=True)],
            }
        )
    return result


def keep_positions(adjusted: Registered, model: Registered) -> Registered:
    """Give an adjusted model the GPS positions of the one before, by image."""
    row = {name: i for i, name in enumerate(model.names)}
    rows = [row[name] for name in adjusted.names]
    return replace(
        adjusted,
        georeference=model.georeference,
        gps_enu=model.gps_enu[rows],
        gps_used=model.gps_used[rows],
    )
