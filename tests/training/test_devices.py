"""What runs where, and random numbers that follow from a seed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from chronoscene.training import devices

GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    ],
)


def test_kernels_are_for_float32_on_a_cpu() -> None:
    single, double = torch.zeros(2), torch.zeros(2, dtype=torch.float64)
    assert devices.has_kernels(single, single)
    assert not devices.has_kernels(single, double)
    assert not devices.has_kernels(torch.zeros(2, device="meta"))


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_an_array_goes_to_its_device(device: str) -> None:
    array = np.arange(6, dtype=np.uint8).reshape(2, 3)
    tensor = devices.to_device(array, device)
    assert tensor.device.type == device and tensor.dtype == torch.uint8
    np.testing.assert_array_equal(tensor.cpu().numpy(), array)


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("draw", [devices.uniform, devices.normal])
def test_random_numbers_follow_from_the_generator(device: str, draw) -> None:  # type: ignore[no-untyped-def]
    like = torch.zeros(1, device=device)
    generators = [np.random.default_rng(seed) for seed in (0, 0, 1)]
    first, second, third = (draw(generator, (4, 1000), like) for generator in generators)
    again = draw(generators[0], (4, 1000), like)
    assert first.device.type == device and torch.equal(first, second)
    assert not torch.equal(first, third) and not torch.equal(first, again)
    mean, spread = (0.5, 12**-0.5) if draw is devices.uniform else (0.0, 1.0)
    assert float(first.mean()) == pytest.approx(mean, abs=0.06)
    assert float(first.std()) == pytest.approx(spread, abs=0.05)


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_whole_random_numbers_follow_from_the_generator(device: str) -> None:
    like = torch.zeros(1, device=device)
    first, again, other = (
        devices.integers(np.random.default_rng(seed), 5, 2_000, like) for seed in (0, 0, 1)
    )
    assert first.device.type == device and torch.equal(first, again)
    assert not torch.equal(first, other)
    # Six standard deviations of the number of draws of one of five.
    assert (first.bincount(minlength=5) - 400).abs().max() < 6 * (2_000 * 0.2 * 0.8) ** 0.5
    assert (first.min(), first.max()) == (0, 4)


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_exponentials(device: str) -> None:
    x = torch.tensor([-200.0, -1.0, 0.0, 1.0, 200.0], device=device)
    expected = x.double().exp().float()
    torch.testing.assert_close(devices.exp(x), expected, rtol=1e-6, atol=0)
