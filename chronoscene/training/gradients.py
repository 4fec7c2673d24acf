"""Gradients of a training step: the backward pass, and those of the projected centres."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from chronoscene.methods.interface import Skipped
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.optimizers.adam import all_finite


class BackwardPass(NamedTuple):
    """Outcome of the backward pass of a training step."""

    loss: float
    skipped: Skipped | None
    """Reason to skip the step, if there is one: no optimiser may use its gradients then."""
    not_finite: tuple[str, ...] = ()
    """Names of the tensors whose gradients are not finite; ``loss`` where it is not finite."""


def collect_gradients(
    loss: Tensor,
    info: RasterInfo,
    gradients: Callable[[], Mapping[str, Tensor]],
    mask: Tensor | None = None,
) -> BackwardPass:
    """Do the backward pass of a training step. The host waits for nothing but its outcome.

    Args:
        loss: Scalar to minimise.
        info: Details of the rasterization.
        gradients: Gives the gradients of all optimisers after the pass, by name.
        mask: Where the photo counts; None for everywhere. bool [H, W]
    """
    loss.backward()
    return judge_gradients(loss.detach(), info, gradients(), mask)


def judge_gradients(
    loss: Tensor, info: RasterInfo, gradients: Mapping[str, Tensor], mask: Tensor | None = None
) -> BackwardPass:
    """Decide whether gradients can be used; arguments as of `collect_gradients`, after the pass."""
    sees = (info.radii > 0).any()
    if mask is not None:
        sees = sees & mask.any()
    found = {"loss": loss, **gradients}
    finite = all_finite(list(found.values()))
    value, seen, sound = torch.stack([loss, sees.to(loss), finite.to(loss)]).tolist()
    if not seen:
        return BackwardPass(value, "empty")
    if sound:
        return BackwardPass(value, None)
    names = (name for name, tensor in found.items() if not all_finite([tensor]))
    return BackwardPass(value, "not finite", tuple(names))


def joined(views: Sequence[BackwardPass]) -> BackwardPass:
    """Return the outcome of a step of some views.

    Views that are skipped take no part in it; a step of which none is left is skipped. The loss is
    the mean of those that count.
    """
    counted = [view for view in views if view.skipped is None] or views
    worst = [view for view in counted if view.skipped == "not finite"] or counted
    loss = sum(view.loss for view in counted) / len(counted)
    return worst[0]._replace(loss=loss)


def centre_gradients(info: RasterInfo) -> Tensor:
    """Return the gradients of the projected centres after ``backward``, in pixels. [N, 2]

    They are absolute ones if these were asked for.
    """
    assert info.means2d.grad is not None
    found: Tensor = getattr(info.means2d, "absgrad", info.means2d.grad)[0]
    return found


def centres_count(means2d: Tensor, mask: Tensor) -> Tensor:
    """Return True for projected centres where a photo counts, or outside of it. [N, 2] -> [N]

    Args:
        means2d: Places in pixels; pixel (0, 0) is centred at (0.5, 0.5).
        mask: Where the photo counts. bool [H, W]
    """
    (x, y), (height, width) = means2d.unbind(-1), mask.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = (torch.where(inside, place, 0.0).long() for place in (x, y))
    return mask[y, x] | ~inside
