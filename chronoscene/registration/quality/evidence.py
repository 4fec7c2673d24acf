"""What the figures of a certificate rest on, computed once: rays, and points placed by them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from chronoscene.registration.quality.rays import (
    Ints,
    Mask,
    Placed,
    Rays,
    held_out_rays,
    place,
    rays_at,
)
from chronoscene.registration.result import Registered
from chronoscene.scene.tracks import seen_by_period, track_owners

MAX_OBSERVATIONS = 200_000
"""Observations by which the cloud of a period is placed, those of tie points by which a pair is
measured, and those whose error is taken: a sample where there are more."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Observations of a registration as rays, and the points that each period places alone.

    A point that several periods place together would fit all of them by construction.
    """

    seen: Mask
    """Whether an image of the period sees the point. [P, T]"""
    observed: tuple[Rays, ...]
    """A sample of the observations of each period, whatever their points. A track is the index of
    a point here, in `ties` and in `clouds`."""
    clouds: tuple[Placed, ...]
    """A sample of the points of each period, placed by its images."""
    ties: Rays
    """A sample of the points that several periods see."""
    ties_placed: tuple[Placed, ...]
    """Those of the ties that each period places."""
    held_out: Rays
    """Tracks that took no part in the estimation."""
    held_out_placed: tuple[Placed, ...]
    matches: tuple[tuple[Rays, Rays], ...]
    """Both ends of each of the `Registered.held_out`."""


def gather(model: Registered) -> Evidence:
    """Unproject every observation that is used, and place every point once in each period."""
    periods = range(model.num_periods)
    point, period = track_owners(model.track_start), model.periods[model.track_image]
    seen = seen_by_period(point, period, (len(model.points), model.num_periods))
    length = np.diff(model.track_start)
    in_clouds = np.zeros_like(seen)
    for p in periods:
        in_clouds[_sample(np.flatnonzero(seen[:, p]), length, MAX_OBSERVATIONS), p] = True
    is_tie = np.zeros(len(seen), bool)
    shared = np.flatnonzero(seen.sum(axis=1) > 1)
    is_tie[_sample(shared, length, MAX_OBSERVATIONS * max(1, len(periods) - 1))] = True
    observed = []
    for p in periods:
        rows = np.flatnonzero(period == p)
        observed.append(rows[:: len(rows) // MAX_OBSERVATIONS + 1])

    needed = in_clouds[point, period] | is_tie[point]
    to_place = needed.copy()
    needed[np.concatenate([np.zeros(0, np.int64), *observed])] = True
    rows = np.flatnonzero(needed)
    rays = rays_at(model, point[rows], model.track_image[rows], model.track_xy[rows])
    whole = rays.where(to_place[rows]).finite()
    own = [place(whole.where(model.periods[whole.image] == p)) for p in periods]
    held_out = held_out_rays(model)
    return Evidence(
        seen=seen,
        observed=tuple(rays.where(np.searchsorted(rows, mine)) for mine in observed),
        clouds=tuple(placed.of(in_clouds[:, p]) for p, placed in enumerate(own)),
        ties=whole.where(is_tie[whole.track]),
        ties_placed=tuple(placed.of(is_tie) for placed in own),
        held_out=held_out,
        held_out_placed=tuple(
            place(held_out.where(model.periods[held_out.image] == p)) for p in periods
        ),
        matches=_matches(model),
    )


def _sample(points: Ints, length: Ints, most: int) -> Ints:
    """Every n-th of some points, so that they have about ``most`` observations."""
    return points[:: int(length[points].sum()) // most + 1]


def _matches(model: Registered) -> tuple[tuple[Rays, Rays], ...]:
    counts = np.array([len(m.xy_a) for m in model.held_out], np.int64)
    ends = np.concatenate([[0], np.cumsum(counts)])
    image = [m.image_a for m in model.held_out] + [m.image_b for m in model.held_out]
    xy = [m.xy_a for m in model.held_out] + [m.xy_b for m in model.held_out]
    images = np.repeat(np.array(image, np.int64), np.tile(counts, 2))
    rays = rays_at(model, images, images, np.concatenate([np.zeros((0, 2)), *xy]))
    first, second = (rays.where(np.arange(ends[-1]) + shift) for shift in (0, ends[-1]))
    slices = [np.arange(a, b) for a, b in pairwise(ends)]
    return tuple((first.where(rows), second.where(rows)) for rows in slices)
