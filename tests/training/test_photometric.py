"""The compiled loss against its definition, the definition against scikit-image."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from chronoscene.errors import ShapeError
from chronoscene.training.photometric import photometric_loss, photometric_loss_reference, ssim_map

# Worst of 600 random images up to 60x60 against float64: value 1e-8, gradient 8e-7.
VALUE_TOLERANCE = 2e-7
GRADIENT_TOLERANCE = 3e-6
"""Relative to the largest gradient of the image, or 1 over the number of values."""
# Worst of 300 flat pairs of different colours: value 5e-5, gradient 4e-4. There the variances are
# differences of equal numbers, wrong by 1e-7, and stand beside C2 = 9e-4.
FLAT_VALUE_TOLERANCE = 2e-4
FLAT_GRADIENT_TOLERANCE = 2e-3


both_codes = pytest.mark.usefixtures("both_codes")


def random_images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A float image and a uint8 target that resembles it. [H, W, 3]"""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, 3, generator=generator)
    noisy = image + 0.2 * torch.randn(height, width, 3, generator=generator)
    return image, (noisy.clamp(0, 1) * 255).to(torch.uint8)


def value_and_gradient(loss, image, target, weight):  # type: ignore[no-untyped-def]
    leaf = image.detach().clone().requires_grad_()
    value = loss(leaf, target, ssim_weight=weight)
    value.backward()
    return value.detach(), leaf.grad


def assert_equals_reference(
    image: torch.Tensor,
    target: torch.Tensor,
    weight: float,
    tolerances: tuple[float, float] = (VALUE_TOLERANCE, GRADIENT_TOLERANCE),
) -> None:
    value, gradient = value_and_gradient(photometric_loss, image, target, weight)
    truth, slope = value_and_gradient(photometric_loss_reference, image.double(), target, weight)
    assert value.dtype == torch.float32
    assert abs(float(value) - float(truth)) <= tolerances[0]
    scale = max(float(slope.abs().max()), 1 / image.numel())
    assert float((gradient - slope).abs().max()) <= tolerances[1] * scale


def test_definition_equals_skimage_away_from_the_border() -> None:
    image, target = random_images(30, 41)
    truth = target.double().numpy() / 255
    inner, full = structural_similarity(
        image.double().numpy(),
        truth,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    ours = ssim_map(image.double(), torch.from_numpy(truth))[5:-5, 5:-5].numpy()
    np.testing.assert_allclose(ours, full[5:-5, 5:-5], atol=1e-12)
    assert ours.mean() == pytest.approx(inner, abs=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_definition_passes_gradcheck(weight: float) -> None:
    image, target = random_images(3, 4)
    image = image.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss_reference(x, target, ssim_weight=weight), (image,)
    )


def random_mask(height: int, width: int) -> torch.Tensor:
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(3)) > 0.3
    mask[height // 3 : height // 2 + 1, : width // 2] = False
    return mask


@both_codes
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_ignored_pixels_are_equal_constants_and_the_loss_is_a_mean_over_the_others(
    weight: float,
) -> None:
    """The sums written out, in float64: differences, and similarities of windows."""
    image, target = random_images(19, 23)
    mask = random_mask(19, 23)
    leaf = image.double().requires_grad_()
    counts = mask[..., None].double()
    a = leaf * counts + image.double() * (1 - counts)
    b = target.double() / 255 * counts + image.double() * (1 - counts)
    l1, dissimilarity = (a - b).abs().sum(), (1 - ssim_map(a, b)).sum()
    expected = ((1 - weight) * l1 + weight * dissimilarity) / (3 * mask.sum())
    expected.backward()
    truth = expected.item()
    for loss in (photometric_loss, photometric_loss_reference):
        ours = image.clone().requires_grad_()
        value = loss(ours, target, ssim_weight=weight, mask=mask)
        value.backward()
        assert value.item() == pytest.approx(truth, abs=2 * VALUE_TOLERANCE)
        assert not ours.grad[~mask].any()
        scale = float(leaf.grad.abs().max())
        assert float((ours.grad - leaf.grad).abs().max()) <= GRADIENT_TOLERANCE * scale


def test_what_is_ignored_makes_no_difference() -> None:
    image, target = random_images(19, 23)
    mask = random_mask(19, 23)
    other = torch.where(mask[..., None], target, 255 - target)
    results = [value_and_gradient(masked(mask), image, t, 0.2) for t in (target, other)]
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])


def test_masks_that_count_everything_or_nothing() -> None:
    image, target = random_images(19, 23)
    everything = torch.ones(19, 23, dtype=torch.bool)
    plain, masks = (
        value_and_gradient(loss, image, target, 0.2)
        for loss in (photometric_loss, masked(everything))
    )
    assert torch.equal(plain[0], masks[0]) and torch.equal(plain[1], masks[1])
    value, gradient = value_and_gradient(masked(~everything), image, target, 0.2)
    assert value.isfinite() and not gradient.any()


