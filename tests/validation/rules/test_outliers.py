import numpy as np
import pytest

IMAGES, POINTS = "sparse/0/images.txt", "sparse/0/points3D.txt"


def move_keypoints(scene, rows, pixels):
    """Shift the keypoints of some images along x to both sides, and those of all a little."""
    lines = scene.lines(IMAGES)
    for row in range(14):
        words = np.array(lines[2 * row + 1].split(), dtype=object)
        shift = pixels if row in rows else 0.3
        shifts = shift * (-1.0) ** np.arange(len(words) // 3)
        words[0::3] = [f"{float(x) + s:.17g}" for x, s in zip(words[0::3], shifts, strict=True)]
        lines[2 * row + 1] = " ".join(words)
    scene.write(IMAGES, lines)


def test_period_error(scene):
    move_keypoints(scene, range(7, 14), 2.0)
    scene.expect("CS515", place="period 1", found="2 px; worst are 'b0")


def test_small_errors_of_a_period_are_silent(scene):
    move_keypoints(scene, range(7, 14), 0.9)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_image_error(scene):
    move_keypoints(scene, [2], 2.0)
    scene.expect("CS516", place=f"{IMAGES} (a002.png)", found="2 px")


def test_image_beyond_the_limit_is_left_to_the_other_rule(scene):
    move_keypoints(scene, [2], 6.0)
    scene.expect("CS513", place=f"{IMAGES} (a002.png)")


def test_duplicate_points(scene):
    lines = scene.lines(POINTS)
    shared = lines[0].split()[1:4]
    for row in range(1, 4):
        scene.edit_fields(POINTS, row, {1: shared[0], 2: shared[1], 3: shared[2]})
    scene.expect("CS517", place=POINTS, found="3 of 40")


def test_points_that_were_rounded_are_the_same_points(scene):
    """Copies that went through single precision."""
    shared = [f"{np.float32(x):.9g}" for x in scene.lines(POINTS)[0].split()[1:4]]
    for row in range(1, 4):
        scene.edit_fields(POINTS, row, dict(enumerate(shared, start=1)))
    found = [f.found for f in scene.validate().findings if f.code == "CS517"]
    assert found in (["2 of 40 on another one"], ["3 of 40 on another one"])


def test_two_points_in_one_place_are_silent(scene):
    x, y, z = scene.lines(POINTS)[0].split()[1:4]
    scene.edit_fields(POINTS, 1, {1: x, 2: y, 3: z})
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_points_with_one_equal_coordinate_are_silent(scene):
    for row in range(20):
        scene.edit_fields(POINTS, row, {1: "0.25"})
    assert "CS517" not in {f.code for f in scene.validate().findings}


def test_far_points(scene):
    scene.edit_fields(POINTS, 5, {2: "4e4"})
    scene.expect("CS518", place=POINTS, found="1 point up to 4e+04 away (ids 6)")


def test_far_points_of_absurd_size(scene):
    scene.edit_fields(POINTS, 5, {2: "1e300"})
    scene.expect("CS518", place=POINTS, found="(ids 6)")


def test_error_outdated(scene):
    """A camera replaced by that of the data sheet: all periods are worse, none stands out."""
    scene.write("sparse/0/cameras.txt", ["1 PINHOLE 64 48 62.5 62.5 32 24"])
    scene.expect("CS524", place=POINTS, found="px (median)")


@pytest.mark.parametrize("stored", ["0", "-1"])
def test_errors_that_are_not_stored_say_nothing(scene, stored):
    scene.write("sparse/0/cameras.txt", ["1 PINHOLE 64 48 62.5 62.5 32 24"])
    for row in range(40):
        scene.edit_fields(POINTS, row, {7: stored})
    assert {f.code for f in scene.validate().findings} == {"CS507"}
