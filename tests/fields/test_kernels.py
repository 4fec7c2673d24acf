"""Kernels of radiance fields against their definitions, in values and gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from torch import Tensor
from unwritten_memory import filled_with_nan

from chronoscene.fields.compositing import (
    STOP,
    Front,
    composite,
    composite_reference,
    truncated_exp,
    visible,
)
from chronoscene.fields.grid import GridLayout, encode, encode_reference
from chronoscene.fields.mlp import Groups, initial_layers, make_groups, mlp, mlp_reference
from chronoscene.fields.rows import part_rows
from chronoscene.kernels.runtime import set_threads
from chronoscene.training import devices

LAYOUT = GridLayout(levels=4, log2_rows=10, base=4, finest=40)


def gradients(function: Callable[..., Tensor], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Value and gradients of a weighted sum of the output."""
    leaves = [t.detach().clone().requires_grad_() for t in tensors]
    out = function(*leaves)
    weights = torch.linspace(0.1, 1, out.numel(), dtype=out.dtype).view(out.shape)
    (out * weights).sum().backward()
    return [out.detach(), *(leaf.grad for leaf in leaves)]  # type: ignore[misc]


def assert_like_reference(
    fast: Callable[..., Tensor], reference: Callable[..., Tensor], tensors: Sequence[Tensor]
) -> None:
    """Compare with the definition in float64; threads and unwritten memory change no bit."""
    expected = gradients(reference, [t.double() for t in tensors])
    found = []
    for threads in (1, 2):
        set_threads(threads)
        found.append(gradients(fast, tensors))
    with filled_with_nan():
        found.append(gradients(fast, tensors))
    for one, two, filled, exact in zip(*found, expected, strict=True):
        assert torch.equal(one, two)
        assert torch.equal(one, filled)
        # Measured: 3e-6 of the largest number at most.
        torch.testing.assert_close(
            one.double(), exact, rtol=0, atol=2e-5 * float(exact.abs().max())
        )


def some_groups(counts: Sequence[int]) -> Groups:
    return make_groups(torch.tensor([0, *np.cumsum(counts)]))


def test_grid() -> None:
    places = torch.rand(20_003, 3, generator=torch.Generator().manual_seed(0))  # of many tasks
    table = torch.randn(int(LAYOUT.starts[-1]), 2, generator=torch.Generator().manual_seed(1))
    assert LAYOUT.dense.tolist() == [True, True, False, False]
    assert_like_reference(
        lambda t: encode(places, t, LAYOUT),
        lambda t: encode_reference(places.double(), t, LAYOUT),
        [table],
    )


def test_grid_of_ones_is_one() -> None:
    places = torch.rand(50, 3)
    table = torch.ones(int(LAYOUT.starts[-1]), 2)
    torch.testing.assert_close(encode(places, table, LAYOUT), torch.ones(50, LAYOUT.width))


@pytest.mark.parametrize(
    ("widths", "output"),
    [((10, 24, 9, 5), "none"), ((10, 64, 64, 3), "sigmoid"), ((10, 4), "none")],
)
def test_mlp(widths: tuple[int, ...], output: str) -> None:
    generator = torch.Generator().manual_seed(2)
    counts = np.random.default_rng(3).integers(0, 40, 150)
    groups = some_groups(counts.tolist())
    layers = initial_layers(widths, generator)
    layers = [t + 0.1 * torch.randn(t.shape, generator=generator) for t in layers]
    x = torch.randn(int(counts.sum()), 7, generator=generator)
    shared = torch.randn(150, 3, generator=generator)
    assert_like_reference(
        lambda x, s, *layers: mlp(x, s, groups, layers, output),  # type: ignore[arg-type]
        lambda x, s, *layers: mlp_reference(x, s, groups, layers, output),  # type: ignore[arg-type]
        [x, shared, *layers],
    )


def test_mlp_without_shared_input() -> None:
    generator = torch.Generator().manual_seed(2)
    groups = some_groups([70, 3])
    layers = initial_layers((5, 8, 2), generator)
    x = torch.randn(73, 5, generator=generator)
    assert_like_reference(
        lambda x, *layers: mlp(x, torch.zeros(2, 0), groups, layers),
        lambda x, *layers: mlp_reference(x, torch.zeros(2, 0).double(), groups, layers),
        [x, *layers],
    )


def test_composite() -> None:
    generator = torch.Generator().manual_seed(4)
    groups = some_groups([0, 5, 30, 1, 0, 64] * 20)
    count = int(groups.starts[-1])
    densities = torch.rand(count, generator=generator) * 3
    densities[40:60] = 400  # so that rays end
    lengths = torch.rand(count, generator=generator) * 0.1
    values = torch.rand(count, 4, generator=generator)

    def both(function: Callable[..., tuple[Tensor, Tensor]]) -> Callable[..., Tensor]:
        def joined(d: Tensor, v: Tensor) -> Tensor:
            sums, opacities = function(d, v, lengths.to(d), groups)
            return torch.cat((sums, opacities[:, None]), dim=1)

        return joined

    assert_like_reference(both(composite), both(composite_reference), [densities, values])


