"""Fields in plain torch, which a GPU runs, beside the kernels of the CPU."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pretended_gpu import OnGpu, PretendedGpu
from torch import Tensor

from chronoscene.fields.box import SceneBox, contract, contract_reference
from chronoscene.fields.marching import Samples, march, march_reference
from chronoscene.fields.method import FieldMethod
from chronoscene.fields.rays import Rays
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import build_config, import_object, load_spec
from chronoscene.training import devices

SMALL = {"samples": 4_096, "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16}
PLAIN = {"encoding": "frequencies", "frequencies": 4, "layers": 2, "hidden": 32, "samples": 4_096}
CASES: dict[str, dict[str, Any]] = {
    "clnerf": SMALL,
    "cl-nerf": SMALL,
    "neusc": SMALL,
    "nerf-w": SMALL,
    "ha-nerf": SMALL,
    "nerf-t": PLAIN | {"activation": "softplus"},
}
WARM_UP = 8
"""Steps before a comparison, so that there are surfaces."""
LOSS_TOLERANCE = 1e-6
"""Relative. Measured: 1.1e-7."""
GRADIENT_TOLERANCE = 2e-5
"""Relative to the largest of a tensor. Measured: 6.7e-6."""
RENDER_TOLERANCE = 5e-6
"""Tolerance of colours and opacities, and of depths relatively. Measured: 9e-7."""


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)


def small(name: str) -> FieldMethod:
    spec = load_spec(name)
    config = build_config(spec, preset="fast", overrides=CASES[name])
    method: FieldMethod = import_object(spec.method)(config)
    return method


@pytest.fixture(scope="module", params=list(CASES))
def trained(request: pytest.FixtureRequest) -> FieldMethod:
    method = small(request.param)
    method.setup(make_training_set(3), seed=0, device="cpu")
    for i in range(WARM_UP):
        method.step(i, i / 100)
    return method


def loss_and_gradients(
    method: FieldMethod, rays: Rays, samples: Samples
) -> tuple[float, dict[str, Tensor]]:
    """Loss of a step, and the gradients of all tensors."""
    assert method.optimizer is not None
    drawn, _ = method.draw(rays, samples, method.codes(rays))
    loss = method.loss(drawn, rays, 0.1)
    method.optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    return loss.item(), method.optimizer.gradients()


def test_losses_and_gradients_are_those_of_the_kernels(
    trained: FieldMethod, monkeypatch: pytest.MonkeyPatch
) -> None:
    rays = trained.draw_rays(np.random.default_rng(7))
    # The same for both: where a place is rounded over the border of a cell, its gradient moves.
    middle = torch.full_like(rays.depths, 0.5)
    samples = trained.march(rays, trained.pool.periods[rays.views], middle)
    loss, gradients = loss_and_gradients(trained, rays, samples)
    without_kernels(monkeypatch)
    found, others = loss_and_gradients(trained, rays, samples)
    assert found == pytest.approx(loss, rel=LOSS_TOLERANCE)
    assert others.keys() == gradients.keys()
    for name, exact in gradients.items():
        largest = float(exact.abs().max())
        assert largest > 0, name
        torch.testing.assert_close(
            others[name], exact, rtol=0, atol=GRADIENT_TOLERANCE * largest, msg=name
        )


def test_renders_are_those_of_the_kernels(
    trained: FieldMethod, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, last = make_training_set(1).views[0], int(trained.meta["num_periods"]) - 1
    expected = trained.render_split(view, geometry_period=0.0, appearance_period=last / 2)
    without_kernels(monkeypatch)
    found = trained.render_split(view, geometry_period=0.0, appearance_period=last / 2)
    assert found.alpha is not None and expected.alpha is not None
    assert found.depth is not None and expected.depth is not None
    np.testing.assert_allclose(found.rgb, expected.rgb, rtol=0, atol=RENDER_TOLERANCE)
    np.testing.assert_allclose(found.alpha, expected.alpha, rtol=0, atol=RENDER_TOLERANCE)
    np.testing.assert_allclose(found.depth, expected.depth, rtol=RENDER_TOLERANCE)


@pytest.mark.parametrize("name", CASES)
def test_a_step_copies_nothing_between_devices_and_mixes_none(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """On a CPU that pretends to be a GPU; which photos are drawn is all that it is told."""
    data = make_training_set(3)
    view, periods = data.views[0], {"geometry_period": 0.0, "appearance_period": 1.5}
    gpu, method_module = PretendedGpu(), sys.modules[FieldMethod.__module__]
    for function in ("to_device", "uniform", "integers"):
        for module in (devices, method_module):
            monkeypatch.setattr(module, function, getattr(gpu, function), raising=False)
    monkeypatch.setattr(method_module, "load_tensors", gpu.load_tensors)
    with gpu:
        method = small(name)
        method.setup(data, seed=0, device="cuda")
        gpu.moves.clear()
        for index in (16, 17, 512):  # With and without a refresh, and one that decides about cells
            assert method.step(index, 0.1).skipped is None
        assert set(gpu.moves) <= ({"to_device"} if name == "ha-nerf" else set())
        image = method.render_split(view, **periods).rgb
        method.save(tmp_path)
        loaded: FieldMethod = type(method)(method.config)
        loaded.load(tmp_path, device="cuda")
        assert isinstance(loaded.occupancy.grids[0], OnGpu)
        np.testing.assert_allclose(loaded.render_split(view, **periods).rgb, image, atol=1e-6)


def some_rays(count: int) -> dict[str, Any]:
    """Rays from within and around a box, in three periods, with grids that are half empty."""
    random = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    directions[:3] = torch.eye(3)
    return {
        "origins": 3 * torch.rand(count, 3, generator=random) - 1.5,
        "directions": directions,
        "periods": torch.randint(3, (count,), generator=random),
        "jitter": torch.rand(count, generator=random),
        "grids": tuple(
            (torch.rand(3, size, size, size, generator=random) < 0.5).to(torch.uint8)
            for size in (16, 8)
        ),
        "box": SceneBox((0.0, 0.0, 0.0), 1.0, (1.0, 0.7, 0.4)),
        "step": 0.03,
        "shells": 5,
    }


def doubled(rays: dict[str, Any]) -> dict[str, Any]:
    names = ("origins", "directions", "jitter")
    return rays | {name: rays[name].double() for name in names}


def test_samples_are_those_of_the_definition() -> None:
    """All but those within rounding of the border of a cell, of which there are next to none."""
    rays = some_rays(4_000)
    found, exact = march(**rays), march_reference(**doubled(rays))
    counts, expected = found.groups.starts.diff(), exact.groups.starts.diff()
    equal = counts == expected
    assert len(found.lengths) > 15_000
    assert (~equal).sum() <= 4  # Measured: none

    def kept(samples: Samples) -> tuple[Tensor, ...]:
        rows = equal[samples.groups.of_row.long()]
        return tuple(x[rows].double() for x in samples[:3])

    # Measured: 4.5e-7; relatively 5.1e-4 of distances s / (1 - s), where 1 - s is rounded.
    *ones, distances = kept(found)
    *others, exact_distances = kept(exact)
    for one, other in zip(ones, others, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-6)
    torch.testing.assert_close(distances, exact_distances, rtol=2e-3, atol=2e-6)
    assert torch.equal(found.groups.of_row, found.groups.of_row.sort().values)


def test_rays_without_samples() -> None:
    rays = some_rays(10) | {"shells": 0}
    rays["origins"] = 10 * rays["directions"]  # away from the box
    for found in (march(**rays), march_reference(**rays)):
        assert found.groups.starts.tolist() == [0] * 11
        assert found.places.shape == (0, 3)


def test_contractions_are_equal() -> None:
    places = 4 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 2
    expected = [contract.py_func(*(np.float32(x) for x in place)) for place in places.tolist()]
    torch.testing.assert_close(contract_reference(places), torch.tensor(np.array(expected)))
