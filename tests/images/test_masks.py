import numpy as np
import pytest
from PIL import Image

from chronoscene.images.masks import find_masks, resize_mask


@pytest.mark.parametrize("size", [(17, 11), (40, 30), (64, 20), (100, 77), (64, 48)])
def test_what_is_ignored_does_not_reach_pixels_that_count(size):
    rng = np.random.default_rng(5)
    mask = np.ones((48, 64), bool)
    mask[20:31, 13:24] = False
    images = rng.integers(0, 256, (2, 48, 64, 3), np.uint8)
    images[1][mask] = images[0][mask]
    resized = [np.array(Image.fromarray(i).resize(size, Image.Resampling.BICUBIC)) for i in images]
    small = resize_mask(mask, size)
    assert small.shape == size[::-1] and small.flags.c_contiguous
    np.testing.assert_array_equal(resized[0][small], resized[1][small])
    # Not more is given up: two pixels of the coarser of both images at each side.
    scales = np.divide((48, 64), small.shape)
    rows, columns = ((np.arange(n) + 0.5) * s for n, s in zip(small.shape, scales, strict=True))
    reach_y, reach_x = 2 * np.maximum(scales, 1) + 1
    above_or_below = (rows < 20 - reach_y) | (rows > 31 + reach_y)
    beside = (columns < 13 - reach_x) | (columns > 24 + reach_x)
    assert small[above_or_below].all() and small[:, beside].all()


def test_masks_are_found_by_the_full_name_of_the_image(tmp_path):
    for name in ("masks/a/x.jpg.png", "masks/x.png", "masks/y.jpg.png/z"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_masks(tmp_path, ["a/x.jpg", "x.jpg", "y.jpg"])
    assert found == {"a/x.jpg": tmp_path / "masks/a/x.jpg.png"}
    assert find_masks(tmp_path / "masks", ["a/x.jpg"]) == {}
