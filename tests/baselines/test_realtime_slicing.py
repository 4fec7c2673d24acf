"""Slices of Gaussians in space and time: the formulas in NumPy, and the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines.realtime_4dgs.slicing import SHAPES, slice_at, slice_reference, turned
from baselines.realtime_4dgs.slicing.function import OUTPUTS
from chronoscene.gaussians.model import axes_of, opacities_of
from chronoscene.kernels.runtime import set_threads
from chronoscene.scene.geometry import rotation_from_quaternion

TIME, CYCLE = 0.4, 1.3

# Worst of 120 random problems, relative to the largest number of a tensor or to 1, whichever is
# larger: values 7.1e-7, gradients 1.1e-6.
VALUE_TOLERANCE = 3e-6
GRADIENT_TOLERANCE = 5e-6


def make_parameters(count: int, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    made = {name: torch.randn(count, *shape, generator=generator) for name, shape in SHAPES.items()}
    made["time_means"] *= 3
    return made


def dense(parameters: dict[str, Tensor]) -> np.ndarray:
    """Covariance in (x, y, z, t), by products of quaternions one axis after the other."""
    found = []
    groups = (parameters[n].double().numpy() for n in ("quats", "right_quats", "log_scales"))
    for left, right, scales, time in zip(
        *groups, parameters["log_time_scales"].double().numpy(), strict=True
    ):
        left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
        columns = [times(times(left, axis), right * [1, -1, -1, -1]) for axis in np.eye(4)]
        R = np.roll(np.stack(columns, axis=1), -1, axis=(0, 1))  # from wxyz to xyzt
        np.testing.assert_allclose(R @ R.T, np.eye(4), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        S = np.diag(np.exp([*scales, time]))
        found.append(R @ S @ S @ R.T)
    return np.array(found)


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions: Hamilton's, with cross and dot product."""
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *vector])


