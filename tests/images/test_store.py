"""Decoding, the resize rule, scaling of cameras, and the cache."""

import io
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.errors import ImageError, SceneError
from chronoscene.formats import read_scene
from chronoscene.images.store import (
    ImageStore,
    evaluation_size,
    image_size,
    load_photo,
    load_rgb,
    resize_camera,
)
from chronoscene.scene import Camera
from chronoscene.scene.cameras import to_pycolmap

CAMERAS = {
    "SIMPLE_PINHOLE": (500, 310, 260),
    "PINHOLE": (500, 480, 310, 260),
    "SIMPLE_RADIAL": (500, 310, 260, 0.05),
    "RADIAL": (500, 310, 260, 0.05, -0.01),
    "OPENCV": (500, 480, 310, 260, 0.05, -0.01, 0.002, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (500, 310, 260, 0.05),
    "RADIAL_FISHEYE": (500, 310, 260, 0.05, -0.01),
    "OPENCV_FISHEYE": (500, 480, 310, 260, 0.05, -0.01, 0.002, 0.001),
    "SIMPLE_DIVISION": (500, 310, 260, -0.05),
    "DIVISION": (500, 480, 310, 260, -0.05),
    "SIMPLE_FISHEYE": (500, 310, 260),
    "FISHEYE": (500, 480, 310, 260),
    "FULL_OPENCV": (500, 480, 310, 260, 0.05, -0.01, 0.002, 0.001, 0.003, 0.0, 0.0, 0.0),
}
RAYS = np.array([[0.1, -0.2, 1.0], [-0.3, 0.25, 1.1], [0.0, 0.0, 2.0]])

sizes = st.integers(1, 20_000)


@given(sizes, sizes, st.integers(1, 4000))
def test_evaluation_size(width, height, limit):
    w, h = evaluation_size(width, height, limit)
    if width <= limit:
        assert (w, h) == (width, height)
    else:
        assert w == limit
        assert h == max(1, height * limit // width)


def test_evaluation_size_does_not_lose_a_pixel_to_rounding():
    """In floating point, width / (width / 1600) is below 1600 for many widths."""
    assert any(int(w / (w / 1600)) == 1599 for w in range(1601, 8000))
    assert all(evaluation_size(w, 1000)[0] == 1600 for w in range(1601, 8000))
    assert evaluation_size(3999, 2999) == (1600, 1199)


@pytest.mark.parametrize("model", CAMERAS)
@given(width=st.integers(1, 3000), height=st.integers(1, 3000))
def test_resized_cameras_see_the_same_rays(model, width, height):
    """pycolmap projects through both cameras, distortion included; pixels scale per axis."""
    camera = Camera(1, model, 640, 480, CAMERAS[model])
    resized = resize_camera(camera, width, height)
    assert (resized.width, resized.height) == (width, height)
    scale = np.array([width / 640, height / 480])
    before = to_pycolmap(camera).img_from_cam(RAYS)
    after = to_pycolmap(resized).img_from_cam(RAYS)
    np.testing.assert_allclose(after, before * scale, rtol=1e-12)
    np.testing.assert_allclose(resized.K, np.diag([*scale, 1]) @ camera.K, rtol=1e-15)


def test_a_camera_keeps_its_model_where_it_can():
    camera = Camera(3, "SIMPLE_RADIAL", 3200, 2400, (3000.0, 1601.0, 1203.0, 0.1))
    expected = Camera(3, "SIMPLE_RADIAL", 1600, 1200, (1500.0, 800.5, 601.5, 0.1))
    assert resize_camera(camera, 1600, 1200) == expected
    assert resize_camera(camera, 3200, 2400) is camera
    assert resize_camera(camera, 1600, 1201).model == "OPENCV"


def test_panoramas_have_no_focal_length():
    with pytest.raises(SceneError, match="render perspective views"):
        resize_camera(Camera(1, "EQUIRECTANGULAR", 640, 320, (640.0, 320.0)), 320, 160)


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


def test_resizing_keeps_the_image_in_place(tmp_path):
    """A linear ramp sampled at pixel centres stays that ramp: no half-pixel shift."""
    ramp = np.broadcast_to(np.arange(200.0) + 0.5, (40, 200))
    path = save(tmp_path, Image.fromarray(ramp.astype(np.uint8)), "a.png")
    small = load_rgb(path, size=(50, 10))[5, 5:-5, 0].astype(float) + 0.5
    np.testing.assert_allclose(small, (np.arange(50) + 0.5)[5:-5] * 4, atol=0.51)


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


@pytest.fixture
def scene(make_scene_folder):
    return read_scene(make_scene_folder({f"{i}.png": i % 2 for i in range(6)}))


IMAGE_BYTES = 64 * 48 * 3


def test_store_gives_the_file(scene):
    store = ImageStore(scene)
    for frame in scene.frames:
        with Image.open(scene.image_path(frame)) as image:
            np.testing.assert_array_equal(store.load(frame), np.array(image))
        assert store.camera(frame) is frame.camera
    assert store.cached_bytes == 6 * IMAGE_BYTES
    assert store.load_mask(scene.frames[0]) is None


def test_masks_are_cached_beside_the_images_at_their_size(scene, tmp_path):
    values = np.full((48, 64), 255, np.uint8)
    values[:24] = 0
    Image.fromarray(values).save(tmp_path / "mask.png")
    name = scene.frames[0].name
    masked = replace(scene, masks={name: tmp_path / "mask.png"})
    store = ImageStore(masked, max_width=32, memory_limit=IMAGE_BYTES // 4 + 32 * 24)
    mask = store.load_mask(masked.frames[0])
    assert mask.shape == (24, 32) and not mask[:14].any() and mask[14:].all()
    assert store.load_mask(masked.frames[0]) is mask
    assert store.cached_bytes == IMAGE_BYTES // 4 + 32 * 24
    assert store.load_mask(masked.frames[1]) is None
    assert store.cached_bytes == IMAGE_BYTES // 4


def test_store_and_camera_agree_on_the_size(scene):
    store = ImageStore(scene, max_width=40)
    for frame in scene.frames:
        camera = store.camera(frame)
        assert store.load(frame).shape == (camera.height, camera.width, 3) == (30, 40, 3)


def test_a_file_of_another_size_is_resized_to_the_camera(scene):
    frame = scene.frames[0]
    big = Image.fromarray(np.full((96, 128, 3), 77, np.uint8))
    big.save(scene.image_path(frame))
    np.testing.assert_array_equal(ImageStore(scene).load(frame), np.full((48, 64, 3), 77))
    assert ImageStore(scene, max_width=32).load(frame).shape == (24, 32, 3)


def test_the_cache_drops_what_was_used_longest_ago(scene):
    store = ImageStore(scene, memory_limit=2 * IMAGE_BYTES)
    a, b, c = scene.frames[:3]
    first = store.load(a)
    second = store.load(b)
    assert store.load(a) is first
    store.load(c)
    assert store.cached_bytes == 2 * IMAGE_BYTES
    assert store.load(a) is first
    assert store.load(b) is not second


def test_a_store_without_cache_still_loads(scene):
    store = ImageStore(scene, memory_limit=0)
    assert store.load(scene.frames[0]).shape == (48, 64, 3)
    assert store.cached_bytes == 0


def test_many_threads(scene):
    truth = {f.name: np.array(Image.open(scene.image_path(f))) for f in scene.frames}
    store = ImageStore(scene, memory_limit=3 * IMAGE_BYTES)
    start = threading.Barrier(8)

    def work(seed: int) -> None:
        start.wait()
        for i in np.random.default_rng(seed).integers(0, 6, 60):
            frame = scene.frames[i]
            np.testing.assert_array_equal(store.load(frame), truth[frame.name])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))
    assert store.cached_bytes == 3 * IMAGE_BYTES


def test_a_damaged_image_of_a_scene_names_its_file(scene):
    scene.image_path(scene.frames[1]).write_bytes(b"not an image")
    with pytest.raises(ImageError, match=r"images/1\.png: expected an image that can be decoded"):
        ImageStore(scene).load(scene.frames[1])
