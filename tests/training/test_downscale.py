"""Coarser views and photos show the same thing."""

from __future__ import annotations

import numpy as np
import pytest

from chronoscene.methods import TrainingView
from chronoscene.training.downscale import coarser_image, coarser_view


def view(width: int, height: int) -> TrainingView:
    K = np.array([[50.0, 0.0, 0.5 * width], [0.0, 60.0, 0.4 * height], [0.0, 0.0, 1.0]])
    return TrainingView(K, width, height, np.eye(4), "a.jpg", 0)


@pytest.mark.parametrize(("size", "factor"), [((8, 6), 2), ((9, 7), 2), ((10, 10), 4), ((3, 1), 2)])
def test_sizes_agree(size: tuple[int, int], factor: int) -> None:
    small = coarser_view(view(*size), factor)
    image = coarser_image(np.zeros((size[1], size[0], 3), np.uint8), factor)
    assert image.shape == (small.height, small.width, 3)


def test_a_pixel_is_the_rounded_mean_of_its_square() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (7, 9, 3)).astype(np.uint8)
    small = coarser_image(image, 2)
    mean = image[4:6, 2:4].astype(float).mean(axis=(0, 1))
    np.testing.assert_allclose(small[2, 1], mean, atol=0.5)


def test_a_point_lands_at_the_same_place() -> None:
    """The centre of a square of pixels is the centre of the pixel that stands for it."""
    original = view(8, 6)
    small = coarser_view(original, 2)
    point = np.linalg.inv(original.K) @ [5.0, 3.0, 1.0]  # corner of pixels (4, 2) and (5, 3)
    np.testing.assert_allclose(small.K @ point, [2.5, 1.5, 1.0])
    np.testing.assert_array_equal(original.K[0], [50.0, 0.0, 4.0])
