"""Which anchors have features of their own for a period, and which share one block between periods.

All anchors may have a block for each period, as in ChronoGS. Or they begin with one block for all
periods, and the photos decide: where the gradients of some periods pull the block one way and those
of the others another, farther than the scatter among the views of a period explains, it is split
in two, which start as copies. A period in which an anchor was never seen has the block of
the nearest period in which it was. Not in the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor

from chronoscene.anchors.density import AnchorCounters
from chronoscene.errors import CheckpointError

_MIN_VIEWS = 3  # Of each side, before a block is split
_FORGET = 0.9  # What counts of earlier gradients after a round


def own_blocks(count: int, periods: int) -> Tensor:
    """Rows of blocks that nobody shares, anchor by anchor. int64 [count, T]"""
    return torch.arange(count * periods).view(count, periods)


def share_equal(blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Store equal blocks of an anchor once.

    Args:
        blocks: [N, T, Fv]

    Returns:
        values: Anchor by anchor, in the order of their first periods. [R, Fv]
        rows: Which of them an anchor has at a period. int64 [N, T]
    """
    same = (blocks[:, :, None] == blocks[:, None]).all(-1)  # [N, T, T]
    first = same.int().argmax(2)  # of the periods with this block
    own = _leads(first)
    number = own.flatten().cumsum(0).view(own.shape) - 1
    return blocks[own], number.gather(1, first)


def leaders(block_rows: Tensor) -> Tensor:
    """First of the periods that have the same block. int64 [A, T] -> int64 [A, T]"""
    numbers = torch.arange(block_rows.shape[1], device=block_rows.device).expand_as(block_rows)
    count = int(block_rows.max()) + 1 if block_rows.numel() else 0
    first = numbers.new_full((count,), block_rows.shape[1])
    first.scatter_reduce_(0, block_rows.flatten(), numbers.flatten(), "amin")
    return first[block_rows]


