import numpy as np
import pytest

from chronoscene.scene.geometry import rotation_from_quaternion

IMAGES = "sparse/0/images.txt"
FLIP = np.diag([1.0, -1.0, -1.0])


def centre(rotation, translation):
    return -rotation.T @ translation


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda r, t: (r.T, centre(r, t)), "poses that fit as camera-to-world poses"),
        (lambda r, t: (r, centre(r, t)), "camera centres in place of the translations"),
        (
            lambda r, t: (r.T @ FLIP, centre(r, t)),
            "camera-to-world poses and axes of OpenGL (y up, z backwards)",
        ),
    ],
)
def test_poses_in_another_convention(scene, change, found):
    scene.change_poses(change, range(14))
    also = {f.code for f in scene.validate().findings} & {"CS512", "CS521"}
    scene.expect("CS125", place=IMAGES, found=found, also=also)


def test_quaternions_with_the_real_part_last(scene):
    for row in range(0, 28, 2):
        w, x, y, z = scene.lines(IMAGES)[row].split()[1:5]
        scene.edit_fields(IMAGES, row, {1: x, 2: y, 3: z, 4: w})
    also = {f.code for f in scene.validate().findings} & {"CS512", "CS521"}
    found = "poses that fit as quaternions in the order x, y, z, w"
    scene.expect("CS125", place=IMAGES, found=found, also=also)


def test_poses_that_are_just_wrong_have_no_convention(scene):
    rng = np.random.default_rng(0)

    def change(rotation, translation):
        turn = rotation_from_quaternion(rng.normal(size=4))
        return turn @ rotation, translation + rng.normal(size=3)

    scene.change_poses(change, range(14))
    assert "CS125" not in {f.code for f in scene.validate().findings}


def test_one_image_is_no_convention(scene):
    scene.change_poses(lambda r, t: (r.T, centre(r, t)), [3])
    scene.expect("CS513", place="(a003.png)")
