"""Blocks: features of anchors for a period, or shared between periods.

In ChronoGS all anchors have a block for each period. Here those that are alike may become one once
growth is over, and the training goes on with what is left. To move a block by d raises the loss L
of a view by about h |d|^2 / 2, where h is its curvature. L is a mean over N pixels; if their errors
have independent signs, the squared gradient of L, for each of the F numbers of a block, is about
h L / N, so that the loss rises by the share

    w |d|^2,    w = N |g|^2 / (2 F L^2).

With w summed over the views of a period, the least rise for one block instead of those of periods
s and t is w_s w_t / (w_s + w_t) |b_s - b_t|^2, with their weighted mean: the linkage of Ward. A
period that does not see an anchor has no weight, and takes over the block of a neighbour that does.

Blocks may also decay towards the mean of their anchor, from the start of the training: those that
the photos do not tell apart become alike, and learn from the photos of all periods. Neither is in
the paper.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.density import AnchorCounters
from chronoscene.errors import CheckpointError
from chronoscene.kernels.compilation import kernel
from chronoscene.training.devices import has_kernels, to_device

_LEAST_LOSS = 1e-4  # Photos that are black, and shown so, say nothing
_FORGET = 0.9  # What counts of earlier views after a round


def own_blocks(count: int, periods: int, device: str | torch.device = "cpu") -> Tensor:
    """Return rows of blocks that are not shared, anchor by anchor. int64 [count, T]"""
    return torch.arange(count * periods, device=device).view(count, periods)


def leaders(block_rows: Tensor) -> Tensor:
    """Return the first of the periods with the same block. int64 [A, T] -> int64 [A, T]"""
    numbers = torch.arange(block_rows.shape[1], device=block_rows.device).expand_as(block_rows)
    count = int(block_rows.max()) + 1 if block_rows.numel() else 0
    first = numbers.new_full((count,), block_rows.shape[1])
    first.scatter_reduce_(0, block_rows.flatten(), numbers.flatten(), "amin")
    return first[block_rows]


def count_sharing(block_rows: Tensor) -> tuple[Tensor, Tensor]:
    """Count how the periods share blocks.

    Args:
        block_rows: Block of an anchor at a period. int64 [A, T]

    Returns:
        anchors: Anchors with 1, 2, ... T blocks. int64 [T]
        alone: Blocks that each period has to itself. int64 [T]
    """
    periods = block_rows.shape[1]
    blocks = _leads(leaders(block_rows)).sum(dim=1)
    users = torch.bincount(block_rows.flatten())
    anchors = torch.bincount(blocks, minlength=periods + 1)[1:]
    return anchors, (users[block_rows] == 1).sum(dim=0)


def pack_blocks(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Order blocks by anchor, and replace their rows by the periods that share them.

    Returns:
        tensors: ``block_leaders`` in place of ``block_rows``: the first of the periods that have
            the same block. Left out where nobody shares. [A, T], uint8, or int32 for T > 256.
    """
    rows, others = tensors["block_rows"], {n: t for n, t in tensors.items() if n != "block_rows"}
    first = leaders(rows)
    own = _leads(first)
    others["blocks"] = tensors["blocks"].detach()[rows[own]]
    if own.all():
        return others
    small = first.shape[1] <= torch.iinfo(torch.uint8).max + 1
    return others | {"block_leaders": first.to(torch.uint8 if small else torch.int32)}


def unpack_blocks(tensors: dict[str, Tensor], periods: int) -> dict[str, Tensor]:
    """Inverse of `pack_blocks`.

    Raises:
        CheckpointError: If the periods named are not the first of any.
    """
    anchors = tensors["anchors"]
    if "block_leaders" not in tensors:
        columns = periods if tensors["blocks"].shape[1] else 0
        return tensors | {"block_rows": own_blocks(len(anchors), columns, anchors.device)}
    first = tensors["block_leaders"].long()
    if not (first < periods).all() or not _leads(first).gather(1, first).all():
        raise CheckpointError(
            "block_leaders",
            expected=f"periods below {periods}, each the first with its block",
            found="others",
            todo="the file is damaged: train again",
        )
    number = _leads(first).flatten().cumsum(0).view(first.shape) - 1
    others = {name: tensor for name, tensor in tensors.items() if name != "block_leaders"}
    return others | {"block_rows": number.gather(1, first)}


