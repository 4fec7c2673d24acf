import unicodedata

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.scene_folder import RawScene

IMAGES, SPLIT = "sparse/0/images.txt", "sparse/split.txt"


def noise(width=64, height=48, seed=99):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def test_image_missing(scene):
    scene.path("images/a000.png").unlink()
    scene.expect("CS201", place="images/a000.png", found="nothing")


def test_every_missing_image_is_named(scene):
    scene.path("images/a000.png").unlink()
    scene.path("images/b006.png").unlink()
    scene.expect("CS201", place="images/a000.png", times=2)
    scene.expect("CS201", place="images/b006.png", times=2)


@pytest.mark.parametrize("file", ["A000.PNG", "sub/a000.png"])
def test_missing_image_with_another_spelling_or_folder(scene, file):
    scene.path("images/sub").mkdir()
    scene.path("images/a000.png").rename(scene.path(f"images/{file}"))
    found = f"nothing; there is '{file}'"
    scene.expect("CS201", place="images/a000.png", found=found)


def test_missing_image_in_the_other_unicode_spelling(scene):
    name = unicodedata.normalize("NFC", "pläne.png")
    other = unicodedata.normalize("NFD", name)
    scene.path("images/a000.png").rename(scene.path(f"images/{other}"))
    for place in (IMAGES, SPLIT):
        scene.replace(place, "a000.png", name)
    scene.expect("CS201", found="nothing; there is")


def test_unregistered_image(scene):
    Image.fromarray(noise()).save(scene.path("images/extra.jpg"))
    scene.write("images/notes.txt", "not an image")
    scene.expect("CS202", place="images/extra.jpg", found="does not have")


@pytest.mark.parametrize(
    ("data", "found"),
    [(b"", "an empty file"), (b"hello", "cannot identify image file it"), (b"\x89PNG\r\n", "")],
)
def test_image_unreadable(scene, data, found):
    scene.write("images/a000.png", data)
    scene.expect("CS203", place="images/a000.png", found=found)


def test_floating_point_image(scene):
    pixels = Image.fromarray(noise()[..., 0].astype(np.float32))
    pixels.save(scene.path("images/a000.png"), "TIFF")
    found = "floating point"
    scene.expect("CS203", place="images/a000.png", found=found, also={"CS215"}, decode=True)


def test_a_pipe_is_not_opened(scene):
    import os

    scene.path("images/a000.png").unlink()
    os.mkfifo(scene.path("images/a000.png"))
    scene.expect("CS201", place="images/a000.png")


@pytest.mark.parametrize(
    ("width", "height", "found"),
    [(64, 40, "64 x 40"), (48, 64, "48 x 64, turned by 90 degrees"), (66, 48, "66 x 48")],
)
def test_image_shape(scene, width, height, found):
    Image.fromarray(noise(width, height)).save(scene.path("images/a000.png"))
    scene.expect("CS204", place="images/a000.png", found=found)


@pytest.mark.parametrize(("width", "height"), [(32, 24), (128, 96), (21, 16)])
def test_image_size(scene, width, height):
    Image.fromarray(noise(width, height)).save(scene.path("images/a000.png"))
    scene.expect("CS205", place="images/a000.png", found=f"{width} x {height}")


def test_damaged_pixels_need_decoding(scene):
    path = scene.path("images/a000.png")
    path.write_bytes(path.read_bytes()[:5000])
    assert "CS206" in {s.code for s in scene.validate().skipped}
    scene.expect("CS206", place="images/a000.png", decode=True)


def test_truncated_jpeg(scene):
    for place in (IMAGES, SPLIT):
        scene.replace(place, "a000.png", "a000.jpg")
    scene.path("images/a000.png").unlink()
    path = scene.path("images/a000.jpg")
    Image.fromarray(noise()).save(path, quality=95)
    path.write_bytes(path.read_bytes()[:2500])
    scene.expect("CS206", place="images/a000.jpg", found="truncated", decode=True)


def test_orientation_tag(scene):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(noise()).save(scene.path("images/a000.png"), exif=exif)
    scene.expect("CS207", place="images/a000.png", found="orientation 6")


def test_shape_as_the_orientation_tag_says(scene):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(noise(48, 64)).save(scene.path("images/a000.png"), exif=exif)
    found = "turned by 90 degrees, as its orientation tag 6 says"
    scene.expect("CS204", place="images/a000.png", found=found)


def test_pixels_are_decoded_only_on_demand(scene):
    assert RawScene(scene.root).pixels is None
    assert len(RawScene(scene.root, decode=True).pixels) == 14
