"""The compiled decode against its definition, and properties of the definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from chronoscene.anchors.blocks import own_blocks
from chronoscene.anchors.decode import (
    DecodeInputs,
    HeadWeights,
    decode,
    decode_active,
    decode_reference,
    pack_bits,
    unpack_bits,
)
from chronoscene.anchors.decode.layout import BLOCK, CHUNK
from chronoscene.errors import ShapeError
from chronoscene.training.drawing import Splats

# Worst of 400 random problems against float64, relative to the largest number of a tensor (or to
# `SMALL`, where sums cancel): values 1.6e-6, gradients 5e-6, from quaternions near zero.
VALUE_TOLERANCE = 5e-6
GRADIENT_TOLERANCE = 2e-5
SMALL = 0.3


@dataclass(slots=True)
class Problem:
    """Arguments of the decode, and gradients to send back."""

    fixed: dict[str, Tensor]
    leaves: dict[str, Tensor]
    heads: tuple[HeadWeights, HeadWeights, HeadWeights]
    grads: tuple[Tensor, ...]

    def run(self, function: Any) -> tuple[Splats, dict[str, Tensor]]:
        """Outputs and the gradients of all leaves."""
        named = dict(self.leaves)
        for kind, head in zip("ovc", self.heads, strict=True):
            named |= {f"{kind}.{name}": weight for name, weight in head._asdict().items()}
        for leaf in named.values():
            leaf.grad = None
        out = self.call(function, self.leaves, self.heads)
        torch.autograd.backward(list(out), [grad.to(out.means) for grad in self.grads])
        return out, {n: torch.zeros_like(x) if x.grad is None else x.grad for n, x in named.items()}

    def call(self, function: Any, leaves: Any, heads: Any) -> Any:
        """Outputs."""
        names = ("opacity_head", "covariance_head", "color_head")
        named = dict(zip(names, heads, strict=True))
        return function(DecodeInputs(**self.fixed, **leaves, **named))

    def double(self) -> Problem:
        """The same numbers in float64."""

        def cast(tensor: Tensor) -> Tensor:
            if not tensor.is_floating_point():
                return tensor
            return tensor.detach().double().requires_grad_(tensor.requires_grad)

        return Problem(
            {name: cast(tensor) for name, tensor in self.fixed.items()},
            {name: cast(tensor) for name, tensor in self.leaves.items()},
            tuple(HeadWeights(*map(cast, head)) for head in self.heads),  # type: ignore[arg-type]
            self.grads,
        )


def make_problem(
    *,
    anchors: int = 30,
    visible: int = 20,
    offsets: int = 3,
    base: int = 4,
    period: int = 5,
    periods: int = 3,
    shared: int = 2,
    hidden: int = 6,
    weights: tuple[float, ...] = (0.0, 1.0, 0.0),
    shares: bool = False,
    seed: int = 0,
) -> Problem:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return torch.randn(*shape, generator=generator) * scale

    def leaf(*shape: int, scale: float = 1.0) -> Tensor:
        return normal(*shape, scale=scale).requires_grad_()

    inputs = base + period + 3 + shared

    def head(outputs: int) -> HeadWeights:
        return HeadWeights(
            leaf(hidden, inputs, scale=inputs**-0.5),
            leaf(hidden, scale=0.3),
            leaf(outputs, hidden, scale=hidden**-0.5),
            leaf(outputs, scale=0.3),
        )

    chosen = torch.randperm(anchors, generator=generator)[:visible].sort().values
    count = len(chosen) * offsets
    rows = own_blocks(anchors, periods)
    if shares:  # periods of an anchor that have one block
        leaders = torch.randint(0, periods, (anchors, periods), generator=generator)
        rows = rows.gather(1, leaders)
    return Problem(
        fixed={
            "anchors": normal(anchors, 3),
            "period_weights": torch.tensor(weights[:periods]),
            "camera_centre": normal(3),
            "visible": chosen,
            "used_offsets": torch.full((anchors,), -1),
            "block_rows": rows[:, : periods if period else 0],
        },
        leaves={
            "offsets": leaf(anchors, offsets, 3),
            "features": leaf(anchors, base),
            "blocks": leaf(anchors * periods, period),
            "log_scales": leaf(anchors, 6),
            "global_features": leaf(periods, shared),
        },
        heads=(head(offsets), head(7 * offsets), head(3 * offsets)),
        grads=tuple(normal(count, *shape) for shape in ((3,), (4,), (3,), (), (3,))),
    )


def assert_equals_reference(problem: Problem) -> None:
    ours, our_grads = problem.run(decode)
    truth, true_grads = problem.double().run(decode_reference)
    for name, value in ours._asdict().items():
        assert_near(name, value, getattr(truth, name), VALUE_TOLERANCE)
    for name, grad in our_grads.items():
        assert_near(f"gradient of {name}", grad, true_grads[name], GRADIENT_TOLERANCE)


def assert_near(name: str, value: Tensor, truth: Tensor, tolerance: float) -> None:
    assert value.shape == truth.shape
    assert value.dtype == torch.float32
    if value.numel():
        error = float((value.detach() - truth.detach()).abs().max())
        assert error <= tolerance * max(float(truth.detach().abs().max()), SMALL), (name, error)


@settings(max_examples=30, deadline=None)
@given(
    anchors=st.integers(1, 40),
    visible=st.integers(0, 40),
    offsets=st.integers(1, 12),
    base=st.integers(0, 20),
    period=st.integers(0, 20),
    shared=st.integers(0, 9),
    hidden=st.integers(1, 40),
    weights=st.lists(st.sampled_from([0.0, 0.3, 0.7, 1.0]), min_size=1, max_size=4),
    shares=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_equals_definition(visible: int, weights: list[float], **sizes: int) -> None:
    assert_equals_reference(
        make_problem(
            visible=min(visible, sizes["anchors"]),
            periods=len(weights),
            weights=tuple(weights),
            **sizes,
        )
    )


@pytest.mark.parametrize("visible", [BLOCK - 1, BLOCK, BLOCK + 1, CHUNK, CHUNK + 1, 3 * CHUNK + 70])
def test_block_and_chunk_edges(visible: int) -> None:
    assert_equals_reference(make_problem(anchors=visible + 5, visible=visible, offsets=2))


def test_paper_sizes() -> None:
    assert_equals_reference(
        make_problem(anchors=900, visible=700, offsets=10, base=16, period=16, shared=32, hidden=32)
    )


def test_definition_passes_gradcheck() -> None:
    sizes = {"anchors": 3, "visible": 2, "offsets": 2, "base": 2, "period": 1, "hidden": 3}
    problem = make_problem(weights=(0.4, 0.6, 0.0), **sizes).double()
    flat = [*problem.leaves.values(), *(weight for head in problem.heads for weight in head)]

    def run(*tensors: Tensor) -> Splats:
        leaves = dict(zip(problem.leaves, tensors[:5], strict=True))
        heads = tuple(HeadWeights(*tensors[first : first + 4]) for first in (5, 9, 13))
        return problem.call(decode_reference, leaves, heads)

    assert torch.autograd.gradcheck(run, flat)


@pytest.mark.parametrize("function", [decode, decode_reference])
def test_other_periods_and_hidden_anchors_get_exactly_nothing(function: Any) -> None:
    problem = make_problem(weights=(0.0, 1.0, 0.0))
    _, grads = problem.run(function)
    blocks = grads["blocks"].view(-1, 3, 5)
    hidden = torch.ones(30, dtype=torch.bool)
    hidden[problem.fixed["visible"]] = False
    assert not blocks[:, [0, 2]].any()
    assert bool(blocks[~hidden, 1].any())
    assert not grads["global_features"][[0, 2]].any()
    for name in ("offsets", "features", "log_scales"):
        assert not grads[name][hidden].any()
        assert bool(grads[name][~hidden].flatten(1).any(1).all())


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_mixed_periods_mix_features_not_images(share: float) -> None:
    problem = make_problem(weights=(1 - share, share, 0.0))
    mixed, _ = problem.run(decode)
    same = make_problem(weights=(1.0, 0.0, 0.0))
    with torch.no_grad():
        blocks = same.leaves["blocks"].view(-1, 3, 5)
        blocks[:, 0] = (1 - share) * blocks[:, 0] + share * blocks[:, 1]
        table = same.leaves["global_features"]
        table[0] = (1 - share) * table[0] + share * table[1]
    once, _ = same.run(decode)
    for a, b in zip(mixed, once, strict=True):
        torch.testing.assert_close(a, b, atol=2e-6, rtol=2e-6)


@pytest.mark.parametrize("function", [decode, decode_reference])
def test_anchor_in_the_camera_centre(function: Any) -> None:
    problem = make_problem()
    first = problem.fixed["visible"][0]
    problem.fixed["camera_centre"] = problem.fixed["anchors"][first].clone()
    out, grads = problem.run(function)
    assert all(bool(value.isfinite().all()) for value in (*out, *grads.values()))
    assert_equals_reference(problem)


@pytest.mark.parametrize("function", [decode, decode_reference])
def test_quaternion_without_direction_becomes_the_identity(function: Any) -> None:
    problem = make_problem()
    with torch.no_grad():
        for weight in (problem.heads[1].w2, problem.heads[1].b2):
            weight.reshape(3, 7, -1)[1, 3:] = 0
    out, grads = problem.run(function)
    identity = torch.tensor([1.0, 0, 0, 0]).expand(20, 4)
    assert torch.equal(out.quats.reshape(20, 3, 4)[:, 1], identity)
    assert not grads["v.b2"].reshape(3, 7)[1, 3:].any()
    assert all(bool(grad.isfinite().all()) for grad in grads.values())
    assert_equals_reference(problem)


def test_quaternions_are_unit() -> None:
    out, _ = make_problem(anchors=300, visible=300).run(decode)
    torch.testing.assert_close(out.quats.norm(dim=-1), torch.ones(900), atol=5e-7, rtol=0)


def test_zero_state_puts_all_gaussians_of_an_anchor_in_its_centre() -> None:
    """At the start of training offsets and features are zero."""
    problem = make_problem()
    with torch.no_grad():
        problem.leaves["offsets"].zero_()
    out, _ = problem.run(decode)
    centres = problem.fixed["anchors"][problem.fixed["visible"]]
    assert torch.equal(out.means.reshape(20, 3, 3), centres[:, None].expand(20, 3, 3))


def test_only_some_offsets_with_a_gradient() -> None:
    problem = make_problem(anchors=400, visible=400, offsets=4)
    live = torch.rand(1600, generator=torch.Generator().manual_seed(1)) < 0.1
    problem.grads = tuple(grad * live.reshape(-1, *[1] * (grad.ndim - 1)) for grad in problem.grads)
    assert_equals_reference(problem)


def test_no_gradient_at_all() -> None:
    problem = make_problem()
    problem.grads = tuple(torch.zeros_like(grad) for grad in problem.grads)
    _, grads = problem.run(decode)
    assert not any(bool(grad.any()) for grad in grads.values())


def test_outputs_that_do_not_matter() -> None:
    """Only some outputs reach the loss: the others send no gradient back."""
    problem = make_problem()
    out = problem.call(decode, problem.leaves, problem.heads)
    out.opacities.sum().backward()
    problem.grads = tuple(
        torch.ones_like(grad) if grad.ndim == 1 else torch.zeros_like(grad)
        for grad in problem.grads
    )
    ours = problem.leaves["features"].grad
    _, grads = problem.run(decode)
    assert ours is not None
    assert torch.equal(ours, grads["features"])


def active_gradients(problem: Problem, function: Any) -> tuple[Splats, Tensor, dict[str, Tensor]]:
    """Run with gradients for active Gaussians only; outputs of those, their index, gradients."""
    with torch.no_grad():
        opacities = problem.call(decode, problem.leaves, problem.heads).opacities
    active = opacities > 0
    index = active.nonzero()[:, 0]
    if function is decode_active:
        whole, problem.grads = problem.grads, tuple(grad[index] for grad in problem.grads)
        found: list[Tensor] = []

        def run(inputs: DecodeInputs) -> Splats:
            out, positions = decode_active(inputs)
            found.append(positions)
            return out

        out, grads = problem.run(run)
        problem.grads = whole
        return out, found[0], grads
    problem.grads = tuple(
        grad * active.reshape(-1, *[1] * (grad.ndim - 1)) for grad in problem.grads
    )
    out, grads = problem.run(function)
    return Splats(*(value[index] for value in out)), index, grads


@settings(max_examples=20, deadline=None)
@given(
    visible=st.integers(0, 30),
    offsets=st.integers(1, 12),
    hidden=st.integers(1, 40),
    shift=st.sampled_from([-9.0, -1.0, -0.3, 0.0, 9.0]),
    seed=st.integers(0, 1000),
)
def test_active_equals_the_active_part(
    visible: int, offsets: int, hidden: int, shift: float, seed: int
) -> None:
    problem = make_problem(visible=visible, offsets=offsets, hidden=hidden, seed=seed)
    with torch.no_grad():
        problem.heads[0].b2.add_(shift)
    ours, index, our_grads = active_gradients(problem, decode_active)
    whole, truth, grads = active_gradients(problem, decode)
    assert torch.equal(index, truth)
    assert all(torch.equal(a, b) for a, b in zip(ours, whole, strict=True))
    assert all(torch.equal(our_grads[name], grad) for name, grad in grads.items())


@given(st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1, max_size=9))
def test_bits(rows: list[list[bool]]) -> None:
    used = torch.tensor(rows)
    assert torch.equal(unpack_bits(pack_bits(used), 5), used)


def test_offsets_that_are_not_used_are_off() -> None:
    problem = make_problem(anchors=200, visible=150, offsets=4)
    whole = problem.call(decode, problem.leaves, problem.heads)
    bits = torch.randint(0, 16, (200,), generator=torch.Generator().manual_seed(7))
    problem.fixed["used_offsets"] = bits
    assert_equals_reference(problem)
    chosen = bits[problem.fixed["visible"]]
    used = torch.tensor([b >> j & 1 for b in chosen.tolist() for j in range(4)], dtype=torch.bool)
    some = problem.call(decode, problem.leaves, problem.heads)
    torch.testing.assert_close(some.opacities, torch.where(used, whole.opacities, -1.0))
    _, index = problem.call(decode_active, problem.leaves, problem.heads)
    assert torch.equal(index, (used & (whole.opacities > 0)).nonzero()[:, 0])


def test_active_over_several_chunks_and_threads(threads: Callable[[int], None]) -> None:
    problem = make_problem(anchors=3 * CHUNK, visible=2 * CHUNK + 77, offsets=5)
    with torch.no_grad():
        problem.heads[0].b2.sub_(0.5)
    threads(1)
    one, _, one_grads = active_gradients(problem, decode_active)
    one_grads = {name: grad.clone() for name, grad in one_grads.items()}
    threads(2)
    many, _, many_grads = active_gradients(problem, decode_active)
    assert 0 < len(one.means) < 5 * (2 * CHUNK + 77)
    assert all(torch.equal(a, b) for a, b in zip(one, many, strict=True))
    assert all(torch.equal(grad, many_grads[name]) for name, grad in one_grads.items())


def test_active_in_double_is_the_active_part_of_the_definition() -> None:
    problem = make_problem().double()
    out, index = problem.call(decode_active, problem.leaves, problem.heads)
    truth = problem.call(decode_reference, problem.leaves, problem.heads)
    assert torch.equal(index, (truth.opacities > 0).nonzero()[:, 0])
    assert torch.equal(out.colors, truth.colors[index])


def test_not_a_number_is_active() -> None:
    """It reaches the rasterizer, which reports it, instead of vanishing."""
    problem = make_problem()
    first = int(problem.fixed["visible"][0])
    with torch.no_grad():
        problem.leaves["features"][first, 0] = float("nan")
    out, index = problem.call(decode_active, problem.leaves, problem.heads)
    assert index[:3].tolist() == [0, 1, 2]
    assert bool(out.opacities[:3].isnan().all())
    assert bool(out.colors[:3].isnan().all())
    assert bool(out.opacities[3:].isfinite().all())


def test_same_bits_for_any_thread_count(threads: Callable[[int], None]) -> None:
    problem = make_problem(anchors=5 * CHUNK, visible=4 * CHUNK + 33, offsets=4)
    results = []
    for number in (1, 2):
        threads(number)
        out, grads = problem.run(decode)
        results.append([*out, *(grad.clone() for grad in grads.values())])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_an_anchor_does_not_depend_on_the_others() -> None:
    problem = make_problem(anchors=200, visible=200)
    whole, _ = problem.run(decode)
    chosen = torch.tensor([3, 77, 150])
    problem.fixed["visible"] = chosen
    problem.grads = tuple(grad[:9] for grad in problem.grads)
    part, _ = problem.run(decode)
    for a, b in zip(whole, part, strict=True):
        assert torch.equal(a.reshape(200, 3, -1)[chosen], b.reshape(3, 3, -1))


def test_strided_arguments() -> None:
    problem = make_problem()
    plain, _ = problem.run(decode)
    for name in ("offsets", "log_scales"):
        turned = problem.leaves[name].detach().transpose(0, 1).contiguous().transpose(0, 1)
        assert not turned.is_contiguous()
        problem.leaves[name] = turned.requires_grad_()
    strided, _ = problem.run(decode)
    assert all(torch.equal(a, b) for a, b in zip(plain, strided, strict=True))


def test_double_goes_through_the_definition() -> None:
    problem = make_problem().double()
    ours, _ = problem.run(decode)
    truth, _ = problem.run(decode_reference)
    assert all(torch.equal(a, b) for a, b in zip(ours, truth, strict=True))


@pytest.mark.parametrize("name", ["offsets", "features", "log_scales", "global_features"])
def test_wrong_sizes(name: str) -> None:
    problem = make_problem()
    problem.leaves[name] = torch.zeros(7, 7, requires_grad=True)
    with pytest.raises(ShapeError, match=f"{name}: expected shape"):
        problem.run(decode)


def test_wrong_head() -> None:
    problem = make_problem()
    problem.heads = (problem.heads[0], problem.heads[2], problem.heads[1])
    with pytest.raises(ShapeError, match="covariance head w2: expected shape"):
        problem.run(decode)


@pytest.mark.parametrize("indices", [[-1, 3], [3, 30], [4, 3], [3, 3]])
def test_wrong_visible(indices: list[int]) -> None:
    problem = make_problem()
    problem.fixed["visible"] = torch.tensor(indices)
    with pytest.raises(
        ShapeError, match=r"visible: expected ascending indices of 30 anchors, found \[.*\], at m"
    ):
        problem.run(decode)
