"""PSNR and SSIM against closed forms and scikit-image; masks act on maps, not on inputs."""

import math

import cv2
import numpy as np
import pytest
from fresh_process import loaded_by
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from chronoscene.errors import ShapeError
from chronoscene.metrics.psnr_ssim import gaussian_window, psnr, ssim, ssim_map, ssim_valid

GOLDEN_VALID = 0.5184174783829354
IMAGES = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=3, max_dims=3, min_side=11, max_side=24))


def pair(seed=0, shape=(37, 53, 3), noise=25):
    rng = np.random.default_rng(seed)
    reference = cv2.GaussianBlur(rng.integers(0, 256, shape, dtype=np.uint8), (5, 5), 1.0).reshape(
        shape
    )
    change = rng.normal(0, noise, shape)
    return np.clip(reference + change, 0, 255).astype(np.uint8), reference


def skimage_ssim(image, reference):
    return structural_similarity(
        image / 255.0,
        reference / 255.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=2,
        data_range=1.0,
    )


def zero_padded_ssim(image, reference):
    """The definition, pixel by pixel: windows over images with five black pixels around them."""
    kernel = np.outer(gaussian_window(), gaussian_window())[..., None]
    a, b = (np.pad(x / 255.0, ((5, 5), (5, 5), (0, 0))) for x in (image, reference))
    values = []
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            p, q = a[y : y + 11, x : x + 11], b[y : y + 11, x : x + 11]
            mp, mq, pp, qq, pq = ((kernel * v).sum((0, 1)) for v in (p, q, p * p, q * q, p * q))
            top = (2 * mp * mq + 1e-4) * (2 * (pq - mp * mq) + 9e-4)
            values.append(top / ((mp**2 + mq**2 + 1e-4) * (pp - mp**2 + qq - mq**2 + 9e-4)))
    return np.mean(values)


def test_psnr_is_that_of_skimage():
    image, reference = pair()
    expected = peak_signal_noise_ratio(reference, image, data_range=255)
    assert psnr(image, reference) == pytest.approx(expected, abs=1e-10)


def test_psnr_closed_form():
    black = np.zeros((4, 5, 3), np.uint8)
    assert psnr(np.full_like(black, 255), black) == 0.0
    assert psnr(np.full((4, 5, 3), 0.1), np.zeros((4, 5, 3))) == pytest.approx(20.0, abs=1e-12)


def test_psnr_of_equal_images_is_infinite():
    image, _ = pair()
    assert psnr(image, image) == math.inf


def test_bytes_and_unit_floats_agree():
    image, reference = pair()
    for metric in (psnr, ssim, ssim_valid):
        assert metric(image / 255.0, reference) == metric(image, reference)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("noise", [2, 25, 80])
def test_ssim_valid_is_that_of_skimage(seed, noise):
    # Worst difference seen over these nine pairs: 6e-16.
    image, reference = pair(seed, noise=noise)
    assert ssim_valid(image, reference) == pytest.approx(skimage_ssim(image, reference), abs=1e-12)


def test_ssim_of_tall_images_has_no_seams():
    """More rows than are computed at a time."""
    image, reference = pair(shape=(150, 20, 3))
    assert ssim_valid(image, reference) == pytest.approx(skimage_ssim(image, reference), abs=1e-12)
    assert ssim(image, reference) == pytest.approx(zero_padded_ssim(image, reference), abs=1e-12)


def test_ssim_golden_value():
    # scikit-image 0.26.0 with the arguments above, on pair(0).
    image, reference = pair()
    assert ssim_valid(image, reference) == pytest.approx(GOLDEN_VALID, abs=1e-9)


def test_ssim_pads_with_zeros():
    image, reference = pair(shape=(14, 13, 3))
    assert ssim(image, reference) == pytest.approx(zero_padded_ssim(image, reference), abs=1e-12)
    assert abs(ssim(image, reference) - ssim_valid(image, reference)) > 1e-4


@given(IMAGES)
@settings(max_examples=20, deadline=None)
def test_ssim_of_equal_images_is_one(image):
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert ssim_valid(image, image) == pytest.approx(1.0, abs=1e-12)


@given(IMAGES, st.randoms(use_true_random=False))
@settings(max_examples=20, deadline=None)
def test_metrics_are_symmetric_and_bounded(image, random):
    other = np.roll(image, random.randint(1, 5), axis=random.randint(0, 1))
    assert psnr(image, other) == psnr(other, image)
    assert ssim(image, other) == pytest.approx(ssim(other, image), abs=1e-12)
    assert -1 <= ssim(image, other) <= 1 + 1e-12


def test_masks_select_from_the_map():
    image, reference = pair()
    mask = np.zeros(image.shape[:2], bool)
    mask[8:20, 10:30] = True
    error = ((image / 255.0 - reference / 255.0) ** 2)[mask].mean()
    assert psnr(image, reference, mask) == pytest.approx(-10 * np.log10(error), abs=1e-12)
    assert ssim(image, reference, mask) == ssim_map(image, reference)[mask].mean()
    # Windows of 11 x 11 pixels that lie in the mask as a whole are centred here.
    inner = ssim_map(image, reference)[13:15, 15:25].mean()
    assert ssim_valid(image, reference, mask) == pytest.approx(inner, abs=1e-12)
    mask[8:11] = False
    with pytest.raises(ShapeError, match="mask: expected at least one pixel"):
        ssim_valid(image, reference, mask)


def test_what_lies_outside_the_mask_does_not_count_for_psnr():
    image, reference = pair()
    mask = np.zeros(image.shape[:2], bool)
    mask[:, :20] = True
    before = psnr(image, reference, mask)
    image[:, 20:] = 0
    assert psnr(image, reference, mask) == before


def test_full_mask_changes_nothing():
    image, reference = pair()
    mask = np.ones(image.shape[:2], bool)
    for metric in (psnr, ssim, ssim_valid):
        assert metric(image, reference, mask) == pytest.approx(metric(image, reference), abs=1e-14)


def test_grey_images_and_single_channels_keep_their_axis():
    image, reference = pair(shape=(20, 21, 1))
    assert ssim(image, reference) == pytest.approx(zero_padded_ssim(image, reference), abs=1e-12)


@pytest.mark.parametrize(
    ("image", "reference", "mask", "message"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), None, r"expected shape \[4, 5, 3\]"),
        (np.zeros((4, 4)), np.zeros((4, 4)), None, r"expected shape \[\*, \*, \*\]"),
        (np.zeros((4, 4, 3), int), np.zeros((4, 4, 3)), None, "expected uint8, or finite floats"),
        (np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)), None, "values that are not finite"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.zeros((4, 4)), "at least one pixel"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((4, 3)), r"expected shape \[4, 4\]"),
        (np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), None, "expected pixels"),
    ],
)
def test_wrong_input_is_named(image, reference, mask, message):
    with pytest.raises(ShapeError, match=message):
        psnr(image, reference, mask)


def test_ssim_valid_refuses_images_smaller_than_its_window():
    small = np.zeros((10, 40, 3), np.uint8)
    with pytest.raises(ShapeError, match="at least 11 x 11 pixels"):
        ssim_valid(small, small)
    assert ssim(small, small) == pytest.approx(1.0, abs=1e-12)


def test_image_metrics_need_no_torch():
    code = (
        "import numpy as np\n"
        "from chronoscene.metrics.psnr_ssim import ssim, psnr\n"
        "from chronoscene.metrics.registry import make_scorers\n"
        "make_scorers(['psnr', 'ssim']); ssim(np.zeros((12, 12, 3)), np.zeros((12, 12, 3)))"
    )
    assert "torch" not in loaded_by(code)
