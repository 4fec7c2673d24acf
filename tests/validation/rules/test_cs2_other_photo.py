import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rules.cs2_other_photo import sights

POINTS = "sparse/0/points3D.txt"
A, B = "images/a001.png", "images/a002.png"


@pytest.fixture
def painted(scene):
    """The good scene with points of many colours, and photos that show them."""
    rng = np.random.default_rng(7)
    colours = rng.integers(0, 256, (40, 3))
    for row, colour in enumerate(colours):
        scene.edit_fields(POINTS, row, {4 + i: str(c) for i, c in enumerate(colour)})
    raw = RawScene(scene.root)
    for image, rows in raw.observations.by_image(raw.images):
        pixels = rng.integers(0, 256, (48, 64, 3), np.uint8)
        places = raw.images.keypoint_xy[raw.observations.keypoint[rows]].astype(int)
        for (x, y), point in zip(places, raw.observations.point[rows], strict=True):
            if 0 <= x < 64 and 0 <= y < 48:
                pixels[y, x] = colours[point]
        Image.fromarray(pixels).save(scene.path(f"images/{raw.images.names[image]}"))
    return scene


def turn(scene, place, how):
    path = scene.path(place)
    with Image.open(path) as image:
        image.transpose(how).save(path)


def test_right_photos_are_silent(painted):
    assert {f.code for f in painted.validate(decode=True).findings} == {"CS507"}


def test_photos_of_noise_say_nothing(scene):
    assert {f.code for f in scene.validate(decode=True).findings} == {"CS507"}


def test_photo_turned_after_the_model_was_made(painted):
    turn(painted, A, Image.Transpose.ROTATE_180)
    found = "it fits rotated by 180 degrees"
    painted.expect("CS231", place=A, found=found, decode=True)


def test_photos_that_changed_their_names(painted):
    painted.path(A).rename(painted.path("x.png"))
    painted.path(B).rename(painted.path(A))
    painted.path("x.png").rename(painted.path(B))
    report = painted.expect("CS231", place=A, found="'a002.png' fits", decode=True, times=2)
    assert ("a002.png",) in [f.also for f in report.findings]


def test_another_photo(painted):
    noise = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
    Image.fromarray(noise).save(painted.path(A))
    painted.expect("CS231", place=A, found="correlation", decode=True)


def test_a_period_of_other_photos_is_one_finding(painted):
    for i in range(9):
        turn(painted, f"images/a{i:03d}.png", Image.Transpose.ROTATE_180)
    painted.expect("CS231", place="period 0", found="in 9 of 9 images", decode=True)


def test_all_names_moved_by_one(painted):
    paths = sorted(painted.path("images").iterdir())
    files = [path.read_bytes() for path in paths]
    for path, data in zip(paths, files[1:] + files[:1], strict=True):
        path.write_bytes(data)
    found = " of 18 images: in 'a000.png'; 'b008.png' fits"
    painted.expect("CS231", place="images", found=found, decode=True)


def test_sights_of_few_points_are_left_out(painted):
    keep = [line for i, line in enumerate(painted.lines(POINTS)) if i < 29]
    painted.write(POINTS, keep)
    assert sights(RawScene(painted.root)) == []
