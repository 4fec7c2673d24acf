"""Places of anchors: at first one per occupied voxel of the sparse cloud of all periods, then
density control by statistics of the views, by which anchors grow and are pruned.

Source: Scaffold-GS (Lu et al., CVPR 2024), section 3.3, and the official code of Scaffold-GS and
ChronoGS; differences from the papers are named options of `AnchorConfig`. Everything is on arrays
of a fixed order, so on a CPU a seed gives the same anchors for any number of threads. What happens
during a training stays on the device of the training.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.errors import ConfigError
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices
from chronoscene.training.points import rms_spacing

COARSER = 1.02
"""Ratio of the voxel edges that are tried where a cloud would have too many anchors."""
_POWERS = 4096  # Powers of it that are tried: the last is 1e35
SMALLEST_CELL = 1e-18
"""Smallest edge of a voxel, as a share of the largest coordinate: indices have 64 bits."""
MIN_DISTANCE = 1e-7
"""Lower bound of a neighbour distance: keeps the log-scales of coinciding points finite."""


def cell_indices(positions: Tensor, size: float) -> Tensor:
    """Return the cell of each position: the nearest multiple of ``size``, halves to even.

    [P, 3] -> int64 [P, 3]
    """
    return torch.round(positions.double() / size).long()


def pack_cells(cells: Tensor) -> Tensor:
    """Pack cells into integers, equal exactly where the cells are. int64 [P, 3] -> int64 [P]

    Keys of different calls are not comparable: pack everything that is compared in one call.
    """
    if len(cells) == 0:
        return cells.new_zeros(0)
    low = cells.amin(0)
    extent = (cells.amax(0) - low + 1).tolist()
    if extent[0] * extent[1] * extent[2] < 2**62:
        ranks = cells - low
    else:  # far outliers: ranks per axis are below the number of rows
        ranks = torch.stack([c.unique(return_inverse=True)[1] for c in cells.unbind(1)], dim=1)
        extent = (ranks.amax(0) + 1).tolist()
    return (ranks[:, 0] * extent[1] + ranks[:, 1]) * extent[2] + ranks[:, 2]


def neighbour_distances(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Compute the RMS distance to the three nearest points, at least `MIN_DISTANCE`. [P]"""
    return np.maximum(rms_spacing(points), MIN_DISTANCE)


def median_spacing(points: NDArray[np.floating]) -> float:
    """Compute the median distance of points to their nearest other; 1 for a lone point."""
    return float(max(np.median(rms_spacing(points, 1)), MIN_DISTANCE)) if len(points) > 1 else 1.0


def resolve_voxel_size(
    points: NDArray[np.floating], value: float, unit: str, *, training_from_world: float
) -> float:
    """Compute the voxel edge in training units.

    Args:
        points: Sparse points in the training frame. [P, 3]
        value: The configured size; 0 means the median over the points of the mean *squared*
            distance to three neighbours, a unit slip that Scaffold-GS and ChronoGS share.
        unit: See `AnchorConfig.voxel_unit`.
        training_from_world: Scale of the similarity from world to training frame.

    Raises:
        ConfigError: If 64 bits cannot number the cells of the cloud.
    """
    if value == 0:
        return float(np.median(np.square(neighbour_distances(points))))
    if unit == "spacing":
        size = value * median_spacing(points)
    else:
        size = value * (training_from_world if unit == "world" else 1.0)
    if size < SMALLEST_CELL * np.abs(points).max(initial=0.0):
        raise ConfigError(
            "voxel_size",
            expected=f"at least {SMALLEST_CELL:g} of the largest coordinate of a point",
            found=f"{value:g}, with voxel_unit={unit}",
            todo="take larger voxels, or leave out points that are far away",
        )
    return size


def voxelize(
    points: NDArray[np.floating], size: float, origin: str = "zero"
) -> NDArray[np.float32]:
    """Find the occupied voxels as positions, sorted by cell. [P, 3] -> [A, 3]

    Args:
        points: [P, 3]
        size: Voxel edge, in the units of the points.
        origin: See `AnchorConfig.voxel_origin`.
    """
    corner = _corner(points, origin)
    cells = cell_indices(torch.from_numpy(points - corner), size)
    _, first = np.unique(pack_cells(cells).numpy(), return_index=True)
    return (cells.numpy()[first] * size + corner).astype(np.float32)


def _corner(points: NDArray[np.floating], origin: str) -> NDArray[np.float64]:
    """Return where cells are counted from. [3]"""
    return points.min(axis=0).astype(np.float64) if origin == "box" else np.zeros(3)


def initial_anchors(
    points: NDArray[np.floating], size: float, *, origin: str = "zero", limit: int = 0
) -> tuple[NDArray[np.float32], float]:
    """Place anchors in a cloud, with a coarser voxel if there would be more than ``limit``.

    Returns:
        anchors: [A, 3]
        size: The voxel edge that was used: ``size`` times a power of `COARSER`.
    """
    if limit > 0:
        offsets = torch.from_numpy(points - _corner(points, origin))

        def fits(exponent: int) -> bool:
            keys = np.sort(pack_cells(cell_indices(offsets, size * COARSER**exponent)).numpy())
            return bool(np.count_nonzero(np.diff(keys)) < limit)

        if not fits(0):
            size *= COARSER ** bisect_left(range(_POWERS), True, key=fits)
    return voxelize(points, size, origin), size


