"""Positions, sizes and descriptors of features, against known geometry and against COLMAP's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.sift import (
    MEMORY,
    PYRAMID_BYTES,
    photos_at_once,
    root_sift,
    sift_features,
)

WIDTH, HEIGHT = 640, 480


@pytest.fixture(scope="module")
def blobs() -> np.ndarray:
    """Centres in COLMAP's pixels, and radii, of spots at positions between the pixels. [35, 3]"""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(7), np.arange(5))
    centres = 80.0 * np.stack([x + 1, y + 1], axis=-1).reshape(-1, 2)
    return np.column_stack([centres + rng.uniform(-8, 8, (35, 2)), rng.uniform(2, 4, 35)])


@pytest.fixture(scope="module")
def photo(blobs: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    brightness = np.full((HEIGHT, WIDTH), 60.0)
    for cx, cy, radius in blobs:
        brightness += 120 * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / radius**2)
    path = tmp_path_factory.mktemp("photos") / "blobs.png"
    Image.fromarray(np.rint(brightness).astype(np.uint8)).save(path)
    return path


@pytest.fixture(scope="module")
def texture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noise of several scales."""
    rng = np.random.default_rng(2)
    layers = [np.kron(rng.normal(size=(240 // s, 320 // s)), np.ones((s, s))) for s in (1, 4, 16)]
    smooth = [gaussian_filter(v, 1.2 * s) * s for v, s in zip(layers, (1, 4, 16), strict=True)]
    brightness = np.sum(smooth, axis=0)
    scaled = 255 * (brightness - brightness.min()) / np.ptp(brightness)
    path = tmp_path_factory.mktemp("photos") / "texture.png"
    Image.fromarray(np.rint(scaled).astype(np.uint8)).save(path)
    return path


@pytest.mark.parametrize("max_image_size", [1600, 320])
def test_positions_are_those_of_the_photo_from_the_corner_of_its_first_pixel(
    max_image_size: int, photo: Path, blobs: np.ndarray
) -> None:
    keypoints, _ = sift_features(photo, max_image_size=max_image_size, max_features=4096)
    apart = np.linalg.norm(keypoints[None, :, :2] - blobs[:, None, :2], axis=2)
    nearest = apart.argmin(axis=1)
    found = apart.min(axis=1) < 1.0  # a few fall between two scales, where OpenCV drops them
    assert found.sum() >= 30
    assert apart.min(axis=1)[found].max() < 0.1
    error = keypoints[nearest[found], :2] - blobs[found, :2]
    assert np.abs(error.mean(axis=0)).max() < 0.02
    scales = np.hypot(keypoints[nearest[found], 2], keypoints[nearest[found], 4])
    np.testing.assert_allclose(scales, 0.88 * blobs[found, 2], rtol=0.05)


def test_features_are_as_those_of_colmap(texture: Path, tmp_path: Path) -> None:
    """The same places have the same scale, orientation and descriptor, up to discretisation."""
    database = tmp_path / "features.db"
    pycolmap.Database.open(database).close()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    pycolmap.extract_features(database, texture.parent, [texture.name], extraction_options=options)
    with pycolmap.Database.open(database) as opened:
        theirs = np.asarray(opened.read_keypoints(1))
        their_descriptors = np.asarray(opened.read_descriptors(1).data).astype(float)
    ours, descriptors = sift_features(texture, max_image_size=1600, max_features=4096)
    assert ours.shape[1] == theirs.shape[1]
    assert len(ours) > 2 * len(theirs)  # fainter ones too
    apart = np.linalg.norm((ours[:, None] - theirs[None])[..., [0, 1, 2, 4]], axis=2)
    found = apart.argmin(axis=1)
    same = apart[np.arange(len(ours)), found] < 0.5
    assert same.sum() > 50
    differences = np.median(np.abs(ours[same] - theirs[found[same]]), axis=0)
    assert differences[:2].max() < 0.01
    assert differences[2:].max() < 0.2
    distances = np.linalg.norm(descriptors[same] - their_descriptors[found[same]], axis=1)
    assert np.median(distances) < 0.15 * 512  # up to 0.7, descriptors match


def test_descriptors_are_roots_of_shares(texture: Path) -> None:
    descriptors = sift_features(texture, max_image_size=1600, max_features=4096)[1]
    lengths = np.linalg.norm(descriptors.astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 4  # bytes are rounded
    histogram = np.zeros((2, 128), np.float32)
    histogram[0, :4] = 1, 4, 9, 50
    found = root_sift(histogram)
    np.testing.assert_array_equal(found[0, :4], [64, 128, 192, 255])  # the last is at its limit
    assert not found[1].any()
    np.testing.assert_array_equal(root_sift(7 * histogram), found)


def test_strong_features_come_first_and_of_each_kind_the_largest(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grain = np.kron(rng.normal(size=(60, 80)), np.ones((4, 4)))
    grain[:, 160:] *= 0.1  # the right half is faint
    Image.fromarray((128 + 30 * grain).clip(0, 255).astype(np.uint8)).save(tmp_path / "half.png")
    keypoints, _ = sift_features(tmp_path / "half.png", max_image_size=1600, max_features=4096)
    sizes = np.hypot(keypoints[:, 2], keypoints[:, 4])
    (end,) = np.flatnonzero(np.diff(sizes) > 1e-4) + 1
    assert (keypoints[:end, 0] < 170).mean() > 0.8
    assert (keypoints[end:, 0] > 150).mean() > 0.5


def test_the_first_are_kept(texture: Path) -> None:
    every, descriptors = sift_features(texture, max_image_size=1600, max_features=4096)
    few, fewer_descriptors = sift_features(texture, max_image_size=1600, max_features=50)
    assert len(every) > len(few) == 50
    np.testing.assert_array_equal(few, every[:50])
    # Without small ones, OpenCV does not enlarge the photo, so the last bits may differ.
    apart = np.linalg.norm(fewer_descriptors.astype(float) - descriptors[:50], axis=1)
    assert apart.max() < 0.05 * 512


@pytest.mark.parametrize("max_image_size", [1600, 160])
def test_there_are_no_features_where_the_mask_is_0(
    texture: Path, tmp_path: Path, max_image_size: int
) -> None:
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :100] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    whole = sift_features(texture, max_image_size=max_image_size, max_features=4096)[0]
    kept = sift_features(
        texture, tmp_path / "mask.png", max_image_size=max_image_size, max_features=4096
    )[0]
    assert kept[:, 0].min() > 99 > np.quantile(whole[:, 0], 0.2)
    assert len(kept) > 0.6 * (whole[:, 0] > 102).sum()


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_a_photo_without_texture_has_no_features(mode: str, tmp_path: Path) -> None:
    Image.new(mode, (200, 100), "grey").save(tmp_path / "grey.jpg")
    keypoints, descriptors = sift_features(
        tmp_path / "grey.jpg", max_image_size=1600, max_features=4096
    )
    assert (keypoints.shape, keypoints.dtype) == ((0, 6), np.float32)
    assert (descriptors.shape, descriptors.dtype) == ((0, 128), np.uint8)


def test_orientation_tags_are_not_applied(texture: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(texture) as image:
        image.save(tmp_path / "turned.png", exif=exif)
    turned = sift_features(tmp_path / "turned.png", max_image_size=1600, max_features=4096)[0]
    np.testing.assert_array_equal(
        turned, sift_features(texture, max_image_size=1600, max_features=4096)[0]
    )


def test_large_photos_are_fewer_at_a_time() -> None:
    assert photos_at_once(1600, 4) == 4
    assert 1 < photos_at_once(4000, 64) <= MEMORY // (PYRAMID_BYTES * 4000**2)
    assert photos_at_once(100_000, 64) == 1
