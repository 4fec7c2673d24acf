"""Adam against torch.optim.Adam, and rows that come and go."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.errors import ShapeError
from chronoscene.training.optimizers import adam as module
from chronoscene.training.optimizers.adam import BLOCK, Adam, Pace, all_finite, step_fused

# Worst of 1200 runs of 20 steps with rates up to 0.1: 1.7e-6, from rounding in another order.
TOLERANCE = 5e-6


def leaf(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()


def gradient(value: torch.Tensor, seed: int) -> torch.Tensor:
    return leaf(*value.shape, seed=1000 + seed, dtype=value.dtype).detach()


@settings(max_examples=25, deadline=None)
@given(
    rows=st.integers(0, 40),
    columns=st.integers(1, 5),
    rates=st.lists(st.floats(0, 0.1), min_size=1, max_size=20),
    scale=st.sampled_from([1e-12, 1e-4, 1.0, 1e6]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    views=st.sampled_from([1, 4]),
)
def test_equals_torch(
    rows: int, columns: int, rates: list[float], scale: float, dtype: torch.dtype, views: int
) -> None:
    """With several views, rates are larger by the root of their number, moments fade as often."""
    ours, theirs = (leaf(rows, columns, dtype=dtype) for _ in range(2))
    adam = Adam({"x": ours}, Pace(views))
    betas = (0.9**views, 0.999**views)
    reference = torch.optim.Adam([theirs], lr=0.0, betas=betas, eps=1e-15)
    for index, rate in enumerate(rates):
        ours.grad = gradient(ours, index) * scale
        theirs.grad = ours.grad.clone()
        reference.param_groups[0]["lr"] = views**0.5 * rate
        reference.step()
        adam.step({"x": rate})
    torch.testing.assert_close(ours, theirs, atol=TOLERANCE, rtol=TOLERANCE)


def test_large_array_equals_torch_and_any_thread_count(threads: Callable[[int], None]) -> None:
    results = []
    for number in (1, 2):
        threads(number)
        value = leaf(3 * BLOCK + 77)
        adam = Adam({"x": value})
        for index in range(3):
            value.grad = gradient(value, index)
            adam.step({"x": 0.01})
        results.append(value.detach())
    assert torch.equal(results[0], results[1])
    reference = leaf(3 * BLOCK + 77)
    torch_adam = torch.optim.Adam([reference], lr=0.01, eps=1e-15)
    for index in range(3):
        reference.grad = gradient(reference, index)
        torch_adam.step()
    torch.testing.assert_close(results[0], reference.detach(), atol=TOLERANCE, rtol=TOLERANCE)


def test_a_small_update_compiles_that_of_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warm-ups have small ones only; a training must not compile on its clock."""
    calls = []

    def large(*arrays: np.ndarray) -> None:
        calls.append([array.shape for array in arrays])

    large.signatures = calls  # type: ignore[attr-defined]
    monkeypatch.setattr(module, "adam_tensors", large)
    value = leaf(5)
    adam = Adam({"x": value})
    for index in range(2):
        value.grad = gradient(value, index)
        adam.step({"x": 0.1})
    assert calls == [[(0, 4), (1,), (0,), (0, module.SCALARS)]]


def test_tensors_together_have_the_bits_of_each_alone() -> None:
    sizes = {"small": 5, "large": 2 * BLOCK + 3, "empty": 0, "double": 7}

    def make() -> Adam:
        kinds = {"double": torch.float64}
        return Adam({n: leaf(s, dtype=kinds.get(n, torch.float32)) for n, s in sizes.items()})

    together, alone = make(), make()
    for step in range(3):
        for adam in (together, alone):
            for value in adam.params.values():
                value.grad = gradient(value, step)
        together.step(dict.fromkeys(sizes, 0.01) | {"small": 0.02})
        for name in sizes:
            others = [other for other in sizes if other != name]
            alone.step({name: 0.02 if name == "small" else 0.01}, skip=others)
    for name in sizes:
        assert torch.equal(together.params[name], alone.params[name])


def test_momentum_moves_rows_without_gradient() -> None:
    value = leaf(2, 3)
    adam = Adam({"x": value})
    value.grad = torch.ones(2, 3)
    adam.step({"x": 0.1})
    before = value.detach().clone()
    value.grad = torch.zeros(2, 3)
    adam.step({"x": 0.1})
    assert bool((value < before).all())


def test_zero_gradients_for_long_end_at_zero_moments() -> None:
    """Moments do not linger as denormals."""
    value = leaf(4)
    adam = Adam({"x": value})
    value.grad = torch.full((4,), 1e-10)
    adam.step({"x": 0.1})
    value.grad = torch.zeros(4)
    for _ in range(600):
        adam.step({"x": 0.1})
    assert bool((adam.state()["x.mean"] == 0).all())
    assert bool(value.isfinite().all())


