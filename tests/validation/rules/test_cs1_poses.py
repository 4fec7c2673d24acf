import numpy as np
import pytest

from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.folder.scene_folder import RawScene

IMAGES = "sparse/0/images.txt"


@pytest.mark.parametrize("fields", [{5: "nan"}, {1: "inf"}, {1: "0", 2: "0", 3: "0", 4: "0"}])
def test_pose_not_finite(scene, fields):
    scene.edit_fields(IMAGES, 2, fields)
    scene.expect("CS121", place="images.txt (a001.png)", found=next(iter(fields.values())))


def test_quaternion_not_unit(scene):
    words = scene.lines(IMAGES)[2].split()
    doubled = {i: str(2 * float(words[i])) for i in range(1, 5)}
    scene.edit_fields(IMAGES, 2, doubled)
    scene.expect("CS122", place="images.txt (a001.png)", found="length 2")


@pytest.mark.parametrize("digits", [4, 5])
def test_quaternions_of_few_digits_are_silent(scene, digits):
    lines = scene.lines(IMAGES)
    for row in range(0, len(lines), 2):
        words = lines[row].split()
        lines[row] = " ".join(
            [words[0], *(f"{float(w):.{digits}f}" for w in words[1:5]), *words[5:]]
        )
    scene.write(IMAGES, lines)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_far_from_origin(scene):
    shift = np.array([442_000.0, 4_427_000.0, 50.0])
    lines = scene.lines(IMAGES)
    for i in range(0, len(lines), 2):
        words = lines[i].split()
        rotation = rotation_from_quaternion([float(w) for w in words[1:5]])
        moved = np.array([float(w) for w in words[5:8]]) - rotation @ shift
        lines[i] = " ".join([*words[:5], *(f"{x:.17g}" for x in moved), *words[8:]])
    scene.write(IMAGES, lines)
    points = [line.split() for line in scene.lines("sparse/0/points3D.txt")]
    for words in points:
        words[1:4] = [f"{float(w) + s:.17g}" for w, s in zip(words[1:4], shift, strict=True)]
    scene.write("sparse/0/points3D.txt", [" ".join(words) for words in points])
    scene.expect("CS123", place="images.txt", found="cameras 4.45e+06 away")


def test_far_camera(scene):
    scene.change_poses(lambda r, t: (r, t + np.array([0, 0, 500.0])), [3])
    report = scene.validate()
    (finding,) = [f for f in report.findings if f.code == "CS124"]
    assert finding.place == f"{IMAGES} (a003.png)"
    assert finding.found == "a camera 504 away"


def test_camera_a_little_aside_is_silent(scene):
    scene.change_poses(lambda r, t: (r, t + np.array([0, 0, 50.0])), [3])
    assert "CS124" not in {f.code for f in scene.validate().findings}


@pytest.mark.parametrize(("times", "far"), [(19.9, False), (20.1, True)])
def test_far_is_twenty_times_the_usual_distance(scene, times, far):
    scene.change_poses(lambda r, t: (r, t + np.array([0, 0, 500.0])), [3])
    model = RawScene(scene.root)  # medians do not depend on how far
    middle = np.median(model.centres, axis=0)
    usual = np.percentile(np.linalg.norm(model.centres - middle, axis=1), 90)
    usual = max(usual, np.median(np.linalg.norm(model.points.xyz - middle, axis=1)))
    away = model.centres[3] - middle
    place = middle + times * usual * away / np.linalg.norm(away)
    scene.change_poses(lambda r, t: (r, -r @ place), [3])
    assert ("CS124" in {f.code for f in scene.validate().findings}) == far


def test_cameras_in_one_place_are_silent(scene):
    """A panorama: its size is that of the points."""
    scene.change_poses(lambda r, t: (r, 1e-6 * t), range(17))
    assert "CS124" not in {f.code for f in scene.validate().findings}


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
            "camera-to-world poses and OpenGL axes (y up, z backwards)",
        ),
    ],
)
def test_poses_in_another_convention(scene, change, found):
    scene.change_poses(change, range(18))
    also = {f.code for f in scene.validate().findings} & {"CS512"}
    scene.expect("CS125", place=IMAGES, found=found, also=also)


def test_quaternions_with_the_real_part_last(scene):
    for row in range(0, 36, 2):
        w, x, y, z = scene.lines(IMAGES)[row].split()[1:5]
        scene.edit_fields(IMAGES, row, {1: x, 2: y, 3: z, 4: w})
    also = {f.code for f in scene.validate().findings} & {"CS512"}
    found = "poses that fit as quaternions in the order x, y, z, w"
    scene.expect("CS125", place=IMAGES, found=found, also=also)


def test_poses_that_are_just_wrong_have_no_convention(scene):
    rng = np.random.default_rng(0)

    def change(rotation, translation):
        turn = rotation_from_quaternion(rng.normal(size=4))
        return turn @ rotation, translation + rng.normal(size=3)

    scene.change_poses(change, range(18))
    assert "CS125" not in {f.code for f in scene.validate().findings}


def test_one_image_is_no_convention(scene):
    scene.change_poses(lambda r, t: (r.T, centre(r, t)), [3])
    scene.expect("CS513", place="(a003.png)")
