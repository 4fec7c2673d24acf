"""Occupancy of space in each period: which cells are worth a sample.

It begins with cells near sparse points, which decides more than anything else how many samples a
ray has, and follows the field from then on.

Source: Müller et al. 2022, "Instant Neural Graphics Primitives", appendix C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from torch import Tensor

from chronoscene.fields.box import SceneBox, finite_points
from chronoscene.fields.marching import march
from chronoscene.fields.rays import PixelPool
from chronoscene.methods import TrainingSet
from chronoscene.training import devices
from chronoscene.training.periods import with_new_periods

Density = Callable[[Tensor, int], Tensor]
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
        device: Device of all.
    """

    def __init__(
        self,
        num_periods: int,
        cells: int,
        spacing: float,
        allowed: NDArray[np.bool_],
        device: str = "cpu",
    ) -> None:
        self.step = spacing * 2 / cells
        """Distance of samples, in half edges of the cube."""
        masks = allowed, np.ones((_OUTER_CELLS,) * 3, bool)
        self._cells = tuple(
            devices.to_device(np.argwhere(mask).astype(np.int32), device) for mask in masks
        )
        shapes = [(num_periods, *mask.shape) for mask in masks]
        self.densities = tuple(torch.zeros(shape, device=device) for shape in shapes)
        """Largest density found lately. [T, G, G, G] each"""
        self.grids = tuple(
            devices.to_device(np.repeat(mask[None].astype(np.uint8), num_periods, axis=0), device)
            for mask in masks
        )
        """Occupied cells of the cube, and of the contracted unit cube. [T, G, G, G] each"""

    @classmethod
    def restore(
        cls,
        num_periods: int,
        cells: int,
        spacing: float,
        packed: Mapping[str, NDArray[np.uint8]],
        device: str = "cpu",
    ) -> Occupancy:
        """Return the occupancy of a finished model, from the bits of `grids`."""
        found = cls(num_periods, cells, spacing, np.zeros((cells,) * 3, bool), device)
        for grid, bits in zip(found.grids, packed.values(), strict=True):
            grid.view(-1)[:] = torch.from_numpy(np.unpackbits(bits, count=grid.numel()))
        return found

    def extend(self, num_periods: int) -> None:
        """Add periods, which begin like the last one."""
        self.densities = tuple(with_new_periods(grid, num_periods) for grid in self.densities)
        self.grids = tuple(with_new_periods(grid, num_periods) for grid in self.grids)

    def refresh(self, index: int, density: Density, generator: np.random.Generator) -> None:
        """Look at some cells again, in every period, and say anew which are occupied.

        Args:
            index: Steps done before.
            density: The field.
            generator: Draws cells, and a place in each.
        """
        for outer, (cells, grid) in enumerate(zip(self._cells, self.densities, strict=True)):
            limit = _OPACITY / (_OUTER_STEP if outer else self.step)
            x, y, z = cells.long().unbind(1)
            numbers = (x * grid.shape[1] + y) * grid.shape[1] + z
            for period in range(len(grid)):
                part = slice(int(generator.integers(_SHARE)), None, _SHARE)
                places = _places(cells[part], generator, grid.shape[1], contracted=bool(outer))
                flat, at = grid[period].view(-1), numbers[part]
                flat[at] = torch.maximum(_DECAY * flat[at], density(places, period))
                if index >= _WARM_UP:
                    found = flat[numbers]
                    occupied = found > _mean(found).clamp_max(limit)
                    self.grids[outer][period].view(-1)[numbers] = occupied.to(torch.uint8)


def _mean(x: Tensor) -> Tensor:
    if devices.has_kernels(x):  # NumPy's sum does not depend on the number of threads
        return torch.from_numpy(x.numpy().mean(keepdims=True))
    return x.mean()


def _places(
    cells: Tensor, generator: np.random.Generator, count: int, *, contracted: bool
) -> Tensor:
    """Random contracted places in cells."""
    random = devices.uniform(generator, (len(cells), 3), cells)
    unit = (cells.double() + random) / count
    # The cube is the middle of the contracted one.
    places = unit if contracted else 0.25 + 0.5 * unit
    return places.clamp_max(float(np.float32(0.99999))).float()


def start_occupancy(
    train: TrainingSet,
    box: SceneBox,
    pool: PixelPool,
    num_periods: int,
    cells: int,
    spacing: float,
    device: str = "cpu",
) -> Occupancy:
    """Begin with the cells of sparse points, dilated as long as that reaches more of the photos.

    Where the points leave gaps, rays of the training photos would go through: a dilation is worth
    it while it stops a further half per cent of them.
    """
    allowed = np.zeros((cells,) * 3, bool)
    points = box.to_cube(torch.from_numpy(finite_points(train))).numpy()
    at = np.floor((points + 1) * cells / 2).astype(np.int64)
    at = at[((at >= 0) & (at < cells)).all(axis=1)]
    if len(at) == 0 or len(pool) == 0:
        return Occupancy(num_periods, cells, spacing, np.ones_like(allowed), device)
    allowed[tuple(at.T)] = True
    rays = pool.draw(np.random.default_rng(0), 4096)
    origins, reached = box.to_cube(rays.origins), 0.0
    outer = torch.zeros(1, 1, 1, 1, dtype=torch.uint8, device=device)
    nothing = torch.zeros_like(rays.views), torch.zeros_like(rays.depths)
    for _ in range(_MOST_DILATIONS):
        allowed = binary_dilation(allowed, np.ones((3, 3, 3), bool))
        grids = devices.to_device(allowed[None].astype(np.uint8), device), outer
        samples = march(origins, rays.directions, *nothing, grids, box, spacing * 2 / cells, 0)
        share = float((samples.groups.starts.diff() > 0).double().mean())
        if share < reached + _GAIN:
            break
        reached = share
    return Occupancy(num_periods, cells, spacing, allowed, device)
