import numpy as np

CAMERAS, IMAGES = "sparse/0/cameras.txt", "sparse/0/images.txt"


def test_observations_outside(scene):
    scene.write(CAMERAS, ["1 PINHOLE 32 24 25 25 16 12"])
    report = scene.validate()
    finding = next(f for f in report.findings if f.code == "CS511")
    assert finding.place == f"{CAMERAS} (camera 1)"
    assert finding.expected == "observations within 32 x 24"
    assert {f.code for f in report.findings} == {"CS205", "CS507", "CS511", "CS513"}


def test_opengl_poses(scene):
    flip = np.diag([1.0, -1.0, -1.0])
    scene.change_poses(lambda r, t: (flip @ r, flip @ t), range(14))
    scene.expect("CS512", place=IMAGES, found="560 of 560 observations behind")


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
    scene.expect("CS513", place=f"{IMAGES} (a000.png)", found="px", times=14)
