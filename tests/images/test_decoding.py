"""Decoding: which colours a file has, which of its pixels count, what is refused."""

import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.errors import ImageError
from chronoscene.images.decoding import image_size, load_photo, load_rgb
from chronoscene.validation.folder.pixels import read_header


def save(tmp_path, image: Image.Image, name: str, **options):
    path = tmp_path / name
    image.save(path, **options)
    return path


RGB = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [90, 80, 70]]], np.uint8)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.webp"])
def test_lossless_formats(tmp_path, name):
    options = {"lossless": True} if name.endswith("webp") else {}
    path = save(tmp_path, Image.fromarray(RGB), name, **options)
    image = load_rgb(path)
    np.testing.assert_array_equal(image, RGB)
    assert image.dtype == np.uint8 and image.flags.c_contiguous and image.flags.writeable
    assert image_size(path) == (2, 2)


def test_transparent_pixels_keep_their_colour_and_do_not_count_below_one_half(tmp_path):
    rgba = np.dstack([RGB, np.array([[255, 0], [128, 127]], np.uint8)])
    image, mask = load_photo(save(tmp_path, Image.fromarray(rgba), "a.png"))
    np.testing.assert_array_equal(image, RGB)
    np.testing.assert_array_equal(mask, [[True, False], [True, False]])


def test_transparent_palette_and_grey_with_alpha(tmp_path):
    palette = Image.fromarray(np.array([[0, 1]], np.uint8), mode="P")
    palette.putpalette([10, 20, 30, 40, 50, 60])
    image, mask = load_photo(save(tmp_path, palette, "p.png", transparency=1))
    np.testing.assert_array_equal(image, [[[10, 20, 30], [40, 50, 60]]])
    np.testing.assert_array_equal(mask, [[True, False]])
    grey = Image.merge("LA", [Image.new("L", (1, 1), 200), Image.new("L", (1, 1), 0)])
    image, mask = load_photo(save(tmp_path, grey, "la.png"))
    assert image.tolist() == [[[200, 200, 200]]] and mask.tolist() == [[False]]