def pack_blocks(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Blocks anchor by anchor, and who shares them instead of their rows.

    Returns:
        tensors: ``block_leaders`` uint8 [A, T] in place of ``block_rows``: the first of the periods
            that have the same block. Left out where nobody shares.
    """
    rows, others = tensors["block_rows"], {n: t for n, t in tensors.items() if n != "block_rows"}
    first = leaders(rows)
    own = _leads(first)
    others["blocks"] = tensors["blocks"].detach()[rows[own]]
    return others if own.all() else others | {"block_leaders": first.to(torch.uint8)}


def unpack_blocks(tensors: dict[str, Tensor], periods: int) -> dict[str, Tensor]:
    """Inverse of `pack_blocks`.

    Raises:
        CheckpointError: If the periods named are not the first of any.
    """
    anchors = tensors["anchors"]
    if "block_leaders" not in tensors:
        columns = periods if tensors["blocks"].shape[1] else 0
        return tensors | {"block_rows": own_blocks(len(anchors), columns).to(anchors.device)}
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
    """Whether a period is the first that has its block. bool [A, T]"""
    return first == torch.arange(first.shape[1], device=first.device)


class BlockStatistics(AnchorCounters):
    """Gradients of the blocks, by anchor and period."""

    names = ("count", "total", "squares", "seen")

    def __init__(self, anchors: int, periods: int, dim: int, device: torch.device) -> None:
        self.count, self.squares = torch.zeros(2, anchors, periods, device=device)
        """Views, and the sum of their squared gradients. [A, T]"""
        self.total = torch.zeros(anchors, periods, dim, device=device)
        """Sum of the gradients. [A, T, Fv]"""
        self.seen = torch.zeros(anchors, periods, dtype=torch.bool, device=device)
        """Whether a view has ever had a gradient. [A, T]"""

    def update(self, anchors: Tensor, period: int, gradient: Tensor) -> None:
        """Add one view; anchors without a gradient were not seen. [M], [M, Fv]"""
        squares = gradient.square().sum(1)
        self.count[anchors, period] += (squares > 0).to(squares)
        self.seen[anchors, period] |= squares > 0
        self.squares[anchors, period] += squares
        self.total[anchors, period] += gradient

    def fade(self, split: Tensor) -> None:
        """Forget a part of what was, and all of what was before a block was split. bool [A]"""
        for counter in (self.count, self.total, self.squares):
            counter *= _FORGET
            counter[split] = 0.0


def find_splits(statistics: BlockStatistics, block_rows: Tensor, threshold: float) -> Tensor:
    """Which periods leave the block that they share with others.

    In the direction in which the mean gradient of one period is farthest from that of the others,
    the periods of a block are cut in two where the squares between the two parts are largest. The
    block is split if these, for each number of the block, are more than ``threshold`` times
    the squares within the periods for each degree of freedom, as in an analysis of variance.

    Args:
        statistics: What the periods asked for.
        block_rows: As in `AnchorModel`. int64 [A, T]
        threshold: On the ratio F.

    Returns:
        bool [A, T]; never all periods of a block that were seen.
    """
    n, total, squares = statistics.count, statistics.total, statistics.squares
    periods, dim = total.shape[1:]
    leaves = torch.zeros_like(n, dtype=torch.bool)
    # Seen periods of one block at a time: that of the first period, of the second and so on.
    first = leaders(block_rows)
    for leader in range(periods - 1):
        member = (first == leader) & (n > 0)
        active = (member.sum(1) > 1).nonzero()[:, 0]
        if len(active) == 0:
            continue
        inside = member[active].to(n)
        count, sums = n[active] * inside, total[active] * inside[..., None]
        within = (squares[active] * inside).sum(1)
        within -= (sums.square().sum(2) / count.clamp_min(1e-9)).sum(1)
        freedom = (count.sum(1) - inside.sum(1)) * dim
        apart, gap = _apart(count, sums)
        # The period that is farthest off gives the direction; cuts are between sorted projections.
        far = torch.where(inside > 0, apart, -1.0).argmax(1)
        axis = gap[torch.arange(len(far), device=far.device), far]
        along = (sums * axis[:, None]).sum(2) / count.clamp_min(1e-9)
        order = torch.where(inside > 0, along, torch.inf).argsort(1)
        low = count.gather(1, order).cumsum(1)
        low_sums = sums.gather(1, order[..., None].expand_as(sums)).cumsum(1)
        between, _ = _apart(low, low_sums, count.sum(1), sums.sum(1))
        enough = (low >= _MIN_VIEWS) & (count.sum(1, keepdim=True) - low >= _MIN_VIEWS)
        between, cut = torch.where(enough, between, 0.0).max(1)
        ratio = (between / dim) / (within.clamp_min(1e-30) / freedom.clamp_min(1.0))
        split = (ratio > threshold) & (freedom >= dim)
        rank = order.argsort(1)
        upper = (rank > cut[:, None]) & (inside > 0) & split[:, None]
        leaves[active] |= upper
    return leaves


def _apart(
    count: Tensor, sums: Tensor, all_count: Tensor | None = None, all_sums: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Squares between parts and the rest of their blocks, and the difference of the means.

    Args:
        count: Views of each part. [N, T]
        sums: Of their gradients. [N, T, Fv]
        all_count: Of the block; None for the sum of the parts. [N]
        all_sums: Likewise. [N, Fv]
    """
    all_count = count.sum(1) if all_count is None else all_count
    all_sums = sums.sum(1) if all_sums is None else all_sums
    rest = (all_count[:, None] - count).clamp_min(1e-9)
    gap = sums / count.clamp_min(1e-9)[..., None] - (all_sums[:, None] - sums) / rest[..., None]
    factor = count * rest / all_count[:, None].clamp_min(1e-9)
    return factor * gap.square().sum(2), gap


def nearest_seen(seen: Tensor) -> Tensor:
    """Of each period, the nearest in which an anchor was seen, the earlier of two; itself where
    it was never seen at all. bool [A, T] -> int64 [A, T]"""
    far = 2 * seen.shape[1]
    numbers = torch.arange(seen.shape[1], device=seen.device).expand(seen.shape)
    before = torch.where(seen, numbers, -far).cummax(1).values
    after = torch.where(seen, numbers, far).flip(1).cummin(1).values.flip(1)
    nearest = torch.where(numbers - before <= after - numbers, before, after)
    return torch.where(seen.any(1, keepdim=True), nearest, numbers)