def test_plain_torch_tells_the_samples_of_a_ray_apart_behind_many_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In float32, what rays before have summed up would swallow the ray's own depths."""
    groups = some_groups([1_000, 20])
    densities = torch.cat((torch.full((1_000,), 1e6), torch.full((20,), 1.0)))
    values, lengths = torch.linspace(0, 1, 1_020)[:, None], torch.full((1_020,), 0.1)
    expected = composite(densities, values, lengths, groups)
    monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)
    assert visible(densities, lengths, groups).starts.tolist() == [0, 1, 21]
    for found, exact in zip(composite(densities, values, lengths, groups), expected, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_added_in_parts_are_like_all_at_once(dtype: torch.dtype) -> None:
    """With kernels to the bit: a render shows what a training sees."""
    generator = torch.Generator().manual_seed(5)
    groups = some_groups([9, 0, 40, 17] * 30)
    starts, count = groups.starts, int(groups.starts[-1])
    densities = torch.rand(count, generator=generator, dtype=dtype) * 60
    lengths = torch.rand(count, generator=generator, dtype=dtype) * 0.02
    values = torch.rand(count, 3, generator=generator, dtype=dtype)
    sums, opacities = composite(densities, values, lengths, groups)
    assert 0.2 < float((opacities > 1 - STOP).double().mean()) < 0.9
    front, done = Front(len(starts) - 1, "cpu"), 0
    if dtype == torch.float64:
        front.clear = front.clear.double()
    while done < 40:
        going = torch.nonzero(starts.diff() > done)[:, 0]
        part = some_groups((starts.diff()[going] - done).clamp_max(7).tolist())
        parts = (part_rows(x, starts[going] + done, part) for x in (densities, values, lengths))
        front.add(going, *parts, part)
        done += 7
    exact = {"rtol": 0, "atol": 0} if dtype == torch.float32 else {}
    torch.testing.assert_close(front.sums, sums, **exact)
    torch.testing.assert_close(1 - front.clear, opacities, **exact)


def test_what_is_visible_depends_on_what_is_in_front() -> None:
    groups, depths = some_groups([3, 3]), torch.full((6,), 5.0)
    found = visible(depths, torch.ones(6), groups)
    assert found.starts.tolist() == [0, 2, 4]  # exp(-5) is above the limit, exp(-10) below
    assert found.of_row.tolist() == [0, 0, 1, 1]
    found = visible(depths, torch.ones(6), groups, torch.tensor([1e-3, 1e-5]))
    assert found.starts.tolist() == [0, 1, 1]


def test_parts_of_groups() -> None:
    first, groups = torch.tensor([2, 5, 9]), some_groups([3, 0, 67])
    x = torch.randn(80, 5, generator=torch.Generator().manual_seed(6))
    chosen = torch.tensor([2, 3, 4, *range(9, 76)])
    assert_like_reference(
        lambda x: part_rows(x, first, groups), lambda x: x.index_select(0, chosen), [x]
    )
    assert torch.equal(part_rows(x[:, 0], first, groups), x[chosen, 0])
    assert torch.equal(part_rows(x.double(), first, groups), x.double()[chosen])


def test_gradients_of_the_definitions() -> None:
    torch.manual_seed(0)
    groups = some_groups([3, 0, 4])
    lengths = torch.rand(7).double()
    layers = [t.double().requires_grad_() for t in initial_layers((5, 6, 2), torch.Generator())]
    inputs = (torch.rand(7).double() + 0.1, torch.rand(7, 2).double())
    leaves = [t.requires_grad_() for t in inputs]
    assert torch.autograd.gradcheck(lambda d, v: composite_reference(d, v, lengths, groups), leaves)
    x, shared = torch.randn(7, 3).double(), torch.randn(3, 2).double()
    leaves = [x.requires_grad_(), shared.requires_grad_(), *layers]
    assert torch.autograd.gradcheck(
        lambda x, s, *layers: mlp_reference(x, s, groups, layers, "sigmoid"), leaves
    )
    table = torch.randn(int(LAYOUT.starts[-1]), 2).double()[:, :].requires_grad_()
    places = torch.rand(3, 3).double()
    (encode_reference(places, table, LAYOUT)[:, 5]).sum().backward()
    step = torch.zeros_like(table)
    row = int(table.grad[:, 1].abs().argmax())  # type: ignore[index]
    step[row, 1] = 1e-6
    change = encode_reference(places, table + step, LAYOUT) - encode_reference(
        places, table, LAYOUT
    )
    assert float(change.detach()[:, 5].sum()) / 1e-6 == pytest.approx(
        float(table.grad[row, 1]), rel=1e-6
    )  # type: ignore[index]


def test_slab_of_constant_density() -> None:
    """A slab of density s and thickness d lets exp(-s d) through, into however many samples."""
    groups = some_groups([16])
    lengths = torch.full((16,), 0.05)
    _, opacity = composite(torch.full((16,), 2.0), torch.ones(16, 1), lengths, groups)
    assert float(opacity) == pytest.approx(1 - np.exp(-1.6), abs=1e-6)


def test_nothing_counts_behind_an_opaque_sample() -> None:
    groups = some_groups([2])
    densities = torch.tensor([-np.log(STOP) * 1.01, 5.0])
    values = torch.tensor([[1.0], [7.0]], requires_grad=True)
    sums, _ = composite(densities.float(), values, torch.ones(2), groups)
    sums.sum().backward()  # type: ignore[no-untyped-call]
    assert values.grad is not None
    assert values.grad[1] == 0


def test_density_of_a_large_output_is_finite() -> None:
    x = torch.tensor([-200.0, 0.0, 1e4], requires_grad=True)
    density = truncated_exp(x)
    density.sum().backward()  # type: ignore[no-untyped-call]
    assert density.isfinite().all()
    assert density[1] == 1
    assert x.grad is not None
    assert x.grad.isfinite().all()