def initial_log_scales(anchors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Compute the log of the neighbour distance, in all six columns. [A, 3] -> [A, 6]"""
    column = np.log(neighbour_distances(anchors)).astype(np.float32)
    return np.repeat(column[:, None], 6, axis=1)


class AnchorCounters:
    """Arrays with one row per anchor, which follow growth and pruning."""

    names: ClassVar[tuple[str, ...]]

    def state(self) -> dict[str, Tensor]:
        """Return all arrays, by name."""
        return {name: getattr(self, name) for name in self.names}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` gave, for as many anchors."""
        for name in self.names:
            getattr(self, name).copy_(state[name])

    def extend(self, count: int) -> None:
        """Make room for new anchors, which start with zeros."""
        for name in self.names:
            old = getattr(self, name)
            setattr(self, name, torch.cat([old, old.new_zeros(count, *old.shape[1:])]))

    def keep(self, mask: Tensor) -> None:
        """Forget the anchors outside a mask. bool [A]"""
        for name in self.names:
            setattr(self, name, getattr(self, name)[mask])


class DensityStatistics(AnchorCounters):
    """Statistics of training views for each anchor and Gaussian since it was last judged."""

    names = ("opacity_sum", "visits", "motion", "grad_sum", "hits")

    def __init__(self, anchors: int, offsets: int, device: str | torch.device = "cpu") -> None:
        self.opacity_sum, self.visits, self.motion = torch.zeros(3, anchors, device=device)
        self.grad_sum, self.hits = torch.zeros(2, anchors, offsets, device=device)

    def update(
        self,
        visible: Tensor,
        positions: Tensor,
        opacities: Tensor,
        radii: Tensor,
        means2d_grad: Tensor,
        width: int,
        height: int,
        counted: Tensor | None = None,
    ) -> None:
        """Add one training view.

        Args:
            visible: Anchors that were decoded. int64 [M]
            positions: Which of their M * k Gaussians are switched on, ascending. int64 [L]
            opacities: Opacities of those. [L]
            radii: 0 where a Gaussian was culled, or does not count. int32 [L, 2]
            means2d_grad: d loss / d centre in pixels. [L, 2]
            width: Image width in pixels: gradients count in units of half an image.
            height: Image height in pixels.
            counted: Anchors for which the view counts as a visit; None for all. bool [M]
        """
        if counted is None:
            counted = torch.ones_like(visible, dtype=torch.bool)
        seen = (visible, counted, positions, opacities, radii, means2d_grad)
        halves = (0.5 * width, 0.5 * height)
        if devices.has_kernels(opacities, self.visits):
            counters = (getattr(self, name).numpy() for name in self.names)
            _accumulate(*(tensor.numpy() for tensor in seen), *halves, *counters)
        else:
            self._add(*seen, *halves)

    def _add(
        self,
        visible: Tensor,
        counted: Tensor,
        positions: Tensor,
        opacities: Tensor,
        radii: Tensor,
        grad: Tensor,
        half_width: float,
        half_height: float,
    ) -> None:
        """Do what `_accumulate` does in plain torch."""
        k = self.hits.shape[1]
        row = positions // k
        place = visible[row] * k + positions % k
        hit = (radii > 0).all(-1)
        x, y = grad[:, 0] * half_width, grad[:, 1] * half_height
        norm = torch.where(hit, (x * x + y * y).sqrt(), 0.0)
        self.grad_sum.view(-1).index_add_(0, place, norm)
        self.hits.view(-1).index_add_(0, place, hit.to(norm))
        for total, values in ((self.opacity_sum, opacities), (self.motion, norm)):
            sums = values.new_zeros(len(visible)).index_add_(0, row, values)
            total.index_add_(0, visible, sums * counted)
        self.visits.index_add_(0, visible, counted.to(norm))


_CHUNK = 512  # Anchors whose Gaussians one task looks up together


@kernel(parallel=True)
def _accumulate(  # type: ignore[no-untyped-def]
    visible, counted, positions, opacities, radii, grad, half_width, half_height,
    opacity_sum, visits, motion, grad_sum, hits,
):  # fmt: skip
    # Anchors are visible once, so no two rows write to the same place.
    k = grad_sum.shape[1]
    for chunk in prange((len(visible) + _CHUNK - 1) // _CHUNK):
        first, stop = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(visible))
        row = np.searchsorted(positions, first * k)
        for m in range(first, stop):
            a = visible[m]
            total, moved = np.float32(0.0), np.float32(0.0)
            while row < len(positions) and positions[row] < (m + 1) * k:
                total += opacities[row]
                if radii[row, 0] > 0 and radii[row, 1] > 0:
                    gx = grad[row, 0] * half_width
                    gy = grad[row, 1] * half_height
                    norm = np.float32(np.sqrt(gx * gx + gy * gy))
                    moved += norm
                    j = positions[row] - m * k
                    grad_sum[a, j] += norm
                    hits[a, j] += np.float32(1.0)
                row += 1
            if counted[m]:
                opacity_sum[a] += total
                motion[a] += moved
                visits[a] += np.float32(1.0)


class AnchorRows(NamedTuple):
    """Tensors with one row per anchor."""

    anchors: Tensor
    """Positions in training units. [A, 3]"""
    offsets: Tensor
    """In units of the anchor's scale. [A, k, 3]"""
    log_scales: Tensor
    """Columns 0..2 scale the offsets. [A, 6]"""
    features: Tensor
    """[A, F]"""


def min_visits(config: AnchorConfig) -> float:
    """Return the views above which an anchor is judged in a round; half for a Gaussian."""
    return config.density_interval * config.success_threshold


def grow(
    model: AnchorRows,
    statistics: DensityStatistics,
    config: AnchorConfig,
    voxel_size: float,
    generator: np.random.Generator,
) -> AnchorRows:
    """Find new anchors where the gradients of Gaussians are large.

    A Gaussian is a candidate of level l when it was hit often enough, its mean gradient reaches
    ``grad_threshold * 2**l`` and chance keeps it. Its cell gets an anchor unless it has one.

    Args:
        model: All anchors.
        statistics: Counters of the Gaussians that were judged are zeroed.
        config: Thresholds and cell sizes in voxels.
        voxel_size: Smallest cell, in training units.
        generator: Source of the random masks.

    Returns:
        new: In the order in which they are appended. Features are, per channel, the largest over
            the anchors of the candidates in the cell; log-scales that of the edge of the cell.
    """
    eligible = statistics.hits > 0.5 * min_visits(config)
    gradients = statistics.grad_sum / statistics.hits.clamp_min(1.0)
    occupied, found = model.anchors, [_take(model, slice(0))]
    for level in range(config.growth_levels):
        chosen = eligible & (gradients >= config.grad_threshold * 2**level)
        if config.random_growth:
            drawn = devices.uniform(generator, tuple(chosen.shape), gradients)
            chosen &= drawn > 0.5 ** (level + 1)
        if level > 0 and config.chained_levels and len(occupied) == len(model.anchors):
            continue
        voxels = max(config.coarsest_cell // config.cell_refinement**level, 1)
        new = _new_in_level(model, chosen, occupied, voxel_size * voxels)
        count, room = len(new.anchors), config.max_anchors - len(occupied)
        if config.max_anchors and count > room:
            rows = np.sort(generator.permutation(count)[: max(room, 0)])
            new = _take(new, devices.to_device(rows, occupied.device))
        found.append(new)
        occupied = torch.cat([occupied, new.anchors])
    statistics.hits[eligible] = 0.0
    statistics.grad_sum[eligible] = 0.0
    return AnchorRows(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def _new_in_level(model: AnchorRows, chosen: Tensor, occupied: Tensor, size: float) -> AnchorRows:
    """Make one anchor per cell that holds a chosen Gaussian and no anchor yet."""
    parent, slot = chosen.nonzero(as_tuple=True)
    reach = devices.exp(model.log_scales[parent, :3])
    centres = model.anchors[parent] + model.offsets[parent, slot] * reach
    cells = torch.cat([cell_indices(centres, size), cell_indices(occupied, size)])
    keys = pack_cells(cells)
    free = (~torch.isin(keys[: len(parent)], keys[len(parent) :])).nonzero()[:, 0]
    if len(free) == 0:
        return _take(model, slice(0))
    keys, order = keys[free].sort(stable=True)
    order = free[order]
    is_first = torch.cat([keys.new_ones(1, dtype=torch.bool), keys[1:] != keys[:-1]])
    cells = cells[order[is_first]]
    features = model.features[parent[order]]
    cell = (is_first.cumsum(0) - 1)[:, None].expand_as(features)
    lowest = features.new_full((len(cells), features.shape[1]), -torch.inf)
    return AnchorRows(
        anchors=(cells.double() * size).float(),
        offsets=features.new_zeros(len(cells), *model.offsets.shape[1:]),
        log_scales=features.new_full((len(cells), 6), float(np.log(size))),
        features=lowest.scatter_reduce_(0, cell, features, "amax"),
    )


def _take(anchors: AnchorRows, rows: slice | Tensor) -> AnchorRows:
    return AnchorRows(*(tensor[rows] for tensor in anchors))


def prune_mask(statistics: DensityStatistics, config: AnchorConfig) -> Tensor:
    """Return True for anchors that stay; zero the counters of those that were judged. bool [A]"""
    judged = statistics.visits > min_visits(config)
    faint = statistics.opacity_sum < config.min_opacity * statistics.visits
    still = statistics.motion < config.prune_gradient * statistics.visits
    criterion = {"opacity": faint, "gradient": still, "both": faint | still}[config.prune_by]
    for name in ("opacity_sum", "visits", "motion"):
        getattr(statistics, name)[judged] = 0.0
    return ~(judged & criterion)
