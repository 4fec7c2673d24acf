"""Occupancy of space in each period: which cells are worth a sample.

It begins with cells near sparse points, which decides more than anything else how many samples a
ray has, and follows the field from then on.

Source: Müller et al. 2022, "Instant Neural Graphics Primitives", appendix C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from chronoscene.fields.box import SceneBox
from chronoscene.fields.marching import march
from chronoscene.fields.rays import PixelPool
from chronoscene.methods import TrainingSet

Density = Callable[[NDArray[np.float32], int], NDArray[np.float32]]
"""Function that gives densities at contracted places [N, 3] in a period. [N]"""

INTERVAL = 16
"""Steps between two refreshes."""
_WARM_UP = 256  # Steps in which every cell that may be occupied counts as such
_DECAY = 0.8  # Of a cell's density when it is looked at again
_OPACITY = 0.01  # Of a step's length of density, above which a cell is always occupied
_OUTER_STEP = 0.1  # Taken as the distance of samples outside
_SHARE = 4  # One cell in so many is looked at in a refresh
_OUTER_CELLS = 32
_GAIN = 0.005  # Further rays that a dilation must reach, as a share of all, to be worth it
_MOST_DILATIONS = 16


class Occupancy:
    """Densities of cells, and which of them are occupied.

    Args:
        num_periods: T
        cells: Cells along an edge of the cube.
        spacing: Distance of samples, as a share of a cell.
        allowed: Cells of the cube that may be occupied. [G, G, G]
    """

    def __init__(
        self, num_periods: int, cells: int, spacing: float, allowed: NDArray[np.bool_]
    ) -> None:
        self.step = spacing * 2 / cells
        """Distance of samples, in half edges of the cube."""
        masks = allowed, np.ones((_OUTER_CELLS,) * 3, bool)
        self._cells = tuple(np.argwhere(mask).astype(np.int32) for mask in masks)
        self.densities = tuple(np.zeros((num_periods, *mask.shape), np.float32) for mask in masks)
        """Largest density found lately. [T, G, G, G] each"""
        self.grids = tuple(
            np.repeat(mask[None].astype(np.uint8), num_periods, axis=0) for mask in masks
        )
        """Occupied cells of the cube, and of the contracted unit cube. [T, G, G, G] each"""

    @classmethod
    def restore(
        cls, num_periods: int, cells: int, spacing: float, packed: Mapping[str, NDArray[np.uint8]]
    ) -> Occupancy:
        """Return the occupancy of a finished model, from the bits of `grids`."""
        found = cls(num_periods, cells, spacing, np.zeros((cells,) * 3, bool))
        for grid, bits in zip(found.grids, packed.values(), strict=True):
            grid.reshape(-1)[:] = np.unpackbits(bits, count=grid.size)
        return found

    def extend(self, num_periods: int) -> None:
        """Add periods, which begin like the last one."""
        last = [min(i, len(self.grids[0]) - 1) for i in range(num_periods)]
        self.densities = tuple(grid[last] for grid in self.densities)
        self.grids = tuple(grid[last] for grid in self.grids)

    def refresh(self, index: int, density: Density, generator: np.random.Generator) -> None:
        """Look at some cells again, in every period, and say anew which are occupied.

        Args:
            index: Steps done before.
            density: The field.
            generator: Draws cells, and a place in each.
        """
        for outer, (cells, grid) in enumerate(zip(self._cells, self.densities, strict=True)):
            limit = _OPACITY / (_OUTER_STEP if outer else self.step)
            for period in range(len(grid)):
                chosen = cells[int(generator.integers(_SHARE)) :: _SHARE]
                places = _places(chosen, generator, grid.shape[1], contracted=bool(outer))
                at = (period, *chosen.T)
                grid[at] = np.maximum(_DECAY * grid[at], density(places, period))
                if index >= _WARM_UP:
                    found = grid[(period, *cells.T)]
                    occupied = found > min(float(found.mean()), limit)
                    self.grids[outer][(period, *cells.T)] = occupied


def _places(
    cells: NDArray[np.int32], generator: np.random.Generator, count: int, *, contracted: bool
) -> NDArray[np.float32]:
    """Random contracted places in cells."""
    unit = (cells + generator.random(cells.shape, np.float32)) / np.float32(count)
    # The cube is the middle of the contracted one.
    places = unit if contracted else 0.25 + 0.5 * unit
    return np.minimum(places, np.float32(0.99999)).astype(np.float32)


def start_occupancy(
    train: TrainingSet, box: SceneBox, pool: PixelPool, num_periods: int, cells: int, spacing: float
) -> Occupancy:
    """Begin with the cells of sparse points, dilated as long as that reaches more of the photos.

    Where the points leave gaps, rays of the training photos would go through: a dilation is worth
    it while it stops a further half per cent of them.
    """
    allowed = np.zeros((cells,) * 3, bool)
    at = np.floor((box.to_cube(train.points) + 1) * cells / 2).astype(np.int64)
    at = at[((at >= 0) & (at < cells)).all(axis=1)]
    if len(at) == 0 or len(pool) == 0:
        return Occupancy(num_periods, cells, spacing, np.ones_like(allowed))
    allowed[tuple(at.T)] = True
    rays = pool.draw(np.random.default_rng(0), 4096)
    origins, reached = box.to_cube(rays.origins), 0.0
    outer = np.zeros((1, 1, 1, 1), np.uint8)
    for _ in range(_MOST_DILATIONS):
        allowed = binary_dilation(allowed, np.ones((3, 3, 3), bool))
        grids = allowed[None].astype(np.uint8), outer
        nothing = np.zeros(len(origins), np.int64), np.zeros(len(origins), np.float32)
        samples = march(origins, rays.directions, *nothing, grids, box, spacing * 2 / cells, 0)
        share = float((np.diff(samples.starts) > 0).mean())
        if share < reached + _GAIN:
            break
        reached = share
    return Occupancy(num_periods, cells, spacing, allowed)
