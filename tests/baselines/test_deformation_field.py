"""The compiled field of 4DGS against its definition, and properties of the definition."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from baselines.deformation_4dgs.field import HEADS, Field, deform, deform_reference
from baselines.deformation_4dgs.field.layout import BLOCK, PARTS
from baselines.deformation_4dgs.field.smoothness import Weights, smoothness, smoothness_reference
from chronoscene.errors import ShapeError
from chronoscene.gaussians.model import SHAPES
from chronoscene.kernels.runtime import set_threads

# Worst of 200 random problems against float64, relative to the largest number of a tensor (or to
# `SMALL`, where sums cancel): values 1.3e-6, gradients 5.2e-6.
VALUE_TOLERANCE = 5e-6
GRADIENT_TOLERANCE = 2e-5
SMALL = 0.3

ALL, SHAPE_ONLY = tuple(HEADS), tuple(HEADS)[:3]
WEIGHTS = Weights(space=0.7, time=0.4, ones=0.2)


def make_field(**changes: Any) -> Field:
    sizes = {"sizes": (5, 9), "time_cells": 4, "channels": 6, "width": 10, "heads": ALL}
    box = {"low": (-1.0, -1.0, -1.2), "high": (1.0, 1.1, 1.0), "offset_unit": 0.5}
    return Field(**{**sizes, **box, **changes})


def make_problem(
    field: Field, count: int, seed: int = 0
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
    """Parameters, tensors of the field, and gradients to send back, of which some rows are 0."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    parameters = {name: normal(count, *shape) for name, shape in SHAPES.items()}
    tensors = {
        name: torch.rand(shape, generator=generator) + 0.5
        if name.startswith("planes.")
        else normal(*shape) * shape[-1] ** -0.5
        for name, shape in field.shapes().items()
    }
    grads = {name: normal(count, *shape) for name, shape in SHAPES.items()}
    for grad in grads.values():
        grad[count // 3 : count // 2] = 0
    return parameters, tensors, grads


def run(
    function: Any, problem: tuple[dict[str, Tensor], ...], field: Field, time: float, kind: Any
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Outputs, and the gradients of all that has one."""
    parameters, tensors, grads = problem
    leaves = [
        {name: value.to(kind, copy=True).requires_grad_() for name, value in given.items()}
        for given in (parameters, tensors)
    ]
    out = function(*leaves, field, time)
    torch.autograd.backward(list(out.values()), [grads[name].to(kind) for name in out])
    named = {name: leaf.grad for leaf in leaves for name, leaf in leaf.items()}
    return out, {name: grad for name, grad in named.items() if grad is not None}


def assert_near(name: str, value: Tensor, truth: Tensor, tolerance: float) -> None:
    assert value.shape == truth.shape and value.dtype == torch.float32
    error = float((value.detach() - truth.detach()).abs().max())
    assert error <= tolerance * max(float(truth.detach().abs().max()), SMALL), (name, error)


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
@pytest.mark.parametrize(
    ("count", "changes"),
    [
        (300, {}),
        (BLOCK, {"heads": SHAPE_ONLY}),
        (BLOCK + 1, {"heads": (*SHAPE_ONLY, "logit_opacities"), "channels": 20, "width": 33}),
        (1, {"heads": (*SHAPE_ONLY, "sh"), "sizes": (2,), "time_cells": 2}),
        (PARTS * BLOCK + 5, {"sizes": (4, 8, 16), "channels": 3, "width": 7}),
    ],
)
def test_values_and_gradients_equal_the_reference(
    count: int, changes: dict[str, Any], time: float
) -> None:
    field = make_field(**changes)
    problem = make_problem(field, count)
    ours, our_grads = run(deform, problem, field, time, torch.float32)
    truth, true_grads = run(deform_reference, problem, field, time, torch.float64)
    assert ours.keys() == truth.keys() and our_grads.keys() == true_grads.keys()
    for name in ours:
        assert_near(name, ours[name], truth[name], VALUE_TOLERANCE)
    for name in our_grads:
        assert_near(f"gradient of {name}", our_grads[name], true_grads[name], GRADIENT_TOLERANCE)


def test_the_reference_has_the_gradients_of_finite_differences() -> None:
    """This is also the code that a GPU runs."""
    field = make_field(sizes=(3,), channels=2, width=3, time_cells=3)
    parameters, tensors, _ = make_problem(field, 3)
    leaves = [v.double().requires_grad_() for v in (*parameters.values(), *tensors.values())]

    def function(*values: Tensor) -> tuple[Tensor, ...]:
        own = dict(zip(parameters, values[: len(parameters)], strict=True))
        shared = dict(zip(tensors, values[len(parameters) :], strict=True))
        return tuple(deform_reference(own, shared, field, 0.3).values())

    assert torch.autograd.gradcheck(function, leaves, eps=1e-6)


def test_the_same_bits_whatever_the_number_of_threads() -> None:
    field = make_field()
    problem = make_problem(field, 5_000)
    results = []
    for threads in (1, 2):
        set_threads(threads)
        values, grads = run(deform, problem, field, 0.4, torch.float32)
        results.append([*values.values(), *grads.values()])
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


def test_no_gaussians_have_no_gradient() -> None:
    field = make_field()
    values, grads = run(deform, make_problem(field, 0), field, 0.4, torch.float32)
    assert len(values["means"]) == 0
    assert not any(grads[name].any() for name in field.shapes())


@pytest.mark.parametrize("function", [deform, deform_reference])
def test_outputs_of_zero_change_no_bit(function: Any) -> None:
    field = make_field()
    parameters, tensors, _ = make_problem(field, 100)
    zeros = {n: t * 0 if ".output." in n else t for n, t in tensors.items()}
    for name, value in function(parameters, zeros, field, 0.7).items():
        assert torch.equal(value, parameters[name]), name


@pytest.mark.parametrize("function", [deform, deform_reference])
def test_planes_of_ones_make_time_irrelevant(function: Any) -> None:
    field = make_field()
    parameters, tensors, _ = make_problem(field, 100)
    ones = {n: torch.ones_like(t) if n.endswith("t") else t for n, t in tensors.items()}
    one, two = (function(parameters, ones, field, time) for time in (0.1, 0.8))
    changed = function(parameters, tensors, field, 0.8)
    for name in field.changed:
        torch.testing.assert_close(one[name], two[name], rtol=1e-6, atol=1e-6)
        assert not torch.allclose(changed[name], two[name], rtol=1e-6, atol=1e-6)


def test_a_gaussian_outside_the_box_is_as_at_its_border() -> None:
    field = make_field()
    parameters, tensors, _ = make_problem(field, 2)
    parameters["means"] = torch.tensor([[9.0, 0.2, -7.0], [1.0, 0.2, -1.2]])
    for function in (deform, deform_reference):
        moved = function(parameters, tensors, field, 0.4)["means"] - parameters["means"]
        torch.testing.assert_close(moved[0], moved[1])


def test_points_in_one_place_have_a_box() -> None:
    field = make_field(low=(1.0, 1.0, 1.0), high=(1.0, 1.0, 1.0))
    parameters, tensors, _ = make_problem(field, 5)
    parameters["means"] = torch.ones(5, 3)
    assert all(v.isfinite().all() for v in deform(parameters, tensors, field, 0.4).values())


@pytest.mark.parametrize(
    ("base", "levels", "channels", "cells"), [(64, 2, 16, 150), (16, 2, 8, 3), (64, 4, 32, 25)]
)
def test_numbers_in_the_planes(base: int, levels: int, channels: int, cells: int) -> None:
    field = make_field(
        sizes=tuple(base << level for level in range(levels)), channels=channels, time_cells=cells
    )
    for level, size in enumerate(field.sizes):
        shapes = [s for n, s in field.shapes().items() if n.startswith(f"planes.{level}.")]
        count = sum(torch.Size(shape).numel() for shape in shapes)
        assert count == 3 * channels * size**2 + 3 * channels * size * cells


def test_tensors_of_another_shape_are_refused() -> None:
    field = make_field()
    parameters, tensors, _ = make_problem(field, 3)
    tensors["planes.0.xt"] = tensors["planes.0.xt"][1:]
    with pytest.raises(ShapeError, match=r"planes\.0\.xt"):
        deform(parameters, tensors, field, 0.0)


def test_planes_linear_in_time_are_smooth_and_others_are_not() -> None:
    field = make_field()
    _, tensors, _ = make_problem(field, 0)
    linear = {
        name: torch.linspace(0, 1, len(t))[:, None, None] * t[:1] + t[1:2]
        for name, t in tensors.items()
        if name.startswith("planes.")
    } | {"trunk.bias": tensors["trunk.bias"]}
    for function in (smoothness, smoothness_reference):
        assert float(function(linear, field, Weights(1.0, 1.0, 0.0))) < 1e-12
        assert float(function(tensors, field, Weights(0.0, 1.0, 0.0))) > 0.1
    ones = {name: torch.ones_like(t) for name, t in tensors.items()}
    assert float(smoothness(ones, field, WEIGHTS)) == 0


@pytest.mark.parametrize("cells", [2, 3, 6])
def test_smoothness_equals_its_reference(cells: int) -> None:
    field = make_field(time_cells=cells)
    _, tensors, _ = make_problem(field, 0)
    found = []
    for function, kind in ((smoothness, torch.float32), (smoothness_reference, torch.float64)):
        leaves = {name: t.to(kind, copy=True).requires_grad_() for name, t in tensors.items()}
        value = function(leaves, field, WEIGHTS)
        (3 * value).backward()
        found.append((value, {n: leaf.grad for n, leaf in leaves.items() if "planes" in n}))
    (value, grads), (truth, true_grads) = found
    assert_near("value", value, truth, VALUE_TOLERANCE)
    for name in grads:
        # Means over many numbers: relative to the largest of them.
        scale = float(true_grads[name].abs().max())
        torch.testing.assert_close(
            grads[name].double(), true_grads[name], rtol=0, atol=1e-6 * scale
        )
