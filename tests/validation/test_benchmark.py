"""What the benchmark refuses is an error of the validator, and what it takes is none."""

import pytest

from chronoscene.errors import SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.plan.parts import make_parts
from chronoscene.images.store import ImageStore

CAMERAS, IMAGES, POINTS = (f"sparse/0/{stem}.txt" for stem in ("cameras", "images", "points3D"))
TEST = "sparse/0/test.txt"


def without_points(scene, images):
    """Drop the observations in some images (ids); all points stay."""
    lines = scene.lines(IMAGES)
    for image in images:
        lines[2 * image - 1] = ""
    scene.write(IMAGES, lines)
    points = []
    for line in scene.lines(POINTS):
        words = line.split()
        pairs = zip(words[8::2], words[9::2], strict=True)
        points.append(" ".join(words[:8] + [f"{i} {k}" for i, k in pairs if int(i) not in images]))
    scene.write(POINTS, points)


def all_points(scene):
    without_points(scene, range(1, 19))
    scene.write(POINTS, "")


TRAINING_IMAGES = [i for i in range(1, 19) if i not in (4, 8, 9, 13, 17, 18)]

TAKEN = {
    "as it is": lambda scene: None,
    "no distortion": lambda scene: scene.write(CAMERAS, "1 OPENCV 64 48 50 50 32 24 0 0 0 0"),
    "one image without points": lambda scene: without_points(scene, [1]),
    "no test image in one period": lambda scene: scene.write(TEST, "a003.png"),
    "no test image": lambda scene: scene.write(TEST, ""),
}

REFUSED = {
    "distortion": lambda scene: scene.write(CAMERAS, "1 OPENCV 64 48 50 50 32 24 .1 0 0 0"),
    "little distortion": lambda scene: scene.write(CAMERAS, "1 SIMPLE_RADIAL 64 48 50 32 24 1e-9"),
    "fisheye": lambda scene: scene.write(CAMERAS, "1 OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0"),
    "division": lambda scene: scene.write(CAMERAS, "1 SIMPLE_DIVISION 64 48 50 32 24 0"),
    "no training image": lambda scene: scene.write(
        TEST, [f"{p}{i:03d}.png" for p in "ab" for i in range(9)]
    ),
    "no points": all_points,
    "points in test images only": lambda scene: without_points(scene, TRAINING_IMAGES),
}


def bench_takes(scene):
    ours = read_scene(scene.root)
    return make_parts(ours, ImageStore(ours), "joint")


@pytest.mark.parametrize("case", TAKEN)
def test_what_is_taken_is_no_error(scene, case):
    TAKEN[case](scene)
    assert bench_takes(scene)
    errors = [f for f in scene.validate().findings if f.severity == "error"]
    assert not errors


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_is_an_error(scene, case):
    REFUSED[case](scene)
    with pytest.raises(SceneError):
        bench_takes(scene)
    assert any(f.severity == "error" for f in scene.validate().findings)
