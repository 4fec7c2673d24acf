"""Samples along rays: where the occupancy grid has something, and a few outside of the box."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import prange
from numpy import float32
from torch import Tensor

from chronoscene.fields.box import SceneBox, contract, contract_reference
from chronoscene.fields.mlp import Groups, make_groups
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.training import devices

NEAR = 0.01
"""Distance from the camera at which the first sample may be, in half edges of the cube."""
_BLOCK = 64  # Rays per task
_FAR = float32(1e9)
_TINY = float32(1e-9)
_MOST = 1 << 62
_LAST = float32(0.99999)  # Largest coordinate in the unit cube
ZERO, ONE, TWO = float32(0), float32(1), float32(2)


class Samples(NamedTuple):
    """Samples of some rays, near ones first."""

    places: Tensor
    """In the unit cube, contracted. [N, 3]"""
    lengths: Tensor
    """Lengths that they stand for, in half edges of the cube; contracted outside. [N]"""
    distances: Tensor
    """From the camera, in half edges of the cube. [N]"""
    groups: Groups
    """Samples of each ray."""


def march_reference(
    origins: Tensor,
    directions: Tensor,
    periods: Tensor,
    jitter: Tensor,
    grids: tuple[Tensor, ...],
    box: SceneBox,
    step: float,
    shells: int,
) -> Samples:
    """Place samples on rays in plain torch: the definition of `march`.

    It looks at each place where a sample could be; the kernel leaps over empty cells.
    """
    near, far = torch.full_like(jitter, NEAR), torch.full_like(jitter, float(_FAR))
    for o, d, side in zip(origins.unbind(1), directions.unbind(1), box.sides, strict=True):
        over = 1 / torch.where(d.abs() > float(_TINY), d, float(_TINY))
        a, b = (-side - o) * over, (side - o) * over
        near, far = near.maximum(torch.minimum(a, b)), far.minimum(torch.maximum(a, b))
    most = math.ceil(2 * math.hypot(*box.sides) / step) + 1
    numbers = torch.arange(most, device=jitter.device)
    inner_at = near[:, None] + (jitter[:, None] + numbers) * step
    start = torch.where(far > near, far, NEAR)[:, None]
    shares = torch.arange(shells + 1, device=jitter.device) / max(shells, 1)
    middles = (shares[:-1] + jitter[:, None] / max(shells, 1)).clamp_max(float(_LAST))
    edges = start + shares.clamp_max(float(_LAST)) / (1 - shares.clamp_max(float(_LAST)))
    outer_at = start + middles / (1 - middles)

    def places(at: Tensor) -> Tensor:
        return origins[:, None] + at[..., None] * directions[:, None]

    def occupied(unit: Tensor, grid: Tensor) -> Tensor:
        """Read the cells of places in a unit cube."""
        cells = grid.shape[1]
        i, j, k = (unit * cells).long().clamp(0, cells - 1).unbind(-1)
        return grid[periods[:, None], i, j, k] != 0

    inside = occupied((places(inner_at) + 1) / 2, grids[0]) & (inner_at < far[:, None])
    outside = occupied(contract_reference(places(outer_at)), grids[1])
    found = torch.cat((inside, outside), dim=1)
    ray, column = found.nonzero().unbind(1)
    # The contracted cube of edge 4 became the unit cube.
    lengths = 4 * contract_reference(places(edges)).diff(dim=1).norm(dim=2)
    lengths = torch.cat((torch.full_like(inner_at, step), lengths), dim=1)[ray, column]
    distances = torch.cat((inner_at, outer_at), dim=1)[ray, column]
    at = origins[ray] + distances[:, None] * directions[ray]
    starts = torch.cat((ray.new_zeros(1), found.sum(1).cumsum(0)))
    unit = contract_reference(at).clamp_max(float(_LAST))
    return Samples(unit, lengths, distances, Groups(starts, ray.int()))


def march(
    origins: Tensor,
    directions: Tensor,
    periods: Tensor,
    jitter: Tensor,
    grids: tuple[Tensor, ...],
    box: SceneBox,
    step: float,
    shells: int,
) -> Samples:
    """Place samples on rays: `march_reference`, compiled for float32 on a CPU.

    In the box they are ``step`` apart and lie in occupied cells. Behind it come ``shells`` others,
    at distances 1 s / (1 - s) for evenly spaced s, in occupied cells of the outer grid.

    Args:
        origins: Camera centres in the coordinates of the cube. [R, 3]
        directions: Unit vectors. [R, 3]
        periods: Period of each ray. int64 [R]
        jitter: Share of a step by which the samples of a ray are moved, 0..1. [R]
        grids: Occupied cells of the cube, and of the contracted unit cube. uint8 [T, G, G, G] each
        box: The box.
        step: In half edges of the cube.
        shells: Samples of a ray outside of the box, at most.
    """
    if not devices.has_kernels(origins, directions, jitter):
        return march_reference(origins, directions, periods, jitter, grids, box, step, shells)
    sides = np.array(box.sides, np.float32)
    rays = len(origins)
    starts = np.zeros(rays + 1, np.int64)
    nothing = np.empty((0, 3), np.float32), np.empty(0, np.float32), np.empty(0, np.float32)
    found = np.empty(rays, np.float32), np.empty(rays, np.int64)
    given = (x.numpy() for x in (origins, directions, periods, jitter, *grids))
    fixed = *given, sides, float32(step), shells, *found, starts
    _march(*fixed, False, *nothing)
    np.cumsum(starts, out=starts)
    count = int(starts[-1])
    places = np.empty((count, 3), np.float32)
    lengths, distances = np.empty(count, np.float32), np.empty(count, np.float32)
    _march(*fixed, True, places, lengths, distances)
    arrays = map(torch.from_numpy, (places, lengths, distances, starts))
    unit, sizes, along, firsts = arrays
    return Samples(unit, sizes, along, make_groups(firsts, count))


@inner(fast_math=True)
def _enter(ox, oy, oz, dx, dy, dz, sides):  # type: ignore[no-untyped-def]
    """Distances at which a ray enters and leaves the box; none if the first is larger."""
    near, far = float32(NEAR), _FAR
    for o, d, side in ((ox, dx, sides[0]), (oy, dy, sides[1]), (oz, dz, sides[2])):
        over = ONE / (d if abs(d) > _TINY else _TINY)
        a, b = (-side - o) * over, (side - o) * over
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far


@inner(fast_math=True)
def _leave_cell(x, d, cell):  # type: ignore[no-untyped-def]
    """Distance to the end of a cell along one axis; x in cells from the corner of the cube."""
    if abs(d) < _TINY:
        return _FAR
    edge = math.floor(x) + (ONE if d > ZERO else ZERO)
    return abs((edge - x) / d) * cell


@inner(fast_math=True)
def _outer_place(ox, oy, oz, dx, dy, dz, start, share):  # type: ignore[no-untyped-def]
    """Contracted place and distance of the share of the way from the box to infinity."""
    distance = start + share / (ONE - share)
    x, y, z = contract(ox + distance * dx, oy + distance * dy, oz + distance * dz)
    return x, y, z, distance


@kernel(fast_math=True, parallel=True)
def _march(  # type: ignore[no-untyped-def]
    origins, directions, periods, jitter, inside, outside, sides, step, shells, firsts, counts,
    starts, fill, places, lengths, distances,
):  # fmt: skip
    """Count the samples of each ray into ``starts[1:]``, or write them from ``starts`` on.

    Between the two passes ``firsts`` keeps the distance of the first sample in the box, and
    ``counts`` the number of those there: most of the way to it and behind the last is empty.
    """
    rays, cells, outer_cells = len(origins), inside.shape[1], outside.shape[1]
    half = float32(cells) / TWO
    cell = ONE / half
    for block in prange((rays + _BLOCK - 1) // _BLOCK):
        for ray in range(block * _BLOCK, min(rays, (block + 1) * _BLOCK)):
            ox, oy, oz = origins[ray]
            dx, dy, dz = directions[ray]
            period, at = periods[ray], starts[ray] if fill else 0
            near, far = _enter(ox, oy, oz, dx, dy, dz, sides)
            first, end = _FAR, at + counts[ray] if fill else _MOST
            t = firsts[ray] if fill else near + jitter[ray] * step
            while t < far and at < end:
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                gx, gy, gz = (x + ONE) * half, (y + ONE) * half, (z + ONE) * half
                i = min(max(int(gx), 0), cells - 1)
                j = min(max(int(gy), 0), cells - 1)
                k = min(max(int(gz), 0), cells - 1)
                if inside[period, i, j, k]:
                    first = min(first, t)
                    if fill:
                        px, py, pz = contract(x, y, z)
                        places[at, 0], places[at, 1], places[at, 2] = px, py, pz
                        lengths[at], distances[at] = step, t
                    at += 1
                    t += step
                    continue
                out = min(
                    _leave_cell(gx, dx, cell),
                    min(_leave_cell(gy, dy, cell), _leave_cell(gz, dz, cell)),
                )
                t += max(ONE, float32(math.ceil(out / step))) * step
            if not fill:
                firsts[ray], counts[ray] = first, at
            start = far if far > near else float32(NEAR)
            for shell in range(shells):
                share = (float32(shell) + jitter[ray]) / float32(shells)
                x, y, z, t = _outer_place(ox, oy, oz, dx, dy, dz, start, min(share, _LAST))
                i, j, k = int(x * outer_cells), int(y * outer_cells), int(z * outer_cells)
                i, j, k = min(i, outer_cells - 1), min(j, outer_cells - 1), min(k, outer_cells - 1)
                if not outside[period, i, j, k]:
                    continue
                if fill:
                    share = float32(shell) / float32(shells)
                    ax, ay, az, _ = _outer_place(ox, oy, oz, dx, dy, dz, start, share)
                    share = min(float32(shell + 1) / float32(shells), _LAST)
                    bx, by, bz, _ = _outer_place(ox, oy, oz, dx, dy, dz, start, share)
                    bx, by, bz = bx - ax, by - ay, bz - az
                    places[at, 0], places[at, 1] = min(x, _LAST), min(y, _LAST)
                    places[at, 2] = min(z, _LAST)
                    # The contracted cube of edge 4 became the unit cube.
                    lengths[at] = float32(4) * math.sqrt(bx * bx + by * by + bz * bz)
                    distances[at] = t
                at += 1
            if not fill:
                starts[ray + 1] = at