def masked(mask):  # type: ignore[no-untyped-def]
    return partial(photometric_loss, mask=mask)


@settings(max_examples=30, deadline=None)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    weight=st.sampled_from([0.0, 0.2, 1.0]),
    seed=st.integers(0, 1000),
    as_float=st.booleans(),
)
def test_equals_definition(
    height: int, width: int, weight: float, seed: int, as_float: bool
) -> None:
    image, target = random_images(height, width, seed)
    assert_equals_reference(image, target.float() / 255 if as_float else target, weight)


@both_codes
@pytest.mark.parametrize("size", [(240, 320), (1, 1), (1, 9), (23, 2), (16, 16)])
def test_sizes(size: tuple[int, int]) -> None:
    assert_equals_reference(*random_images(*size), 0.2)


@both_codes
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (23, 2), (16, 16)])
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_images_are_finite(size: tuple[int, int], level: float) -> None:
    image = torch.full((*size, 3), level)
    for other in (0, 255):
        target = torch.full((*size, 3), other, dtype=torch.uint8)
        value, gradient = value_and_gradient(photometric_loss, image, target, 0.2)
        assert bool(value.isfinite())
        assert bool(gradient.isfinite().all())
        flat = (FLAT_VALUE_TOLERANCE, FLAT_GRADIENT_TOLERANCE)
        assert_equals_reference(image, target, 0.2, flat)


@given(height=st.integers(1, 20), width=st.integers(1, 20))
@settings(max_examples=20, deadline=None)
def test_equal_images_cost_nothing(height: int, width: int) -> None:
    _, target = random_images(height, width)
    value, gradient = value_and_gradient(photometric_loss, target.float() / 255, target, 0.2)
    assert float(value) == pytest.approx(0, abs=1e-6)
    assert float(gradient.abs().max()) < 1e-5


@both_codes
def test_bright_images_stay_finite() -> None:
    """Far above 1 the variances are all rounding."""
    image = 3e3 + torch.rand(20, 20, 3, generator=torch.Generator().manual_seed(0))
    _, target = random_images(20, 20)
    value, gradient = value_and_gradient(photometric_loss, image, target, 0.2)
    assert bool(value.isfinite())
    assert bool(gradient.isfinite().all())


@both_codes
def test_not_a_number_is_not_hidden() -> None:
    image, target = random_images(20, 20)
    image[10, 10, 1] = float("nan")
    assert bool(photometric_loss(image, target).isnan())


def test_same_bits_for_any_thread_count(threads: Callable[[int], None]) -> None:
    image, target = random_images(61, 47)
    results = []
    for number in (1, 2):
        threads(number)
        results.append(value_and_gradient(photometric_loss, image, target, 0.2))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


@both_codes
def test_gradient_scales_with_what_follows() -> None:
    image, target = random_images(12, 13)
    _, once = value_and_gradient(photometric_loss, image, target, 0.2)
    leaf = image.clone().requires_grad_()
    (3 * photometric_loss(leaf, target)).backward()
    torch.testing.assert_close(leaf.grad, 3 * once)


def test_no_gradient_wanted() -> None:
    image, target = random_images(12, 13)
    value = photometric_loss(image, target)
    assert not value.requires_grad
    truth = photometric_loss_reference(image.double(), target)
    assert float(value) == pytest.approx(float(truth), abs=VALUE_TOLERANCE)


@both_codes
def test_strided_and_double_images() -> None:
    image, target = random_images(9, 14)
    turned, turned_target = image.transpose(0, 1), target.transpose(0, 1)
    assert float(photometric_loss(turned, turned_target)) == pytest.approx(
        float(photometric_loss(image, target)), abs=VALUE_TOLERANCE
    )
    assert photometric_loss(image.double(), target).dtype == torch.float64


@pytest.mark.parametrize(
    ("image", "target", "message"),
    [
        (torch.zeros(4, 5, 4), torch.zeros(4, 5, 4), r"image: expected shape \[\*, \*, 3\]"),
        (torch.zeros(4, 5, 3), torch.zeros(5, 4, 3), r"target: expected shape \[4, 5, 3\]"),
        (torch.zeros(0, 5, 3), torch.zeros(0, 5, 3), "at least one pixel"),
        (torch.zeros(4, 5, 3), torch.zeros(4, 5, 3).int(), "a uint8 or float target"),
    ],
)
def test_wrong_images(image: torch.Tensor, target: torch.Tensor, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        photometric_loss(image, target)
