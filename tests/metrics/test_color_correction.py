"""Colours are fitted by least squares: exact where the difference is affine, never worse."""

import numpy as np
import pytest

from chronoscene.metrics.color_correction import fit_colors, psnr_cc, ssim_cc
from chronoscene.metrics.psnr_ssim import psnr, ssim


def photo(seed=0, shape=(24, 31, 3)):
    return np.random.default_rng(seed).uniform(0.2, 0.8, shape)


def test_an_affine_difference_of_colours_costs_nothing():
    reference = photo()
    mix = np.array([[0.7, 0.1, 0.0], [0.05, 0.8, 0.1], [0.0, -0.1, 0.9]])
    image = reference @ mix + [0.02, -0.05, 0.03]
    assert psnr(image, reference) < 30
    assert psnr_cc(image, reference) > 200
    assert ssim_cc(image, reference) == pytest.approx(1, abs=1e-12)


def test_a_fit_is_what_the_normal_equations_say():
    """Noise whose best map is known: that of an independent solver."""
    reference, image = photo(0), photo(1)
    columns = np.column_stack([image.reshape(-1, 3), np.ones(24 * 31)])
    solution = np.linalg.solve(columns.T @ columns, columns.T @ reference.reshape(-1, 3))
    expected = (columns @ solution).clip(0, 1).reshape(image.shape)
    np.testing.assert_allclose(fit_colors(image, reference), expected, atol=1e-12)
    assert psnr(image, reference) < psnr_cc(image, reference) == psnr(expected, reference)


def test_unrelated_noise_becomes_the_mean_of_the_photo():
    """An image of one colour can only be shifted: the MSE is the variance of each channel."""
    reference = photo()
    grey = np.full(reference.shape, 0.3)
    expected = -10 * np.log10(reference.var(axis=(0, 1)).mean())
    assert psnr_cc(grey, reference) == pytest.approx(expected, abs=1e-10)


def test_only_pixels_that_count_are_fitted():
    reference = photo()
    mask = np.zeros(reference.shape[:2], bool)
    mask[:, :20] = True
    image = np.where(mask[..., None], 0.5 * reference + 0.1, 0.0)
    assert psnr_cc(image, reference, mask) > 200
    assert ssim_cc(image, reference, mask) == pytest.approx(1, abs=1e-12)
    np.testing.assert_array_equal(fit_colors(image, reference, mask)[~mask], reference[~mask])


def test_bytes_are_taken_too():
    reference = np.round(255 * photo()).astype(np.uint8)
    image = np.round(255 * photo(1)).astype(np.uint8)
    assert psnr_cc(image, reference) == psnr_cc(image / 255.0, reference / 255.0)
    assert ssim(image, reference) != ssim_cc(image, reference)
