"""Growth and pruning of anchors: statistics, where new anchors appear, which ones go.

Source: Scaffold-GS, section 3.3, and the official code of Scaffold-GS and ChronoGS, which agree
here. Everything is numpy or Numba on arrays of a fixed order, so a seed gives the same anchors
whatever the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from chronoscene.anchors.voxels import cell_indices, pack_cells

Float = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class DensityRules:
    """Numbers that decide about growth and pruning."""

    voxel_size: float
    """Smallest cell, in training units."""
    grad_threshold: float = 2e-4
    """Mean gradient of a 2-D centre, in normalised device units (tau_g)."""
    min_hits: float = 40.0
    """A Gaussian with more hits than this is judged."""
    min_visits: float = 80.0
    """An anchor with more visits than this is judged."""
    min_opacity: float = 0.005
    """An anchor goes when its mean summed opacity per visit is below this."""
    prune_by: str = "opacity"
    """``opacity``; ``gradient``: an anchor goes when its Gaussians hardly moved; ``both``: when
    either holds."""
    prune_gradient: float = 1e-6
    """Summed gradient per visit below which ``gradient`` prunes."""
    levels: int = 3
    """Cell sizes that are tried, coarse to fine."""
    coarsest: int = 16
    """Edge of the coarsest cell in voxels."""
    refinement: int = 4
    """Ratio of the cell edges of neighbouring levels."""
    chained: bool = True
    """Skip finer levels while no anchor was added in this round, as the official code does."""
    random_mask: bool = True
    """Drop candidates by chance: half of them at the coarsest level, fewer at finer ones."""
    max_anchors: int = 0
    """Growth stops here; 0 means no limit."""

    def cell_size(self, level: int) -> float:
        return self.voxel_size * max(self.coarsest // self.refinement**level, 1)


_COUNTERS = ("opacity_sum", "visits", "motion", "grad_sum", "hits")


class DensityStatistics:
    """What the training views told about each anchor and Gaussian since the last judgement."""

    def __init__(self, anchors: int, offsets: int) -> None:
        self.opacity_sum = np.zeros(anchors, np.float32)
        self.visits = np.zeros(anchors, np.float32)
        self.motion = np.zeros(anchors, np.float32)
        self.grad_sum = np.zeros((anchors, offsets), np.float32)
        self.hits = np.zeros((anchors, offsets), np.float32)

    def update(
        self,
        visible: NDArray[np.int64],
        positions: NDArray[np.int64],
        opacities: Float,
        radii: NDArray[np.int32],
        means2d_grad: Float,
        width: int,
        height: int,
    ) -> None:
        """Add one training view.

        Args:
            visible: Anchors that were decoded. [M]
            positions: Which of their M * k Gaussians are switched on, ascending. [L]
            opacities: Opacities of those. [L]
            radii: 0 where a Gaussian was culled. [L, 2]
            means2d_grad: d loss / d centre in pixels. [L, 2]
            width: Image width in pixels: gradients count in units of half an image.
            height: Image height in pixels.
        """
        _accumulate(
            visible,
            positions,
            opacities,
            radii,
            means2d_grad,
            0.5 * width,
            0.5 * height,
            self.opacity_sum,
            self.visits,
            self.motion,
            self.grad_sum,
            self.hits,
        )

    def extend(self, count: int) -> None:
        """Make room for new anchors, which start with zeros."""
        for name in _COUNTERS:
            old = getattr(self, name)
            room = np.zeros((count, *old.shape[1:]), np.float32)
            setattr(self, name, np.concatenate([old, room]))

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Forget the anchors outside a mask. [A]"""
        for name in _COUNTERS:
            setattr(self, name, getattr(self, name)[mask])


_CHUNK = 512
"""Anchors whose Gaussians one task looks up together."""