def _leads(first: Tensor) -> Tensor:
    """Return True for periods that are the first to have their block. bool [A, T]"""
    return first == torch.arange(first.shape[1], device=first.device)


def decay_to_mean(blocks: Tensor, block_rows: Tensor, share: float) -> None:
    """Move blocks in place towards their mean over the periods of an anchor, which stays.

    Args:
        blocks: [B, Fv]
        block_rows: Block of an anchor at each period that takes part. int64 [A, T]
        share: Part of the way, 0..1.
    """
    if has_kernels(blocks):
        _decay(blocks.detach().numpy(), block_rows.numpy(), np.float32(share))
        return
    mean = blocks[block_rows].mean(1)
    target = blocks.clone()
    target[block_rows] = mean[:, None]  # to the periods that share a block the same
    blocks.lerp_(target, share)


@kernel(parallel=True)
def _decay(blocks, rows, share):  # type: ignore[no-untyped-def]
    anchors, periods = rows.shape
    count, length = blocks.shape
    means = np.zeros((anchors, length), np.float32)
    owner = np.full(count, -1)
    for a in prange(anchors):
        for t in range(periods):
            owner[rows[a, t]] = a
            for f in range(length):
                means[a, f] += blocks[rows[a, t], f]
    for b in prange(count):
        if owner[b] < 0:
            continue
        for f in range(length):
            mean = means[owner[b], f] / np.float32(periods)
            blocks[b, f] += share * (mean - blocks[b, f])


class BlockStatistics(AnchorCounters):
    """Statistics of how much the loss depends on the blocks, by anchor and period."""

    names = ("rise", "drawn", "off")

    def __init__(self, anchors: int, periods: int, device: torch.device) -> None:
        self.rise, self.drawn, self.off = torch.zeros(3, anchors, periods, device=device)
        """Sums of w; views in which the anchor draws something, and in which all of its Gaussians
        are switched off. [A, T]"""
        self.views = torch.zeros((), dtype=torch.float64)
        """Views of each period."""

    def update(
        self,
        anchors: Tensor,
        period: int,
        gradient: Tensor,
        drawn: Tensor,
        *,
        loss: float,
        pixels: int,
    ) -> None:
        """Add one view.

        Args:
            anchors: Those that were decoded. int64 [M]
            period: Of the view.
            gradient: Of the loss, with respect to their blocks. [M, Fv]
            drawn: Whether any of an anchor's Gaussians is switched on. bool [M]
            loss: The mean over the pixels that count.
            pixels: How many these are.
        """
        scale = pixels / (2 * gradient.shape[1] * max(loss, _LEAST_LOSS) ** 2)
        self.rise[anchors, period] += scale * gradient.square().sum(1)
        self.drawn[anchors, period] += drawn
        self.off[anchors, period] += ~drawn
        self.views += 1

    def fade(self) -> None:
        """Forget a part of earlier views: the model was another."""
        for counter in (self.rise, self.drawn, self.off, self.views):
            counter *= _FORGET

    def weights(self) -> Tensor:
        """Sums of w. Views in which an anchor is switched off have no gradient, but a model that
        switches it on shows it there: they count as one in which it is drawn does. [A, T]"""
        mean = self.rise.sum(1, keepdim=True) / self.drawn.sum(1, keepdim=True).clamp_min(1)
        return self.rise + self.off * mean

    def state(self) -> dict[str, Tensor]:
        return super().state() | {"views": self.views}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        super().load_state(state)
        self.views.copy_(state["views"])


