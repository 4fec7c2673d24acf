import io
import unicodedata

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.folder.pixels import TAIL, read_header
from chronoscene.validation.folder.scene_folder import RawScene

IMAGES, SPLIT = "sparse/0/images.txt", "sparse/split.txt"
NAMES = [f"{p}{i:03d}.png" for p in "ab" for i in range(9)]
PERIOD_B = NAMES[9:]


def random_pixels(width=64, height=48, seed=99):
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
    Image.fromarray(random_pixels()).save(scene.path("images/extra.jpg"))
    scene.write("images/notes.txt", "not an image")
    scene.expect("CS202", place="images/extra.jpg", found="not in the model")


@pytest.mark.parametrize(
    ("data", "found"),
    [(b"", "an empty file"), (b"hello", "cannot identify image file"), (b"\x89PNG\r\n", "")],
)
def test_image_unreadable(scene, data, found):
    scene.write("images/a000.png", data)
    scene.expect("CS203", place="images/a000.png", found=found)


def test_floating_point_image(scene):
    pixels = Image.fromarray(random_pixels()[..., 0].astype(np.float32))
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
    [(64, 40, "64 x 40"), (48, 64, "48 x 64, rotated by 90 degrees"), (66, 48, "66 x 48")],
)
def test_image_shape(scene, width, height, found):
    Image.fromarray(random_pixels(width, height)).save(scene.path("images/a000.png"))
    scene.expect("CS204", place="images/a000.png", found=found)


@pytest.mark.parametrize(("width", "height"), [(32, 24), (128, 96), (21, 16)])
def test_image_size(scene, width, height):
    Image.fromarray(random_pixels(width, height)).save(scene.path("images/a000.png"))
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
    Image.fromarray(random_pixels()).save(path, quality=95)
    path.write_bytes(path.read_bytes()[:2500])
    scene.expect("CS206", place="images/a000.jpg", found="truncated", decode=True)


def test_orientation_tag(scene):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(random_pixels()).save(scene.path("images/a000.png"), exif=exif)
    scene.expect("CS207", place="images/a000.png", found="orientation 6")


def test_shape_as_the_orientation_tag_says(scene):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(random_pixels(48, 64)).save(scene.path("images/a000.png"), exif=exif)
    found = "rotated by 90 degrees as its orientation tag 6 says"
    scene.expect("CS204", place="images/a000.png", found=found)


def test_pixels_are_decoded_only_on_demand(scene):
    assert RawScene(scene.root).pixels is None
    assert len(RawScene(scene.root, decode=True).pixels) == 18


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
    assert not read_header(path).truncated
    path.write_bytes(large_jpeg()[:-TAIL])
    assert read_header(path).truncated


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


def test_image_misnamed(scene):
    scene.save("a000.png", noise(), format="JPEG")
    scene.expect("CS215", place="images/a000.png", found="a JPEG file")


def test_image_without_extension_has_no_wrong_one(scene):
    scene.save("a000.png", noise(), as_name="a000", format="JPEG")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_jpeg_filled_with_zeros(scene):
    """What a full disk or a broken transfer leaves behind; it decodes without an error."""
    scene.save("a000.png", noise(), as_name="a000.jpg")
    data = scene.path("images/a000.jpg").read_bytes()
    scene.write("images/a000.jpg", data[:900] + bytes(len(data) - 900))
    scene.expect("CS208", place="images/a000.jpg", found="without its end")
    scene.expect("CS206", place="images/a000.jpg", found="no end of the image", decode=True)


def test_one_transparent_colour(scene):
    image = noise().quantize(32)
    scene.save("a000.png", image, transparency=0)
    scene.expect("CS213", place="images/a000.png", found="pixels of mode P")


@pytest.fixture
def masked(scene):
    """The good scene with a mask of each image of one period, which is no problem."""
    scene.path("masks").mkdir()
    values = np.full((48, 64), 255, np.uint8)
    values[:20] = 0
    for name in PERIOD_B:
        Image.fromarray(values).save(scene.path(f"masks/{name}.png"))
    return scene


def save_mask(scene, name, image, kind="PNG"):
    image.save(scene.path(f"masks/{name}.png"), kind)


def test_good_masks(masked):
    save_mask(masked, "b000.png", Image.new("1", (64, 48), 1))
    report = masked.validate(decode=True)
    assert {f.code for f in report.findings} <= {"CS507"}


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "I;16"])
def test_masks_of_other_kinds(masked, mode):
    save_mask(masked, "b001.png", Image.new(mode, (64, 48)))
    place, found = "masks/b001.png.png", f"pixels of mode {mode}"
    masked.expect("CS241", place=place, found=found, decode=True)


@pytest.mark.parametrize(("data", "found"), [(b"", "an empty file"), (b"no", "cannot identify")])
def test_masks_that_are_no_images(masked, data, found):
    masked.write("masks/b001.png.png", data)
    masked.expect("CS241", place="masks/b001.png.png", found=found)


def test_a_mask_of_another_size(masked):
    save_mask(masked, "b001.png", Image.new("L", (32, 24), 255))
    report = masked.expect("CS242", place="masks/b001.png.png", found="32 x 24")
    assert any(f.expected == "64 x 48 as images/b001.png" for f in report.findings)


def test_masks_in_a_folder_that_is_a_link(scene, tmp_path):
    for place in ("sparse/0/images.txt", "sparse/split.txt"):
        scene.replace(place, "b001.png", "x/b001.png")
    for place in ("images/x", "masks"):
        scene.path(place).mkdir()
    scene.path("images/b001.png").rename(scene.path("images/x/b001.png"))
    (tmp_path / "elsewhere").mkdir()
    scene.path("masks/x").symlink_to(tmp_path / "elsewhere")
    save_mask(scene, "x/b001.png", Image.new("L", (32, 24), 255))
    place = "masks/x/b001.png.png"
    scene.expect("CS242", place=place, found="32 x 24", also=["CS245", "CS703"])


@pytest.mark.parametrize(
    ("file", "hint"),
    [
        ("a000.png", "; the mask of 'a000.png' would be 'a000.png.png'"),
        ("a000.jpg", "; the mask of 'a000.png' would be 'a000.png.png'"),
        ("A000.png.png", "; the mask of 'a000.png' would be 'a000.png.png'"),
        ("lens.png", "no image of this name"),
    ],
)
def test_a_mask_of_no_image(masked, file, hint):
    Image.new("L", (64, 48), 255).save(masked.path(f"masks/{file}"))
    masked.expect("CS243", place=f"masks/{file}", found=hint)


def test_masks_of_images_that_are_not_registered_are_no_problem(masked):
    for place in ("images/extra.png", "masks/extra.png.png"):
        Image.new("L", (64, 48), 255).save(masked.path(place))
    masked.expect("CS202", place="images/extra.png")


def test_masks_of_some_images_of_a_period(masked):
    masked.path("masks/b004.png.png").unlink()
    masked.expect("CS245", place="masks", found="none of 1 image: 'b004.png'")
