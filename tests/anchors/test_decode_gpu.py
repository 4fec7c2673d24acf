"""The kernels of the decode for a GPU against their definition, values and gradients."""

import pytest
import torch
from gpu_kernels import DEVICE, MARKS, gpu_kernels
from torch import Tensor

from chronoscene.anchors.decode import DecodeInputs, HeadWeights, decode_reference

pytestmark = MARKS
TRAINED = ("offsets", "features", "blocks", "log_scales", "global_features")
HEADS = ("opacity_head", "covariance_head", "color_head")


def some_inputs(
    anchors: int, k: int, periods: int, base: int, own: int, shared: int, *, all_seen: bool
) -> DecodeInputs:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    def head(outputs: int) -> HeadWeights:
        inputs = base + own + 3 + shared
        shapes = ((32, inputs), (32,), (outputs * k, 32), (outputs * k,))
        return HeadWeights(*(draw(*shape, scale=0.3) for shape in shapes))

    weights = torch.zeros(periods)
    weights[0], weights[-1] = 0.25, 0.75 if periods > 1 else 1.0
    rows = torch.arange(anchors * periods).view(anchors, periods)
    centres, covariance = draw(anchors, 3), head(7)
    covariance.w2[3:7:1], covariance.b2[3:7] = 0.0, 0.0  # a quaternion of length 0
    return DecodeInputs(
        anchors=centres,
        offsets=draw(anchors, k, 3),
        features=draw(anchors, base),
        blocks=draw(anchors * periods if own else 0, own),
        log_scales=draw(anchors, 6, scale=0.3) - 1,
        global_features=draw(periods, shared),
        period_weights=weights,
        opacity_head=head(1),
        covariance_head=covariance,
        color_head=head(3),
        camera_centre=centres[0].clone(),  # an anchor without a direction
        visible=None if all_seen else torch.arange(0, anchors, 2),
        used_offsets=torch.randint(0, 2**k, (anchors,), generator=generator),
        block_rows=rows if own else rows[:, :0],
    )


def trained(x: DecodeInputs, device: str) -> tuple[DecodeInputs, list[Tensor]]:
    """The inputs on a device, and those that learn."""

    def moved(value: Tensor | HeadWeights | None) -> Tensor | HeadWeights | None:
        if isinstance(value, HeadWeights):
            return HeadWeights(*(tensor.to(device, copy=True) for tensor in value))
        return None if value is None else value.to(device, copy=True)

    x = DecodeInputs(*(moved(value) for value in x))
    leaves = [getattr(x, n) for n in TRAINED] + [t for n in HEADS for t in getattr(x, n)]
    for leaf in leaves:
        leaf.requires_grad_()
    return x, leaves


def learn(splats: list[Tensor]) -> None:
    generator = torch.Generator().manual_seed(5)
    weighted = [s * torch.randn(s.shape, generator=generator).to(s) for s in splats]
    sum(s.sum() for s in weighted).backward()


@pytest.mark.parametrize("all_seen", [True, False])
@pytest.mark.parametrize(
    "sizes",
    [(150, 10, 1, 16, 16, 32), (33, 5, 3, 8, 4, 2), (20, 10, 1, 8, 0, 0), (7, 1, 2, 4, 3, 5)],
)
def test_values_and_gradients_are_those_of_the_definition(
    sizes: tuple[int, ...], all_seen: bool
) -> None:
    kernels, given = gpu_kernels("anchors.decode.gpu"), some_inputs(*sizes, all_seen=all_seen)
    x, leaves = trained(given, "cpu")
    splats = decode_reference(x)
    expected = (~(splats.opacities <= 0)).nonzero()[:, 0]
    wanted = [array.index_select(0, expected) for array in splats]
    learn(wanted)
    there, found_leaves = trained(given, DEVICE)
    found, index = kernels.decode(there, 0.0)
    learn(found)
    assert torch.equal(index.cpu(), expected) and 0 < len(index) < len(splats.opacities)
    for mine, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(mine.detach().cpu(), theirs.detach(), atol=2e-6, rtol=2e-6)
    for mine, theirs in zip(found_leaves, leaves, strict=True):
        if theirs.numel() and theirs.grad is not None:
            scale = max(theirs.grad.abs().max().item(), 1e-6)
            torch.testing.assert_close(mine.grad.cpu(), theirs.grad, atol=3e-6 * scale, rtol=0)


def test_nothing_in_view_and_nothing_switched_on() -> None:
    kernels, given = gpu_kernels("anchors.decode.gpu"), some_inputs(9, 4, 1, 8, 4, 2, all_seen=True)
    x, leaves = trained(given._replace(visible=torch.arange(0)), DEVICE)
    assert len(kernels.decode(x, 0.0)[1]) == 0
    off = given._replace(used_offsets=torch.zeros(9, dtype=torch.int64))
    x, leaves = trained(off, DEVICE)
    found, index = kernels.decode(x, 0.0)
    assert len(index) == 0
    learn(found)
    assert all(not leaf.grad.any() for leaf in leaves if leaf.grad is not None)
    assert len(kernels.decode(x, float("-inf"))[1]) == 36
