import numpy as np
import pytest

from chronoscene.scene.cameras import Camera, project_points
from chronoscene.validation.checks.reprojection import image_errors
from chronoscene.validation.folder.scene_folder import RawScene

CAMERAS, IMAGES = "sparse/0/cameras.txt", "sparse/0/images.txt"


def test_opengl_poses(scene):
    flip = np.diag([1.0, -1.0, -1.0])
    scene.change_poses(lambda r, t: (flip @ r, flip @ t), range(18))
    scene.expect("CS512", place=IMAGES, found="720 of 720 observations behind")


def test_more_than_half_of_the_observations_must_be_behind(scene):
    flip = np.diag([1.0, -1.0, -1.0])
    scene.change_poses(lambda r, t: (flip @ r, flip @ t), range(9))
    assert "CS512" not in {f.code for f in scene.validate().findings}  # 360 of 720
    scene.set_track(0, [(i, 0) for i in range(1, 18)])  # not in the last image, which is right
    found = [f.found for f in scene.validate().findings if f.code == "CS512"]
    assert found == ["360 of 719 observations behind the camera"]


def test_camera_to_world_pose_of_one_image(scene):
    scene.change_poses(lambda r, t: (r.T, -r.T @ t), [4])
    report = scene.validate()
    found = [f for f in report.findings if f.code == "CS513"]
    assert [f.place for f in found] == [f"{IMAGES} (a004.png)"]
    assert found[0].expected == "a median reprojection error below 4 px"


def test_small_errors_are_silent(scene):
    scene.change_poses(lambda r, t: (r, t + np.array([0.1, 0, 0])), [4])
    assert "CS513" not in {f.code for f in scene.validate().findings}


def test_wrong_focal_length(scene):
    scene.write(CAMERAS, ["1 PINHOLE 64 48 150 150 32 24"])
    scene.expect("CS513", place="period 0", found="px in 9 of 9: 'a0", times=2)


LENSES = [
    "1 SIMPLE_RADIAL 64 48 50 32 24 -0.3",
    "1 OPENCV 64 48 50 50 32 24 -0.3 0.05 0.01 -0.02",
    "1 OPENCV_FISHEYE 64 48 50 50 32 24 0.1 0.01 0 0",
]


def through_a_lens(scene, line):
    """Give all images a camera with distortion, and move the keypoints as it does."""
    camera_id, model, width, height, *params = line.split()
    camera = Camera(int(camera_id), model, int(width), int(height), tuple(map(float, params)))
    lines = scene.lines(IMAGES)
    for row in range(1, len(lines), 2):
        words = np.array(lines[row].split(), dtype=object)
        x, y = (words[0::3].astype(float) - 32) / 50, (words[1::3].astype(float) - 24) / 50
        local = np.stack([x, y, np.ones(len(x))], axis=1)
        for start, values in enumerate(project_points(camera, local).T):
            words[start::3] = [f"{v:.17g}" for v in values]
        lines[row] = " ".join(words)
    scene.write(IMAGES, lines)
    scene.write(CAMERAS, [line])
    return {"CS132" if model == "OPENCV_FISHEYE" else "CS133"}


@pytest.mark.parametrize("line", LENSES)
def test_distortion_is_part_of_the_projection(scene, line):
    known = through_a_lens(scene, line)
    assert {f.code for f in scene.validate().findings} == known | {"CS507"}
    assert np.max(image_errors(RawScene(scene.root))) < 1e-6
    scene.write(CAMERAS, ["1 PINHOLE 64 48 50 50 32 24"])  # as if the lens were forgotten
    assert np.min(image_errors(RawScene(scene.root))) > 0.015


@pytest.mark.parametrize("line", LENSES)
def test_wrong_pose_behind_a_lens(scene, line):
    known = through_a_lens(scene, line)
    scene.change_poses(lambda r, t: (r, t + np.array([0.5, 0, 0])), [4])
    scene.expect("CS513", place=f"{IMAGES} (a004.png)", found="px", also=known)


IMAGES, POINTS = "sparse/0/images.txt", "sparse/0/points3D.txt"


def move_keypoints(scene, rows, pixels):
    """Shift the keypoints of some images along x to both sides, and those of all a little."""
    lines = scene.lines(IMAGES)
    for row in range(18):
        words = np.array(lines[2 * row + 1].split(), dtype=object)
        shift = pixels if row in rows else 0.3
        shifts = shift * (-1.0) ** np.arange(len(words) // 3)
        words[0::3] = [f"{float(x) + s:.17g}" for x, s in zip(words[0::3], shifts, strict=True)]
        lines[2 * row + 1] = " ".join(words)
    scene.write(IMAGES, lines)


def test_period_error(scene):
    move_keypoints(scene, range(9, 18), 2.0)
    scene.expect("CS515", place="period 1", found="2 px; the worst are 'b0")


def test_small_errors_of_a_period_are_silent(scene):
    move_keypoints(scene, range(9, 18), 0.9)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_image_error(scene):
    move_keypoints(scene, [2], 2.0)
    scene.expect("CS516", place=f"{IMAGES} (a002.png)", found="2 px")


def test_image_beyond_the_limit_is_left_to_the_other_rule(scene):
    move_keypoints(scene, [2], 6.0)
    scene.expect("CS513", place=f"{IMAGES} (a002.png)")