@pytest.mark.parametrize("size", [0, 1, 20, 3 * BLOCK + 77])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_finite_sees_every_number(size: int, dtype: torch.dtype) -> None:
    value = leaf(size, dtype=dtype).detach() * torch.finfo(dtype).tiny
    value[: size // 2] = -torch.finfo(dtype).max
    assert all_finite([torch.zeros(3), value])
    for index in {0, size // 2, size - 1} & set(range(size)):
        for bad in ("nan", "inf", "-inf"):
            spoilt = value.clone()
            spoilt[index] = float(bad)
            assert not all_finite([torch.zeros(3), spoilt])
    assert all_finite([value.view(1, -1).T])


def test_nan_gradient_stays_visible() -> None:
    value = leaf(20)
    value.grad = torch.full((20,), float("nan"))
    Adam({"x": value}).step({"x": 0.1})
    assert bool(value.isnan().all())


def test_skip_and_missing_gradient_leave_everything_alone() -> None:
    a, b, c = leaf(3), leaf(3, seed=1), leaf(3, seed=2)
    adam = Adam({"a": a, "b": b, "c": c})
    before = [x.detach().clone() for x in (a, b, c)]
    a.grad, b.grad = torch.ones(3), torch.ones(3)
    adam.step({"b": 0.1, "c": 0.1}, skip={"a"})
    assert torch.equal(a, before[0])
    assert not torch.equal(b, before[1])
    assert torch.equal(c, before[2])
    assert [int(adam.state()[f"{name}.steps"]) for name in "abc"] == [0, 1, 0]


def test_extend_keeps_old_rows_and_starts_new_ones_at_zero() -> None:
    value = leaf(3, 2)
    adam = Adam({"x": value})
    value.grad = torch.ones(3, 2)
    adam.step({"x": 0.1})
    mean = adam.state()["x.mean"].clone()
    longer = adam.extend("x", torch.full((2, 2), 7.0))
    assert longer is adam.params["x"]
    assert longer.is_leaf
    assert longer.requires_grad
    assert longer.grad is None
    assert torch.equal(longer[:3], value)
    assert torch.equal(longer[3:], torch.full((2, 2), 7.0))
    assert torch.equal(adam.state()["x.mean"], torch.cat((mean, torch.zeros(2, 2))))
    assert torch.equal(adam.state()["x.square"][3:], torch.zeros(2, 2))
    assert int(adam.state()["x.steps"]) == 1


@given(mask=st.lists(st.booleans(), min_size=5, max_size=5))
@settings(deadline=None)
def test_keep_then_step_equals_step_of_the_kept_rows(mask: list[bool]) -> None:
    kept = torch.tensor(mask)
    whole, part = leaf(5, 2), leaf(5, 2).detach()[kept].requires_grad_()
    all_rows, some_rows = Adam({"x": whole}), Adam({"x": part})
    first, second = gradient(whole, 0), gradient(whole, 1)[kept]
    whole.grad, part.grad = first, first[kept]
    all_rows.step({"x": 0.1})
    some_rows.step({"x": 0.1})
    shorter = all_rows.keep("x", kept)
    assert shorter.is_contiguous()
    shorter.grad, part.grad = second, second
    all_rows.step({"x": 0.1})
    some_rows.step({"x": 0.1})
    torch.testing.assert_close(shorter, part, atol=1e-7, rtol=1e-6)


def test_reset_moments_keeps_the_step_count() -> None:
    value = leaf(3)
    adam = Adam({"x": value})
    value.grad = torch.ones(3)
    adam.step({"x": 0.1})
    adam.reset_moments("x")
    state = adam.state()
    assert not state["x.mean"].any()
    assert not state["x.square"].any()
    assert int(state["x.steps"]) == 1


def test_state_resumes_to_the_same_bits() -> None:
    value = leaf(50)
    adam = Adam({"x": value})
    value.grad = gradient(value, 0)
    adam.step({"x": 0.1})
    resumed = value.detach().clone().requires_grad_()
    other = Adam({"x": resumed})
    other.load_state({name: tensor.clone() for name, tensor in adam.state().items()})
    for index in (1, 2):
        value.grad, resumed.grad = gradient(value, index), gradient(value, index)
        adam.step({"x": 0.1})
        other.step({"x": 0.1})
    assert torch.equal(value, resumed)


def test_gradient_with_other_strides() -> None:
    straight, strided = leaf(4, 6), leaf(4, 6)
    grad = gradient(straight, 0)
    straight.grad, strided.grad = grad, grad.T.contiguous().T
    Adam({"x": straight}).step({"x": 0.1})
    Adam({"x": strided}).step({"x": 0.1})
    assert torch.equal(straight, strided)


def test_zero_grad() -> None:
    value = leaf(3)
    value.grad = torch.ones(3)
    Adam({"x": value}).zero_grad()
    assert value.grad is None


@pytest.mark.parametrize(
    "value", [torch.zeros(3), leaf(3) * 2, leaf(4, 3).detach().T.requires_grad_()]
)
def test_wrong_parameter(value: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match="parameter x: expected a contiguous leaf"):
        Adam({"x": value})


def test_wrong_rows() -> None:
    adam = Adam({"x": leaf(3, 2)})
    with pytest.raises(ShapeError, match="new rows of x"):
        adam.extend("x", torch.zeros(2, 3))
    with pytest.raises(ShapeError, match="mask of x"):
        adam.keep("x", torch.ones(2, dtype=torch.bool))


def test_fused_updates_are_those_of_torch() -> None:
    """The code of a GPU, with learning rates that differ, and a tensor without rows."""
    generator = torch.Generator().manual_seed(0)
    shapes, rates = {"a": (50, 3), "b": (7,), "none": (0, 3)}, {"a": 0.01, "b": 0.1, "none": 1.0}
    mine = {n: torch.randn(s, generator=generator).requires_grad_() for n, s in shapes.items()}
    theirs = {n: t.detach().clone().requires_grad_() for n, t in mine.items()}
    optimizer = Adam(mine)
    groups = [{"params": [theirs[n]], "lr": rates[n]} for n in ("a", "b")]
    reference = torch.optim.Adam(groups, eps=1e-15)
    for _ in range(20):
        for name, shape in shapes.items():
            mine[name].grad = torch.randn(shape, generator=generator)
            theirs[name].grad = mine[name].grad.clone()
        with torch.no_grad():
            step_fused(optimizer.updates(rates))
        reference.step()
    for name in ("a", "b"):
        torch.testing.assert_close(mine[name], theirs[name], atol=1e-6, rtol=1e-6)