def covariances_of(sliced: dict[str, Tensor]) -> np.ndarray:
    rotations = [rotation_from_quaternion(q / q.norm()) for q in sliced["quats"].double().detach()]
    axes = np.array(rotations) * sliced["log_scales"].double().detach().exp().numpy()[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_slices_are_those_of_the_dense_formula(function: Any) -> None:
    p = make_parameters(200)
    covariances = dense(p)
    sliced = function(p, TIME, cycle=CYCLE, order=2)
    dt = TIME - p["time_means"].double().numpy()
    xx, xt, tt = covariances[:, :3, :3], covariances[:, :3, 3], covariances[:, 3, 3]
    weights = np.exp(-0.5 * dt * dt / tt)
    alive = weights > 0.05
    assert 20 < alive.sum() < 180
    opacities = opacities_of(sliced["logit_opacities"]).numpy()
    expected = np.where(alive, opacities_of(p["logit_opacities"]).numpy() * weights, 0)
    np.testing.assert_allclose(opacities, expected, atol=1e-6)
    means = p["means"].double().numpy() + xt / tt[:, None] * dt[:, None]
    np.testing.assert_allclose(sliced["means"].numpy()[alive], means[alive], rtol=1e-5, atol=1e-5)
    conditional = xx - xt[:, :, None] * xt[:, None] / tt[:, None, None]
    size = np.abs(conditional).max((1, 2), keepdims=True)
    error = np.abs(covariances_of(sliced) - conditional) / size
    assert error[alive].max() < 2e-6
    waves = [np.cos(2 * np.pi * k * dt / CYCLE)[:, None] for k in (1, 2)]
    dc = p["sh_dc"].numpy() + sum(w * p["waves_dc"][:, k].numpy() for k, w in enumerate(waves))
    np.testing.assert_allclose(sliced["sh_dc"].numpy()[alive], dc[alive], atol=1e-5)


def run(
    function: Any, p: dict[str, Tensor], kind: Any, order: int
) -> tuple[dict[str, Tensor], dict[str, Tensor | None]]:
    """Outputs, and the gradients of the parameters for given ones of the outputs."""
    leaves = {name: value.to(kind, copy=True).requires_grad_() for name, value in p.items()}
    out = function(leaves, TIME, cycle=CYCLE, order=order)
    generator = torch.Generator().manual_seed(7)
    grads = {name: torch.randn(out[name].shape, generator=generator) for name in OUTPUTS}
    for grad in grads.values():
        grad[len(grad) // 3 : len(grad) // 2] = 0
    torch.autograd.backward([out[n] for n in OUTPUTS], [grads[n].to(kind) for n in OUTPUTS])
    return out, {name: leaf.grad for name, leaf in leaves.items()}


def assert_near(name: str, value: Tensor, truth: Tensor, tolerance: float) -> None:
    assert value.shape == truth.shape and value.dtype == torch.float32
    dead = truth.isinf()
    assert torch.equal(value[dead].double(), truth[dead]), name
    error = (value - truth)[~dead].detach().abs()
    scale = float(truth[~dead].detach().abs().amax()) if error.numel() else 0
    assert (error <= tolerance * max(scale, 1)).all(), (name, float(error.amax()), scale)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_values_and_gradients_equal_the_reference(count: int, order: int) -> None:
    p = make_parameters(count)
    ours, our_grads = run(slice_at, p, torch.float32, order)
    truth, true_grads = run(slice_reference, p, torch.float64, order)
    assert ours.keys() == truth.keys() == set(OUTPUTS)
    for name in OUTPUTS:
        assert_near(name, ours[name], truth[name], VALUE_TOLERANCE)
    for name in SHAPES:
        grad, true_grad = our_grads[name], true_grads[name]
        if order == 0 and name.startswith("waves"):
            assert grad is None
            continue
        assert grad is not None and true_grad is not None
        assert_near(f"gradient of {name}", grad, true_grad, GRADIENT_TOLERANCE)


def test_the_reference_has_the_gradients_of_finite_differences() -> None:
    """This is also the code that a GPU runs. Of the covariance, which does not know in which order
    its axes are; one Gaussian of four is not there at the time."""
    p = make_parameters(4, seed=3)
    p["time_means"] = torch.tensor([0.3, 0.7, -0.2, 9.0])
    p["log_scales"] = torch.tensor([0.0, -1.0, 0.7]).repeat(4, 1) + 0.1 * p["log_scales"]
    p["log_time_scales"] = torch.zeros(4)
    for name in ("sh_rest", "waves_rest"):
        p[name][..., 2:, :] = 0
    leaves = [value.double().requires_grad_() for value in p.values()]

    def function(*values: Tensor) -> tuple[Tensor, ...]:
        sliced = slice_reference(dict(zip(p, values, strict=True)), TIME, cycle=CYCLE, order=2)
        axes = torch.stack([torch.stack(a, dim=-1) for a in axes_of(sliced["quats"])], dim=-1)
        factor = axes * sliced["log_scales"].exp()[:, None]
        opacities = torch.sigmoid(sliced["logit_opacities"])
        rest = sliced["sh_rest"][:, :2]
        covariances = (factor @ factor.transpose(1, 2))[:3]
        return sliced["means"], covariances, opacities, sliced["sh_dc"], rest

    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-4, fast_mode=True)


def conditional_covariances(p: dict[str, Tensor]) -> Tensor:
    """By the dense formula, for autograd. [N, 3, 3]"""
    basis = torch.eye(4, dtype=p["quats"].dtype)[:, None].expand(4, len(p["quats"]), 4)
    columns = [turned(p["quats"], p["right_quats"], axis) for axis in basis]
    scales = torch.cat([p["log_scales"], p["log_time_scales"][:, None]], dim=-1).exp()
    factor = torch.stack(columns, dim=-1) * scales[:, None]
    covariances = factor @ factor.transpose(1, 2)
    xt, tt = covariances[:, :3, 3], covariances[:, 3, 3]
    return covariances[:, :3, :3] - xt[:, :, None] * xt[:, None] / tt[:, None, None]


@pytest.mark.parametrize("nearly_round", [False, True])
def test_gradients_are_those_of_the_covariance(nearly_round: bool) -> None:
    """Through quaternions and scales; of the scales also where their axes are not defined."""
    p = make_parameters(100)
    names = ["log_scales", "log_time_scales", "quats", "right_quats"]
    if nearly_round:
        p = round_parameters(100)
        tilts = 1e-5 * torch.randn(100, 4, generator=torch.Generator().manual_seed(1))
        p["quats"] = p["quats"] + tilts
        names = ["log_scales"]
    p["time_means"].fill_(TIME)
    weights = torch.randn(100, 3, 3, generator=torch.Generator().manual_seed(2))
    leaves = {name: value.clone().requires_grad_() for name, value in p.items()}
    sliced = slice_at(leaves, TIME, cycle=CYCLE, order=0)
    axes = torch.stack([torch.stack(a, dim=-1) for a in axes_of(sliced["quats"])], dim=-1)
    factor = axes * sliced["log_scales"].exp()[:, None]
    (weights * (factor @ factor.transpose(1, 2))).sum().backward()
    exact = {name: value.double().requires_grad_() for name, value in p.items()}
    (weights.double() * conditional_covariances(exact)).sum().backward()
    found = [
        torch.cat([given[name].grad.reshape(100, -1) for name in names], dim=1)
        for given in (leaves, exact)
    ]
    error, size = (x.abs().amax(1) for x in (found[0] - found[1], found[1]))
    # Measured: 1.8e-3, and medians of 1.4e-6 and 1.4e-5, from rows that are nearly orthogonal.
    assert (error <= 5e-3 * size).all() and float((error / size).median()) < 1e-4


def round_parameters(count: int) -> dict[str, Tensor]:
    """Equal scales in space, nothing turned, and the same time."""
    p = make_parameters(count)
    p["log_scales"] = p["log_scales"][:, :1].repeat(1, 3)
    for name in ("quats", "right_quats"):
        p[name] = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    p["log_time_scales"].fill_(-0.3)
    return p


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_what_is_not_turned_keeps_place_and_shape_and_its_opacity_falls(function: Any) -> None:
    p = round_parameters(50)
    p["time_means"] = torch.linspace(-2, 2, 50)
    sliced = function(p, TIME, cycle=CYCLE, order=0)
    weights = torch.exp(-0.5 * ((TIME - p["time_means"]) / np.exp(-0.3)) ** 2)
    assert weights.min() < 0.05 < 0.9 < weights.max()
    for name in ("means", "sh_dc", "sh_rest"):
        assert torch.equal(sliced[name], p[name])
    alive = weights > 0.05
    torch.testing.assert_close(sliced["log_scales"][alive], p["log_scales"][alive])
    torch.testing.assert_close(sliced["quats"], p["quats"])
    expected = torch.where(alive, opacities_of(p["logit_opacities"]) * weights, 0)
    torch.testing.assert_close(opacities_of(sliced["logit_opacities"]), expected)


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_a_weight_of_a_twentieth_is_the_end(function: Any) -> None:
    """At 2.448 standard deviations, on either side."""
    p = round_parameters(4)
    p["time_means"] = TIME + np.exp(-0.3) * torch.tensor([-2.4478, 2.4478, -2.4476, 2.4476])
    sliced = function(p, TIME, cycle=CYCLE, order=2)
    assert (sliced["logit_opacities"] == -torch.inf).tolist() == [True, True, False, False]


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_colours_are_alike_before_and_after_the_centre(function: Any) -> None:
    p = round_parameters(20)
    p["time_means"].fill_(0.5)
    before, centre, after = (function(p, t, cycle=CYCLE, order=2) for t in (0.2, 0.5, 0.8))
    for name in ("sh_dc", "sh_rest"):
        torch.testing.assert_close(before[name], after[name])
        assert not torch.allclose(before[name], centre[name], atol=0.1)


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_round_gaussians_have_gradients(function: Any) -> None:
    """No axis of theirs is longer than another; a turn changes nothing."""
    _, grads = run(function, round_parameters(30), torch.float32, 2)
    for name, grad in grads.items():
        assert grad is not None and grad.isfinite().all(), name
    assert grads["log_scales"].any() and grads["quats"].any()  # by the velocity


@pytest.mark.parametrize("function", [slice_at, slice_reference])
def test_quaternions_of_length_zero_make_gaussians_that_are_never_there(function: Any) -> None:
    p = round_parameters(3)
    p["time_means"].zero_()
    p["quats"][0] = p["right_quats"][1] = 0
    out, grads = run(function, p, torch.float32, 2)
    assert (out["logit_opacities"] == -torch.inf).tolist() == [True, True, False]
    assert all(grad.isfinite().all() for grad in grads.values() if grad is not None)


def test_needles_keep_their_width() -> None:
    """A thousand times as long as wide, turned in space and time."""
    p = make_parameters(100)
    p["log_scales"] = torch.tensor([0.0, -7.0, -7.5]).repeat(100, 1)
    p["log_time_scales"].fill_(1.0)
    out = slice_at(p, TIME, cycle=CYCLE, order=0)
    alive = out["logit_opacities"].isfinite()
    with torch.no_grad():
        truth = slice_reference({n: v.double() for n, v in p.items()}, TIME, cycle=CYCLE, order=0)
    torch.testing.assert_close(
        out["log_scales"][alive].double(), truth["log_scales"][alive], rtol=0, atol=1e-5
    )
    covariances = dense(p)
    xt, tt = covariances[:, :3, 3], covariances[:, 3, 3]
    exact = covariances[:, :3, :3] - xt[:, :, None] * xt[:, None] / tt[:, None, None]
    widths = np.sqrt(np.linalg.eigvalsh(exact).clip(0))[:, 1]
    middle = out["log_scales"].exp().sort(dim=-1).values[:, 1]
    np.testing.assert_allclose(middle[alive], widths[alive.numpy()], rtol=1e-3)


def test_the_same_bits_whatever_the_number_of_threads() -> None:
    p, results = make_parameters(5_000), []
    for threads in (1, 2):
        set_threads(threads)
        values, grads = run(slice_at, p, torch.float32, 2)
        results.append([*values.values(), *grads.values()])
    for one, two in zip(*results, strict=True):
        assert one is not None and torch.equal(one, two)
