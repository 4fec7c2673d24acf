"""The resize rule, scaling of cameras, and the cache."""

import os
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
from chronoscene.images.decoding import load_photo, load_rgb
from chronoscene.images.disk_cache import DiskCache
from chronoscene.images.store import AHEAD, ImageStore, evaluation_size, resize_camera
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
    """Also when it was decoded ahead."""
    scene.image_path(scene.frames[1]).write_bytes(b"not an image")
    for ahead in ((), scene.frames[:3]):
        store = ImageStore(scene)
        store.expect(ahead)
        with pytest.raises(ImageError, match=r"images/1\.png: expected an image that can be"):
            store.load(scene.frames[1])


def test_files_that_change_are_refused_where_they_are_fixed(scene, tmp_path):
    """Only when they are read again; a photo in memory is as it was."""
    mask = tmp_path / "mask.png"
    Image.new("L", (64, 48), 255).save(mask)
    first, second, third = scene.frames[:3]
    masked = replace(scene, masks={second.name: mask})
    store, free = (ImageStore(masked, memory_limit=4 * IMAGE_BYTES, fixed=f) for f in (True, False))
    store.load(first)
    for path in (scene.image_path(first), mask, scene.image_path(third)):
        os.utime(path, ns=(0, 10**18))
    store.load(first)
    for frame, name in ((second, "mask.png"), (third, "images/2.png")):
        with pytest.raises(SceneError, match=rf"{name}: expected a file that stays"):
            store.load(frame)
        free.load(frame)


class Decoder:
    """Takes the place of the decoder: notes what it decodes, and waits where it is told to."""

    def __init__(self):
        self.names, self.threads = [], set()
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    def __call__(self, path, *args, **options):
        assert self.may_go_on.wait(60)
        self.names.append(path.name)
        self.threads.add(threading.current_thread().name.split("_")[0])
        return load_photo(path, *args, **options)


@pytest.fixture
def decoder(monkeypatch):
    decoder = Decoder()
    monkeypatch.setattr("chronoscene.images.store.load_photo", decoder)
    return decoder


def finish(store):
    """Wait for what is under way."""
    for future in list(store._coming.values()):
        future.exception(60)


def test_expected_images_are_decoded_in_the_background(scene, decoder):
    store = ImageStore(scene)
    store.expect(scene.frames)
    finish(store)
    assert decoder.names == [f"{i}.png" for i in range(1 + AHEAD)]
    assert decoder.threads == {"decoder"} and store.cached_bytes == (1 + AHEAD) * IMAGE_BYTES
    for frame in scene.frames[: 1 + AHEAD]:
        np.testing.assert_array_equal(store.load(frame), load_rgb(scene.image_path(frame)))
    assert store.waited == 0.0 and len(decoder.names) == 1 + AHEAD
    store.load(scene.frames[5])
    assert store.waited > 0.0


def test_an_image_on_its_way_is_waited_for_and_decoded_once(scene, decoder):
    store = ImageStore(scene)
    decoder.may_go_on.clear()
    store.expect(scene.frames[:1])
    store.expect(scene.frames[:2])
    timer = threading.Timer(0.1, decoder.may_go_on.set)
    timer.start()
    assert store.load(scene.frames[0]).shape == (48, 64, 3)
    finish(store)
    assert decoder.names == ["0.png", "1.png"] and store.waited > 0.0


def test_no_more_is_decoded_ahead_than_fits(scene, decoder):
    store = ImageStore(scene, memory_limit=3 * IMAGE_BYTES, decoders=2)
    store.expect(scene.frames)
    finish(store)
    assert sorted(decoder.names) == ["0.png", "1.png", "2.png"]
    assert ImageStore(scene, memory_limit=0).expect(scene.frames) is None
    assert len(decoder.names) == 3


def test_an_expected_image_stays_until_it_is_used(scene, decoder):
    store = ImageStore(scene, memory_limit=3 * IMAGE_BYTES)
    for frame in scene.frames[:3]:
        store.load(frame)
    for i in range(3):  # as a training does it, whose step loads the first of those it expects
        store.expect(scene.frames[i : i + 4])
        finish(store)
        store.load(scene.frames[i])
    assert decoder.names == [f"{i}.png" for i in range(5)]


def test_masks_and_images_come_from_the_disk_cache(scene, tmp_path, monkeypatch):
    Image.new("L", (64, 48), 0).save(tmp_path / "mask.png")
    masked = replace(scene, masks={scene.frames[0].name: tmp_path / "mask.png"})
    folder = tmp_path / "photos"

    def make():
        return ImageStore(masked, memory_limit=2 * IMAGE_BYTES, disk=DiskCache(folder, 10**6))

    before = make()
    expected = [(before.load(f), before.load_mask(f)) for f in masked.frames]
    monkeypatch.setattr("chronoscene.images.disk_cache.load_photo", None)  # not called again
    store = make()
    for frame, (image, mask) in zip(masked.frames, expected, strict=True):
        store.expect([frame])
        np.testing.assert_array_equal(store.load(frame), image)
        np.testing.assert_array_equal(store.load_mask(frame), mask)
    assert expected[0][1] is not None and expected[1][1] is None
