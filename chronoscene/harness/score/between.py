"""Images between two dates: do pixels show one of the dates, or blends that never existed?

A scene that is photographed at dates is not known in between, but each thing in it looks as on one
date or the other most of the time. A model that crosses the gap by blending shows trees half green
and buildings half there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Mask, Pixels
from chronoscene.harness.files.records import RunRecord

FRACTIONS = (0.25, 0.5, 0.75)
"""Times in between, 0 at the first date and 1 at the second."""


@dataclass(frozen=True, slots=True)
class BetweenScore:
    """Distance of images between two dates from those of the dates, by the same method.

    With d(I, J) of a pixel the norm of the difference of colours by the root of 3, and the means
    over the changing pixels of all views:

        distance = mean over t of sqrt(mean(min(d(I(t), I(a)), d(I(t), I(b)))^2))
        change   = sqrt(mean(d(I(a), I(b))^2))
    """

    distance: float
    """Distance to the nearer date, mean over the times of the RMS over pixels and views."""
    change: float
    """RMS distance between the two dates themselves, over the same pixels."""

    @classmethod
    def of(cls, sums: Array, pixels: int) -> BetweenScore | None:
        """Make the score from the sums of `squared_distances` over views; None without pixels."""
        if pixels == 0:
            return None
        roots = np.sqrt(sums / pixels)
        return cls(float(roots[:-1].mean()), float(roots[-1]))

    @property
    def ratio(self) -> float:
        """``distance`` per ``change``; NaN if the method shows the same on both dates."""
        return self.distance / self.change if self.change > 0 else np.nan


@dataclass(frozen=True, slots=True)
class MethodBetween:
    """A method between two dates: its images of one camera, and its score over all views."""

    record: RunRecord
    """The run that was rendered."""
    images: tuple[Pixels | None, ...]
    """At the first date, at `FRACTIONS` and at the second; None for what it cannot render."""
    score: BetweenScore | None
    """None if it knows no periods in between, or no pixel changes."""


@dataclass(frozen=True, slots=True)
class SceneBetween:
    """All methods on a scene between two dates."""

    scene: str
    dates: tuple[int, int]
    labels: dict[str, str]
    """Labels of periods by their ids."""
    view: str
    """View whose camera is shown."""
    truths: tuple[Pixels | None, Pixels | None]
    """Photo of this camera and what it would have seen at the other date; None where unknown."""
    methods: tuple[MethodBetween, ...]
    pixels: int
    """Number of changing pixels in all views."""
    from_truth: bool
    """True if they are those of change masks of the scene; else the renders tell."""


def color_distance(a: Pixels, b: Pixels) -> Array:
    """Norm of the difference of colours per pixel; 1 between black and white. [H, W]"""
    difference = (a.astype(np.float64) - b) / 255.0
    return np.sqrt((difference**2).mean(axis=2))


def squared_distances(images: Sequence[Pixels], mask: Mask) -> Array:
    """Sum squared distances of colours over the changing pixels of a view.

    Args:
        images: At the first date, at times in between, and at the second. [H, W, 3] each
        mask: Pixels that change between the dates. [H, W]

    Returns:
        For each time in between, to the nearer date of each pixel; then between the dates. [T + 1]
    """
    first, *middle, last = images
    nearer = [np.minimum(color_distance(i, first), color_distance(i, last)) for i in middle]
    return np.array([(d[mask] ** 2).sum() for d in (*nearer, color_distance(first, last))])