def merge_alike(blocks: Tensor, statistics: BlockStatistics, share: float) -> tuple[Tensor, Tensor]:
    """Merge the blocks of anchors where that raises the loss least.

    Args:
        blocks: One for each anchor and period. [A, T, Fv]
        statistics: What they are worth.
        share: Of the loss, by which it may rise in all, by the estimate above.

    Returns:
        first: The first of the periods that have the same block. int64 [A, T]
        merged: Blocks of those; others mean nothing. [A, T, Fv]
    """
    values, weights = (
        tensor.detach().cpu().double().numpy() for tensor in (blocks, statistics.weights())
    )
    costs, _, _ = agglomerate(values, weights, np.inf)
    ordered = np.sort(costs, axis=None)
    kept = np.cumsum(ordered) <= share * float(statistics.views)
    limit = ordered[kept][-1] if kept.any() else -1.0
    _, first, merged = agglomerate(values, weights, limit)
    return to_device(first, blocks.device), to_device(merged.astype(np.float32), blocks.device)


def agglomerate(
    values: NDArray[np.float64], weights: NDArray[np.float64], limit: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Join the two clusters of periods of least cost, again and again, for each anchor on its own.

    Args:
        values: [A, T, F]
        weights: [A, T]
        limit: Cost above which clusters stay apart.

    Returns:
        costs: Of what was joined, in this order; the rest infinite. [A, T - 1]
        first: First period of each cluster. [A, T]
        values: Weighted means of the clusters, at their first periods. [A, T, F]
    """
    anchors, periods, _ = values.shape
    costs = np.full((anchors, periods - 1), np.inf)
    first = np.tile(np.arange(periods), (anchors, 1))
    values = values.copy()
    _agglomerate(values, weights.copy(), limit, costs, first)
    return costs, first, values


@kernel(parallel=True)
def _agglomerate(values, weights, limit, costs, first):  # type: ignore[no-untyped-def]
    # The best partner of each period among those before it is kept, so that a step takes time in
    # proportion to the number of periods, mostly, and not to its square.
    anchors, periods, _ = values.shape
    for a in prange(anchors):
        best, partner = np.full(periods, np.inf), np.full(periods, -1)
        for j in range(1, periods):
            _find_partner(values[a], weights[a], first[a], j, best, partner)
        for step in range(periods - 1):
            t = -1
            for j in range(1, periods):
                if partner[j] >= 0 and (
                    t < 0
                    or best[j] < best[t]
                    or (best[j] == best[t] and j - partner[j] < t - partner[t])
                ):
                    t = j
            if t < 0 or best[t] > limit:
                break
            s = partner[t]
            costs[a, step] = best[t]
            total = weights[a, s] + weights[a, t]
            part = weights[a, t] / total if total > 0 else 0.0
            for f in range(values.shape[2]):
                values[a, s, f] += part * (values[a, t, f] - values[a, s, f])
            weights[a, s] = total
            for period in range(periods):
                if first[a, period] == t:
                    first[a, period] = s
            partner[t] = -1
            for j in range(s, periods):
                if first[a, j] != j:
                    continue
                if j == s or partner[j] == s or partner[j] == t:
                    _find_partner(values[a], weights[a], first[a], j, best, partner)
                else:
                    _compare_partner(values[a], weights[a], s, j, best, partner)


@kernel(inline="always")
def _compare_partner(values, weights, i, j, best, partner):  # type: ignore[no-untyped-def]
    total = weights[i] + weights[j]
    squares = 0.0
    for f in range(values.shape[1]):
        squares += (values[i, f] - values[j, f]) ** 2
    cost = weights[i] * weights[j] / total * squares if total > 0 else 0.0
    if cost < best[j] or (cost == best[j] and i > partner[j]):
        best[j], partner[j] = cost, i


@kernel
def _find_partner(values, weights, first, j, best, partner):  # type: ignore[no-untyped-def]
    best[j], partner[j] = np.inf, -1
    for i in range(j):
        if first[i] == i:
            _compare_partner(values, weights, i, j, best, partner)
