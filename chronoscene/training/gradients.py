"""Gradients of a training step: the backward pass, and those of the projected centres."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from chronoscene.methods import Skipped, TrainingSet
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.devices import to_device
from chronoscene.training.optimizers.adam import Adam, DenseTable, all_finite
from chronoscene.training.optimizers.row_adam import RowAdam


def collect_gradients(
    loss: Tensor,
    info: RasterInfo,
    optimizers: Iterable[Adam | DenseTable | RowAdam],
    mask: Tensor | None = None,
) -> tuple[float, Skipped | None]:
    """The backward pass of a training step. What it returns is all that the host waits for.

    Args:
        loss: What to minimise.
        info: Of the rasterization.
        optimizers: Those that step after it.
        mask: Where the photo counts; None for everywhere. bool [H, W]

    Returns:
        loss: The same as a number.
        skipped: Why the step must be skipped, if it must: the optimisers may not use what they have
            then.
    """
    sees = (info.radii > 0).any()
    if mask is not None:
        sees = sees & mask.any()
    loss.backward()
    loss = loss.detach()
    gradients = [gradient for optimizer in optimizers for gradient in optimizer.gradients()]
    finite = all_finite([loss, *gradients])
    value, seen, sound = torch.stack([loss, sees.to(loss), finite.to(loss)]).tolist()
    if not seen:
        return value, "empty"
    return value, None if sound else "not finite"


def centre_gradients(info: RasterInfo) -> Tensor:
    """Of the projected centres after ``backward``, in pixels; absolute ones if they were asked for.
    [N, 2]"""
    assert info.means2d.grad is not None
    found: Tensor = getattr(info.means2d, "absgrad", info.means2d.grad)[0]
    return found


def centres_count(means2d: Tensor, mask: Tensor) -> Tensor:
    """Whether projected centres lie where a photo counts, or outside of it. [N, 2] -> [N]

    Args:
        means2d: Places in pixels; pixel (0, 0) is centred at (0.5, 0.5).
        mask: Where the photo counts. bool [H, W]
    """
    (x, y), (height, width) = means2d.unbind(-1), mask.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = (torch.where(inside, place, 0.0).long() for place in (x, y))
    return mask[y, x] | ~inside


def mask_tensor(train: TrainingSet, index: int, device: str | torch.device) -> Tensor | None:
    """Where the photo of a training view counts; None for everywhere. bool [H, W]"""
    mask = train.load_mask(index)
    return None if mask is None else to_device(mask.copy(), device)
