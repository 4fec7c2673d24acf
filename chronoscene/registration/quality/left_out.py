"""Control points without their own coordinates: what the others say about them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chronoscene.arrays import Array
from chronoscene.registration.quality.thresholds import Objection, Threshold, check
from chronoscene.registration.result import Registered


def errors_left_out(model: Registered) -> dict[str, tuple[Array, Array]]:
    """Error of each control point without its coordinates, and its standard deviations."""
    found = {} if model.resection is None else model.resection.left_out
    return {k: (np.array(v[0]), np.array(v[1])) for k, v in found.items() if v is not None}


def contradicted(model: Registered, threshold: Threshold) -> Iterator[Objection]:
    """Objections to control points that lie elsewhere than the others say."""
    for name, (error, spread) in errors_left_out(model).items():
        ratio = float(np.abs(error / np.maximum(spread, 1e-9)).max())
        distance, left = np.linalg.norm(error), np.linalg.norm(spread)
        note = f" ({distance:.3g} m, of which the others leave {left:.2g} m open)"
        yield from check(threshold, ratio, f"control point {name}", "left_out", note)


def not_fixed(model: Registered, threshold: Threshold, pixel: float | None) -> Iterator[Objection]:
    """An objection where the other points fix one only roughly, so that it proves nothing.

    Args:
        model: The registration.
        threshold: Limit of errors, ground pixels.
        pixel: Metres that a pixel covers.
    """
    errors = errors_left_out(model)
    spread = {name: float(np.linalg.norm(errors[name][1])) for name in errors}
    for name in model.resection.left_out if model.resection is not None else ():
        spread.setdefault(name, float("inf"))
    worst = max(spread, key=lambda name: spread[name], default="")
    if spread and spread[worst] > (pixel or 0.0) * (threshold.fail or 0.0):
        how = f"{spread[worst]:.2g} m" if worst in errors else "any distance"
        yield Objection(
            "doubtful", "independent", "control points",
            f"the others leave {how} of {worst} open, where its coordinates are unknown",
            "a point that the others do not fix cannot confirm them",
            "mark more control points, spread over the photos, or set some aside as check points",
        )  # fmt: skip


def precision(model: Registered) -> str:
    """Standard deviations of the poses in words."""
    if model.resection is None:
        return ""
    if not model.resection.deviations:
        return " The control points do not fix all poses."
    spreads = list(model.resection.deviations.values())
    centre = max(float(np.linalg.norm(c)) for c, _ in spreads)
    turn = max(max(angles) for _, angles in spreads)
    return (
        f" By the adjustment, every camera is known to {centre:.2g} m and {turn:.2g} degrees or "
        "better (one standard deviation)."
    )
