import numpy as np
import pytest
from PIL import Image

NAMES = [f"{p}{i:03d}.png" for p in "ab" for i in range(9)]
PERIOD_B = NAMES[9:]


@pytest.fixture
def masked(scene):
    """The good scene with a mask of each image of one period, which is no problem."""
    scene.path("masks").mkdir()
    values = np.full((48, 64), 255, np.uint8)
    values[:20] = 0
    for name in PERIOD_B:
        Image.fromarray(values).save(scene.path(f"masks/{name}.png"))
    return scene


def save(scene, name, image, kind="PNG"):
    image.save(scene.path(f"masks/{name}.png"), kind)


def test_good_masks(masked):
    save(masked, "b000.png", Image.new("1", (64, 48), 1))
    report = masked.validate(decode=True)
    assert {f.code for f in report.findings} <= {"CS507"}


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "I;16"])
def test_masks_of_other_kinds(masked, mode):
    save(masked, "b001.png", Image.new(mode, (64, 48)))
    place, found = "masks/b001.png.png", f"pixels of mode {mode}"
    masked.expect("CS241", place=place, found=found, decode=True)


@pytest.mark.parametrize(("data", "found"), [(b"", "an empty file"), (b"no", "cannot identify")])
def test_masks_that_are_no_images(masked, data, found):
    masked.write("masks/b001.png.png", data)
    masked.expect("CS241", place="masks/b001.png.png", found=found)


def test_a_mask_of_another_size(masked):
    save(masked, "b001.png", Image.new("L", (32, 24), 255))
    report = masked.expect("CS242", place="masks/b001.png.png", found="32 x 24")
    assert any(f.expected == "64 x 48 as images/b001.png" for f in report.findings)


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