@njit(cache=True, parallel=True)
def _accumulate(
    visible: NDArray[np.int64],
    positions: NDArray[np.int64],
    opacities: Float,
    radii: NDArray[np.int32],
    grad: Float,
    half_width: float,
    half_height: float,
    opacity_sum: Float,
    visits: Float,
    motion: Float,
    grad_sum: Float,
    hits: Float,
) -> None:
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
            opacity_sum[a] += total
            motion[a] += moved
            visits[a] += np.float32(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class AnchorArrays:
    """The per-anchor tensors of a model."""

    anchors: Float
    """Positions in training units. [A, 3]"""
    offsets: Float
    """In units of the anchor's scale. [A, k, 3]"""
    log_scales: Float
    """Columns 0..2 scale the offsets. [A, 6]"""
    features: Float
    """[A, F]"""


@dataclass(frozen=True, slots=True, eq=False)
class NewAnchors:
    """Anchors that growth adds, in the order in which they are appended."""

    positions: Float
    """[B, 3]"""
    features: Float
    """Per channel the largest value over the anchors of the candidates in the cell. [B, F]"""
    log_scales: Float
    """Log of the cell edge, in all six columns. [B, 6]"""

    def __len__(self) -> int:
        return len(self.positions)


def grow(
    arrays: AnchorArrays,
    statistics: DensityStatistics,
    rules: DensityRules,
    generator: np.random.Generator,
) -> NewAnchors:
    """Find new anchors where the gradients of Gaussians are large.

    A Gaussian is a candidate of level l when it was hit often enough, its mean gradient reaches
    ``grad_threshold * 2**l`` and chance keeps it. Its cell gets an anchor unless it has one.

    Args:
        arrays: The model.
        statistics: Counters of the Gaussians that were judged are zeroed.
        rules: Thresholds and cell sizes.
        generator: Source of the random masks.
    """
    eligible = statistics.hits > rules.min_hits
    gradients = statistics.grad_sum / np.maximum(statistics.hits, np.float32(1.0))
    occupied = arrays.anchors
    found: list[NewAnchors] = []
    for level in range(rules.levels):
        chosen = eligible & (gradients >= rules.grad_threshold * 2**level)
        if rules.random_mask:
            chosen &= generator.random(chosen.shape, dtype=np.float32) > 0.5 ** (level + 1)
        if level > 0 and rules.chained and not found:
            continue
        new = _new_in_level(arrays, chosen, occupied, rules.cell_size(level))
        if rules.max_anchors:
            new = _limited(new, rules.max_anchors - len(occupied), generator)
        if len(new):
            found.append(new)
            occupied = np.concatenate([occupied, new.positions])
    statistics.hits[eligible] = 0.0
    statistics.grad_sum[eligible] = 0.0
    return _concatenate(found, arrays.features.shape[1])


def _new_in_level(
    arrays: AnchorArrays, chosen: NDArray[np.bool_], occupied: Float, size: float
) -> NewAnchors:
    """One anchor per cell that holds a chosen Gaussian and no anchor yet."""
    parent, slot = np.nonzero(chosen)
    reach = np.exp(arrays.log_scales[parent, :3])
    centres = arrays.anchors[parent] + arrays.offsets[parent, slot] * reach
    cells = np.concatenate([cell_indices(centres, size), cell_indices(occupied, size)])
    keys = pack_cells(cells)
    free = np.flatnonzero(~np.isin(keys[: len(parent)], keys[len(parent) :]))
    if len(free) == 0:
        return _concatenate([], arrays.features.shape[1])
    order = free[np.argsort(keys[free], kind="stable")]
    starts = np.flatnonzero(np.diff(keys[order], prepend=keys[order[0]] - 1))
    features = np.maximum.reduceat(arrays.features[parent[order]], starts, axis=0)
    positions = (cells[order[starts]] * size).astype(np.float32)
    return NewAnchors(positions, features, np.full((len(starts), 6), np.log(size), np.float32))


def _limited(new: NewAnchors, room: int, generator: np.random.Generator) -> NewAnchors:
    """At most ``room`` of the new anchors; where there are more, chance decides."""
    if len(new) <= room:
        return new
    rows = np.sort(generator.permutation(len(new))[: max(room, 0)])
    return NewAnchors(new.positions[rows], new.features[rows], new.log_scales[rows])


def _concatenate(parts: list[NewAnchors], channels: int) -> NewAnchors:
    if not parts:
        empty = np.zeros((0, 3), np.float32)
        return NewAnchors(empty, np.zeros((0, channels), np.float32), np.zeros((0, 6), np.float32))
    return NewAnchors(
        np.concatenate([p.positions for p in parts]),
        np.concatenate([p.features for p in parts]),
        np.concatenate([p.log_scales for p in parts]),
    )


def prune_mask(statistics: DensityStatistics, rules: DensityRules) -> NDArray[np.bool_]:
    """Anchors that stay; counters of the anchors that were judged are zeroed. [A]"""
    judged = statistics.visits > rules.min_visits
    faint = statistics.opacity_sum < rules.min_opacity * statistics.visits
    still = statistics.motion < rules.prune_gradient * statistics.visits
    criterion = {"opacity": faint, "gradient": still, "both": faint | still}[rules.prune_by]
    for name in ("opacity_sum", "visits", "motion"):
        getattr(statistics, name)[judged] = 0.0
    return ~(judged & criterion)