def test_one_transparent_value_of_16_bits(tmp_path):
    values = np.array([[5000, 5001, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    content = b"tRNS" + struct.pack(">H", 5000)
    chunk = struct.pack(">I", 2) + content + struct.pack(">I", zlib.crc32(content))
    at = data.index(b"IDAT") - 4
    (tmp_path / "a.png").write_bytes(data[:at] + chunk + data[at:])
    np.testing.assert_array_equal(load_photo(tmp_path / "a.png")[1], [[False, True, True]])


def test_a_mask_file_and_alpha_both_have_to_allow_a_pixel(tmp_path):
    alpha = np.array([[255, 0], [255, 255]], np.uint8)
    path = save(tmp_path, Image.fromarray(np.dstack([RGB, alpha])), "a.png")
    values = Image.fromarray(np.array([[0, 255], [1, 255]], np.uint8))
    _, mask = load_photo(path, save(tmp_path, values, "mask.png"))
    np.testing.assert_array_equal(mask, [[False, False], [True, True]])
    _, mask = load_photo(path, save(tmp_path, values.convert("1", dither=0), "bits.png"))
    np.testing.assert_array_equal(mask, [[False, False], [False, True]])


def test_opaque_images_and_masks_that_allow_everything_are_no_masks(tmp_path):
    rgba = np.dstack([RGB, np.full((2, 2), 255, np.uint8)])
    path = save(tmp_path, Image.fromarray(rgba), "a.png")
    assert load_photo(path, save(tmp_path, Image.new("L", (2, 2), 9), "mask.png"))[1] is None


@pytest.mark.parametrize(
    ("mode", "size", "found"),
    [("L", (2, 3), "2 x 3 pixels of mode L"), ("RGB", (2, 2), "mode RGB")],
)
def test_masks_of_another_kind_or_size_are_refused(tmp_path, mode, size, found):
    path = save(tmp_path, Image.fromarray(RGB), "a.png")
    with pytest.raises(ImageError, match=rf"mask\.png: expected a mask of 2 x 2.*{found}"):
        load_photo(path, save(tmp_path, Image.new(mode, size), "mask.png"))


def test_grey_8_and_16_bit(tmp_path):
    path = save(tmp_path, Image.fromarray(np.array([[0, 7, 255]], np.uint8)), "8.png")
    np.testing.assert_array_equal(load_rgb(path)[0, :, 2], [0, 7, 255])
    values = np.array([[0, 128, 129, 257, 32896, 65535]], np.uint16)
    for name in ("16.png", "16.tif"):
        image = load_rgb(save(tmp_path, Image.fromarray(values), name))
        np.testing.assert_array_equal(image[0, :, 0], [0, 0, 1, 1, 128, 255])
        np.testing.assert_array_equal(image[..., 0], image[..., 2])


def test_16_bit_colour(tmp_path):
    import cv2

    values = np.array([[[65535, 0, 257 * 90]]], np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), values[..., ::-1])
    np.testing.assert_array_equal(load_rgb(tmp_path / "a.png"), [[[255, 0, 90]]])


def test_cmyk(tmp_path):
    image = Image.new("CMYK", (8, 8), (0, 255, 255, 0))
    pixels = load_rgb(save(tmp_path, image, "a.jpg", quality=95)).astype(int)
    np.testing.assert_allclose(pixels, np.broadcast_to([255, 0, 0], (8, 8, 3)), atol=3)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg"])
def test_orientation_tags_are_not_applied(tmp_path, name, orientation):
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:8, :8] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = save(tmp_path, Image.fromarray(pixels), name, exif=exif)
    assert image_size(path) == (32, 16)
    np.testing.assert_allclose(load_rgb(path).astype(int), pixels, atol=12)


def test_shrinking_smooths(tmp_path):
    """A one-pixel checkerboard becomes grey; without a smoothing filter it would stay black."""
    board = np.indices((64, 64)).sum(axis=0) % 2 * 255
    path = save(tmp_path, Image.fromarray(board.astype(np.uint8)), "a.png")
    small = load_rgb(path, size=(16, 16)).astype(int)
    assert np.abs(small[2:-2, 2:-2] - 127.5).max() < 3


def test_photos_are_resized_by_the_bicubic_filter(tmp_path):
    """Keys' kernel with a = -1/2, as wide as two of the larger pixels to each side."""
    line = np.random.default_rng(0).integers(64, 192, 32)
    path = save(tmp_path, Image.fromarray(np.tile(line.astype(np.uint8), (8, 1))), "a.png")
    distance = np.abs((np.arange(32) + 0.5) / 2 - (np.arange(16)[:, None] + 0.5))
    near = 1.5 * distance**3 - 2.5 * distance**2 + 1
    far = -0.5 * distance**3 + 2.5 * distance**2 - 4 * distance + 2
    weights = np.where(distance < 1, near, np.where(distance < 2, far, 0.0))
    expected = weights @ line / weights.sum(axis=1)
    np.testing.assert_allclose(load_rgb(path, size=(16, 8))[0, :, 0], expected, atol=1.0)


def test_resizing_keeps_the_image_in_place(tmp_path):
    """A linear ramp sampled at pixel centres stays that ramp: no half-pixel shift."""
    ramp = np.broadcast_to(np.arange(200.0) + 0.5, (40, 200))
    path = save(tmp_path, Image.fromarray(ramp.astype(np.uint8)), "a.png")
    small = load_rgb(path, size=(50, 10))[5, 5:-5, 0].astype(float) + 0.5
    np.testing.assert_allclose(small, (np.arange(50) + 0.5)[5:-5] * 4, atol=0.51)


@pytest.mark.filterwarnings("ignore:::PIL")
def test_a_tiff_file_with_rows_that_no_strip_has_is_damaged(tmp_path):
    path = save(tmp_path, Image.effect_noise((40, 30), 50).convert("RGB"), "a.tif")
    data = bytearray(path.read_bytes())
    (directory,) = struct.unpack_from("<I", data, 4)
    entries = range(directory + 2, len(data) - 12, 12)
    rows = next(at for at in entries if struct.unpack_from("<H", data, at) == (257,))
    struct.pack_into("<HII", data, rows + 2, 4, 1, 2**22 + 30)  # which would be 500 MB
    path.write_bytes(data)
    with pytest.raises(ImageError, match="found no data for all of its 40 x 4194334 pixels"):
        load_rgb(path)
    assert read_header(path).truncated


@pytest.mark.filterwarnings("ignore:::PIL")
@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.webp", "a.bmp"])
def test_damaged_files_are_our_error(tmp_path, name):
    pixels = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    path = save(tmp_path, Image.fromarray(pixels), name)
    whole = path.read_bytes()
    for length in (0, 1, 10, len(whole) // 4, len(whole) // 2, len(whole) * 3 // 4):
        path.write_bytes(whole[:length])
        with pytest.raises(ImageError, match=name.replace(".", r"\.")):
            load_rgb(path)


@pytest.mark.filterwarnings("ignore:::PIL")
@given(st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "GIF"]), st.randoms(use_true_random=False))
def test_no_other_error_escapes_from_damaged_bytes(tmp_path_factory, kind, random):
    buffer = io.BytesIO()
    Image.fromarray(np.full((9, 7, 3), 99, np.uint8)).save(buffer, kind)
    data = bytearray(buffer.getvalue())
    for _ in range(random.randint(1, 6)):
        data[random.randrange(len(data))] = random.randrange(256)
    path = tmp_path_factory.mktemp("bytes") / "x"
    path.write_bytes(data)
    try:
        assert load_rgb(path, size=(4, 4)).shape == (4, 4, 3)
        image_size(path)
    except ImageError:
        pass


def test_missing_and_floating_point_files(tmp_path):
    with pytest.raises(ImageError, match=r"x\.png: expected an image, found nothing"):
        load_rgb(tmp_path / "x.png")
    with pytest.raises(ImageError, match="found nothing"):
        image_size(tmp_path / "x.png")
    path = save(tmp_path, Image.fromarray(np.ones((2, 2), np.float32)), "f.tif")
    with pytest.raises(ImageError, match="floating point"):
        load_rgb(path)
