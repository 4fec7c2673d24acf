import math
import struct

import numpy as np
import pytest

from chronoscene.formats import read_scene
from chronoscene.scene.geometry import camera_centre

IMAGES, POINTS = "sparse/0/images.txt", "sparse/0/points3D.txt"


def test_no_points(scene):
    scene.write(POINTS, "# nothing\n")
    scene.write(IMAGES, ["" if i % 2 else line for i, line in enumerate(scene.lines(IMAGES))])
    report = scene.validate()
    assert {f.code for f in report.findings} == {"CS501", "CS509"}


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_point_not_finite(scene, value):
    scene.edit_fields(POINTS, 3, {2: value})
    scene.edit_fields(POINTS, 7, {1: value})
    report = scene.expect("CS502", place=POINTS, found="2 of 40 points (ids 4, 8)")
    assert next(f for f in report.findings if f.code == "CS502").count == 2


@pytest.mark.parametrize(
    ("track", "found"), [([], "no observation"), ([(3, 4)], "one observation")]
)
def test_short_track(scene, track, found):
    scene.set_track(4, track)
    scene.expect("CS503", place=POINTS, found=f"{found} for 1 of 40 points (ids 5)")


def test_track_over_a_missing_image(scene):
    scene.edit_fields(POINTS, 4, {8: "77"})
    scene.expect("CS504", place=POINTS, found="1 observation in image ids 77", also={"CS505"})


@pytest.mark.parametrize("keypoint", ["40", "-1", "999999999"])
def test_track_over_a_missing_keypoint(scene, keypoint):
    scene.edit_fields(POINTS, 4, {9: keypoint})
    scene.expect("CS504", place=POINTS, found="beyond the keypoints", also={"CS505"})


def test_keypoint_names_another_point(scene):
    keypoints = scene.lines(IMAGES)
    words = keypoints[1].split()
    words[2] = "30"
    scene.write(IMAGES, [keypoints[0], " ".join(words), *keypoints[2:]])
    report = scene.expect("CS505", found="whose keypoint refers to another point", times=2)
    assert any("1 keypoint of points" in f.found for f in report.findings)


def test_keypoint_of_no_point_in_a_track(scene):
    keypoints = scene.lines(IMAGES)
    words = keypoints[1].split()
    words[2] = "-1"
    scene.write(IMAGES, [keypoints[0], " ".join(words), *keypoints[2:]])
    scene.expect("CS505", place=POINTS, found="1 observation whose keypoint")


def test_image_without_points(scene):
    scene.keep_images(range(40), [i for i in range(1, 19) if i != 3])
    scene.expect("CS509", place=IMAGES, found="1 image without points: 'a002.png'")


def test_keypoint_not_finite_in_text(scene):
    scene.edit_fields(IMAGES, 3, {3: "nan"})
    scene.expect("CS103", place=f"{IMAGES}:4", found="nan")


def test_observation_not_finite(scene):
    x = float(scene.lines(IMAGES)[3].split()[3])
    scene.to_binary()
    path = scene.path("sparse/0/images.bin")
    data = path.read_bytes()
    assert data.count(struct.pack("<d", x)) == 1
    path.write_bytes(data.replace(struct.pack("<d", x), struct.pack("<d", math.nan)))
    scene.expect("CS510", place="sparse/0/images.bin", found="1 of 720 observations")


def test_no_training_points(scene):
    """All points are seen by the test images alone."""
    scene.keep_images(range(40), (4, 8, 9, 13, 17, 18))
    scene.expect("CS514", place=POINTS, found="0 of 40", also={"CS509"})


def test_points_without_colours(make_scene):
    """As COLMAP triangulates them: black, but for a few."""
    scene = make_scene(points=200, form="text")
    lines = [line.split() for line in scene.lines(POINTS) if not line.startswith("#")]
    for words in lines[:-5]:
        words[4:7] = ["0", "0", "0"]
    scene.write(POINTS, [" ".join(words) for words in lines])
    (finding,) = [f for f in scene.validate().findings if f.code == "CS522"]
    assert (finding.place, finding.found) == (POINTS, "#000000 for 97.5 % of them")


def test_one_colour_for_nineteen_of_twenty_points_is_none_too_many(make_scene):
    scene = make_scene(points=200, form="text")
    lines = [line.split() for line in scene.lines(POINTS) if not line.startswith("#")]
    for words in lines[:-10]:
        words[4:7] = ["0", "0", "0"]
    scene.write(POINTS, [" ".join(words) for words in lines])
    assert "CS522" not in {f.code for f in scene.validate().findings}


def test_points_with_colours(make_scene):
    scene = make_scene(points=200, form="text")
    assert "CS522" not in {f.code for f in scene.validate().findings}


def test_a_few_short_tracks_are_a_remark(scene, monkeypatch):
    monkeypatch.setattr("chronoscene.validation.rules.cs5_points.MAX_SHORT", 1 / 40)
    words = scene.lines(POINTS)[4].split()
    lines = scene.lines(POINTS)
    lines[4] = " ".join(words[:10])
    scene.write(POINTS, lines)
    assert "CS525" in {f.code for f in scene.validate().findings}
    assert "CS503" not in {f.code for f in scene.validate().findings}


def test_points_without_any_track_are_one_finding(scene):
    """Not one for each period, and one for the scene, too."""
    scene.write(POINTS, [" ".join(line.split()[:8]) for line in scene.lines(POINTS)])
    found = {f.code for f in scene.validate().findings}
    assert "CS503" in found and not found & {"CS506", "CS514", "CS525"}


def test_far_points(scene):
    scene.edit_fields(POINTS, 5, {2: "4e4"})
    scene.expect("CS518", place=POINTS, found="1 point up to 4e+04 away (ids 6)")


def test_far_points_of_absurd_size(scene):
    scene.edit_fields(POINTS, 5, {2: "1e300"})
    scene.expect("CS518", place=POINTS, found="(ids 6)")


@pytest.mark.parametrize(("times", "far"), [(99.9, False), (100.1, True)])
def test_far_is_a_hundred_times_the_usual_distance(scene, times, far):
    """Here the cameras are farther from the middle than the points."""
    scene.edit_fields(POINTS, 5, {2: "4e4"})  # medians do not depend on how far
    model = read_scene(scene.root)
    middle = np.median(model.points.xyz, axis=0)
    usual = np.median(np.linalg.norm(camera_centre(model.frame_poses) - middle, axis=1))
    sideways = np.linalg.norm((model.points.xyz[5] - middle)[[0, 2]])
    y = middle[1] + np.sqrt((times * usual) ** 2 - sideways**2)
    scene.edit_fields(POINTS, 5, {2: f"{y:.17g}"})
    assert ("CS518" in {f.code for f in scene.validate().findings}) == far
