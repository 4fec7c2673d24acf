"""The backward pass of a training step, and what it says where a gradient is not finite."""

import math
from types import SimpleNamespace

import torch

from chronoscene.training.gradients import BackwardPass, collect_gradients


def backward(factor, radius=1, mask=None):
    """Gradients of a loss: 2 in the means, not finite in the opacities."""
    leaves = {name: torch.zeros(3, requires_grad=True) for name in ("means", "opacities")}
    loss = 1.0 + 2.0 * leaves["means"].sum() + factor * leaves["opacities"].square().sum().sqrt()
    info = SimpleNamespace(radii=torch.full((1, 4, 2), radius))
    return collect_gradients(
        loss, info, lambda: {name: leaf.grad for name, leaf in leaves.items()}, mask
    )


def test_a_finite_step_is_taken():
    leaf = torch.ones(3, requires_grad=True)
    info = SimpleNamespace(radii=torch.ones(1, 4, 2))
    found = collect_gradients(leaf.sum(), info, lambda: {"means": leaf.grad})
    assert found == BackwardPass(3.0, None)


def test_what_is_not_finite_is_named():
    assert backward(1.0) == BackwardPass(1.0, "not finite", ("opacities",))
    found = backward(math.nan)
    assert (found.skipped, found.not_finite) == ("not finite", ("loss", "opacities"))


def test_a_view_without_anything_is_empty():
    assert backward(1.0, radius=0).skipped == "empty"
    assert backward(1.0, mask=torch.zeros(2, 2, dtype=torch.bool)).skipped == "empty"
