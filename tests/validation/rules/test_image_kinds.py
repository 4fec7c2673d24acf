import io

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.checks.pixels import TAIL, read_header


def noise(mode="RGB", size=(64, 48), seed=99):
    channels = len(Image.new(mode, (1, 1)).getbands())
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels), np.uint8)
    return Image.fromarray(pixels[..., 0] if channels == 1 else pixels, mode)


def large_jpeg():
    """More bytes than the end that is searched for the mark."""
    noise(size=(640, 480)).save(file := io.BytesIO(), "JPEG", quality=90)
    assert len(file.getvalue()) > 10 * TAIL
    return file.getvalue()


@pytest.mark.parametrize("name", ["a000.png", "a000.jpg"])
def test_image_cut_off(scene, name):
    scene.save("a000.png", noise(), as_name=None if name == "a000.png" else name)
    path = scene.path(f"images/{name}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    scene.expect("CS208", place=f"images/{name}", found="without its end")
    scene.expect("CS206", place=f"images/{name}", decode=True)


def test_bytes_after_the_end_are_not_a_missing_end(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(large_jpeg() + bytes(2 * TAIL))
    assert not read_header(path).cut_off
    path.write_bytes(large_jpeg()[:-TAIL])
    assert read_header(path).cut_off


@pytest.mark.parametrize("mode", ["I;16", "RGB16"])
def test_image_deep(scene, mode):
    if mode == "RGB16":
        import cv2

        scene.path("images/a000.png").unlink()
        pixels = np.random.default_rng(1).integers(0, 2**16, (48, 64, 3), np.uint16)
        cv2.imwrite(str(scene.path("images/a000.png")), pixels)
        scene.expect("CS211", place="images/a000.png", found="more (PNG)")
    else:
        pixels = np.random.default_rng(1).integers(0, 2**16, (48, 64), np.uint16)
        scene.save("a000.png", Image.fromarray(pixels))
        scene.expect("CS211", place="images/a000.png", found="more (PNG)", also={"CS704"})


def test_image_cmyk(scene):
    scene.save("a000.png", noise("CMYK"), as_name="a000.jpg")
    scene.expect("CS212", place="images/a000.jpg", found="CMYK")


def test_image_transparent(scene):
    scene.save("a000.png", noise("RGBA"))
    scene.expect("CS213", place="images/a000.png", found="RGBA")


@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_image_animated(scene, suffix):
    frames = {"save_all": True, "append_images": [noise(seed=5)]}
    scene.save("a000.png", noise(), as_name=f"a000{suffix}", **frames)
    scene.expect("CS214", place=f"images/a000{suffix}", found="several")


def test_image_misnamed(scene):
    scene.save("a000.png", noise(), format="JPEG")
    scene.expect("CS215", place="images/a000.png", found="a JPEG file")


def test_image_without_extension_has_no_wrong_one(scene):
    scene.save("a000.png", noise(), as_name="a000", format="JPEG")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_image_blank(scene):
    scene.save("a000.png", Image.new("RGB", (64, 48), (0, 128, 255)))
    scene.expect("CS216", place="images/a000.png", found="one colour, #0080ff", decode=True)


def test_dark_image_that_shows_something_is_not_blank(scene):
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[20:, 30:] = 4
    scene.save("a000.png", Image.fromarray(pixels))
    assert "CS216" not in {f.code for f in scene.validate(decode=True).findings}


def test_jpeg_filled_with_zeros(scene):
    """What a full disk or a broken transfer leaves behind; it decodes without an error."""
    scene.save("a000.png", noise(), as_name="a000.jpg")
    data = scene.path("images/a000.jpg").read_bytes()
    scene.write("images/a000.jpg", data[:900] + bytes(len(data) - 900))
    scene.expect("CS208", place="images/a000.jpg", found="without its end")
    scene.expect("CS206", place="images/a000.jpg", found="no end of the image", decode=True)


def test_tiff_cut_off(scene):
    scene.save("a000.png", noise(), as_name="a000.tif")
    data = scene.path("images/a000.tif").read_bytes()
    scene.write("images/a000.tif", data[:-100])
    scene.expect("CS208", place="images/a000.tif", found="without its end")


def test_one_transparent_colour(scene):
    image = noise().quantize(32)
    scene.save("a000.png", image, transparency=0)
    scene.expect("CS213", place="images/a000.png", found="pixels of kind P")


@pytest.mark.parametrize(
    ("size", "kind", "codes"),
    [
        ((64, 48), 0, {"CS214", "CS507"}),
        ((64, 48), 4, {"CS507"}),
        ((16, 12), 1, {"CS507"}),
    ],
)
def test_pages_of_a_tiff(scene, size, kind, codes):
    """A second page is a second image, unless it is a mask or a preview."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    page, tags = noise(size=size, seed=5), ImageFileDirectory_v2()
    tags[254] = kind
    page.encoderinfo = {"tiffinfo": tags}
    scene.save("a000.png", noise(), as_name="a000.tif", save_all=True, append_images=[page])
    assert {f.code for f in scene.validate(decode=True).findings} == codes
