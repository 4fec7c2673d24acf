"""The compiled loss against its definition, the definition against scikit-image."""

from __future__ import annotations

import pytest
import torch

from chronoscene.training.losses import mean_volume, steady_mean

both_codes = pytest.mark.usefixtures("both_codes")


def test_a_steady_mean_is_the_same_for_any_number_of_threads() -> None:
    values = torch.rand(1_000_003, generator=torch.Generator().manual_seed(0)).requires_grad_()
    means = set()
    for threads in (1, 2, 3, 4):
        torch.set_num_threads(threads)
        means.add(steady_mean(values).item())
    (mean,) = means
    assert mean == pytest.approx(float(values.detach().double().mean()), rel=1e-6)
    (grad,) = torch.autograd.grad(steady_mean(values), values)
    torch.testing.assert_close(grad, torch.full_like(grad, 1 / 1_000_003))


@both_codes
def test_mean_volume_is_the_mean_over_what_is_on() -> None:
    generator = torch.Generator().manual_seed(0)
    scales = torch.rand(10_000, 3, generator=generator).requires_grad_()
    opacities = torch.randn(10_000, generator=generator)
    opacities[::7] = 0  # off, like what is below
    on = opacities > 0
    expected = scales.double().prod(dim=1)[on].mean()
    value = mean_volume(scales, opacities)
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    (reference,) = torch.autograd.grad(expected, scales)
    (grad,) = torch.autograd.grad(2.0 * value, scales)
    torch.testing.assert_close(grad, 2.0 * reference, rtol=1e-5, atol=1e-12)


@both_codes
def test_mean_volume_of_nothing_is_zero() -> None:
    scales = torch.rand(5, 3).requires_grad_()
    value = mean_volume(scales, torch.zeros(5))
    value.backward()
    assert value.item() == 0 and not scales.grad.any()
