import numpy as np
import pytest

from chronoscene.scene.similarity import Sim3
from chronoscene.validation.rules.cs5_across_periods import connected

IMAGES, POINTS, WORLD = "sparse/0/images.txt", "sparse/0/points3D.txt", "sparse/world.json"
PERIOD_1 = range(9, 18)


def turn(axis, degrees):
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def in_frame_of_its_own(scene, similarity):
    """Express the poses of period 1 in another frame; the points stay in that of period 0."""

    def change(rotation, translation):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation
        moved = similarity.apply_to_pose(pose)
        return moved[:3, :3], moved[:3, 3]

    scene.change_poses(change, PERIOD_1)


def separate(scene, shift=(0.0, 0.0, 0.0), scale=1.0):
    """Give period 1 its own half of the points, moved and scaled with its poses."""
    in_frame_of_its_own(scene, Sim3(scale, np.eye(3), np.array(shift)))
    lines = scene.lines(POINTS)
    for row, line in enumerate(lines):
        words = line.split()
        mine = range(9) if row < 20 else PERIOD_1
        if row >= 20:
            moved = scale * np.array(words[1:4], float) + shift
            words[1:4] = [f"{x:.17g}" for x in moved]
        lines[row] = " ".join(words[:8] + [f"{i + 1} {row}" for i in mine])
    scene.write(POINTS, lines)
    lines = scene.lines(IMAGES)
    for image in range(18):
        words = lines[2 * image + 1].split()
        for row in range(40):
            if (row < 20) != (image < 9):
                words[3 * row + 2] = "-1"
        lines[2 * image + 1] = " ".join(words)
    scene.write(IMAGES, lines)


@pytest.mark.parametrize(
    "similarity",
    [
        Sim3(4.0, np.eye(3), np.zeros(3)),
        Sim3(1.0, turn("y", 40), np.array([3.0, 0, 1])),
        Sim3(1.25, np.eye(3), np.zeros(3)),
        Sim3(1.0, turn("x", 12), np.zeros(3)),
        Sim3(1.0, np.eye(3), np.array([0.2, 0, 0])),
    ],
)
def test_period_whose_poses_were_moved(scene, similarity):
    """Also by far less than what makes a single pose wrong."""
    in_frame_of_its_own(scene, similarity)
    found = {f.code: f.place for f in scene.validate().findings}
    assert "period 1" in (found.get("CS513"), found.get("CS515"))


def test_mirrored_period(scene):
    mirror = np.diag([1.0, 1.0, -1.0])
    flip = np.diag([-1.0, 1.0, 1.0])
    scene.change_poses(lambda r, t: (flip @ r @ mirror, flip @ t), PERIOD_1)
    scene.expect("CS513", place="period 1", also={"CS515"})


def test_focal_length_of_one_period(scene):
    scene.write(
        "sparse/0/cameras.txt", ["1 PINHOLE 64 48 50 50 32 24", "2 PINHOLE 64 48 62.5 62.5 32 24"]
    )
    for row in range(18, 36, 2):
        scene.edit_fields(IMAGES, row, {8: "2"})
    scene.expect("CS515", place="period 1", found="px; the worst are")


@pytest.mark.parametrize("number", ["1e308", "-1e200", "5e-324"])
@pytest.mark.parametrize("what", ["keypoint", "translation", "point"])
def test_absurd_numbers_in_a_period_of_another_frame(scene, what, number):
    in_frame_of_its_own(scene, Sim3(4.0, np.eye(3), np.zeros(3)))
    if what == "point":
        scene.edit_fields(POINTS, 5, {2: number})
    elif what == "keypoint":
        scene.edit_fields(IMAGES, 21, {0: number})
    else:
        scene.edit_fields(IMAGES, 20, {6: number})
    codes = {f.code for f in scene.validate().findings}
    assert "CS513" in codes and "CS000" not in codes


def test_separate_points_in_one_frame_need_a_match_only(scene):
    separate(scene)
    scene.expect("CS508")


def test_period_without_points(scene):
    scene.keep_images(range(40), range(1, 10))
    scene.expect("CS506", place="period 1", found="0 of 40", also={"CS509"})


def test_points_of_one_period(scene):
    scene.keep_images(range(10), range(10, 19))
    scene.expect(
        "CS507", place=POINTS, found="10 of 40 in one only (25.0 %): period 0 0, period 1 10"
    )


def test_period_unconnected(scene):
    scene.keep_images(range(10), range(10, 19))
    scene.keep_images(range(10, 40), range(1, 10))
    scene.expect("CS508", place="period 1", found="0 of 10")


def test_period_hardly_connected(scene):
    """Nine points in common are too few, ten are enough."""
    scene.keep_images(range(9, 25), range(10, 19))
    scene.keep_images(range(25, 40), range(1, 10))
    scene.expect("CS508", place="period 0", found="9 of 24")


def test_period_barely_connected(scene):
    scene.keep_images(range(10, 25), range(10, 19))
    scene.keep_images(range(25, 40), range(1, 10))
    assert "CS508" not in {f.code for f in scene.validate().findings}


def test_groups_of_periods_unconnected(scene):
    """Periods 0 and 1 share points, 2 and 3 share points, no others do."""
    names = sorted(p.name for p in scene.path("images").iterdir())
    periods = [0] * 4 + [1] * 5 + [2] * 4 + [3] * 5
    pairs = zip(names, periods, strict=True)
    scene.write("sparse/split.txt", [f"{name} {period}" for name, period in pairs])
    scene.keep_images(range(15), range(10, 19))
    scene.keep_images(range(15, 40), range(1, 10))
    found = [f for f in scene.validate().findings if f.code == "CS508"]
    assert [(f.place, f.found) for f in found] == [("periods 2, 3", "0 of 15")]


def test_periods_connected_by_a_chain(scene):
    """Periods 0 and 2 share nothing, but both share points with period 1."""
    names = sorted(p.name for p in scene.path("images").iterdir())
    scene.write("sparse/split.txt", [f"{n} {min(2, i // 6)}" for i, n in enumerate(names)])
    scene.keep_images(range(20), range(1, 13))
    scene.keep_images(range(20, 40), range(10, 19))
    assert "CS508" not in {f.code for f in scene.validate().findings}


def test_a_chain_of_any_length_is_one_group():
    links = np.diag([10] * 8, 1)
    assert [g.tolist() for g in connected(links + links.T, 10)] == [list(range(9))]
    links[4, 5] = 9
    assert [g.tolist() for g in connected(links + links.T, 10)] == [[0, 1, 2, 3, 4], [5, 6, 7, 8]]
