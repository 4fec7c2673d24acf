import struct

import numpy as np
import pytest
from command_line import succeed

from chronoscene.scene import Camera
from chronoscene.scene.cameras import to_pycolmap
from chronoscene.validation.rules.cs1_cameras import displacement
from chronoscene.validation.run import validate_scene

CAMERAS = "sparse/0/cameras.txt"
PLACE = f"{CAMERAS} (camera 1)"


@pytest.mark.parametrize(
    "line",
    [
        "1 PINHOLE 64 48 -50 50 32 24",
        "1 PINHOLE 64 48 nan 50 32 24",
        "1 PINHOLE 0 48 50 50 32 24",
        "1 PINHOLE 64 10000000000000000000000000 50 50 32 24",
    ],
)
def test_camera_unusable(scene, line):
    scene.write(CAMERAS, [line])
    scene.expect("CS131", place=PLACE)


@pytest.mark.parametrize(
    "line",
    [
        "1 OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0",
        "1 FOV 64 48 50 50 32 24 0.1",
        "1 EQUIRECTANGULAR 64 48 32 24",
    ],
)
def test_camera_model(scene, line):
    scene.write(CAMERAS, [line])
    scene.expect("CS132", place=PLACE, found=line.split()[1])


@pytest.mark.parametrize(
    "line", ["1 SIMPLE_RADIAL 64 48 50 32 24 -0.16", "1 OPENCV 64 48 50 50 32 24 0 0 0.05 0"]
)
def test_camera_distorted(scene, line):
    scene.write(CAMERAS, [line])
    scene.expect("CS133", place=PLACE, found=line.split()[1])


def test_which_images_a_distorted_camera_took(scene):
    lines = scene.lines(CAMERAS)
    scene.write(CAMERAS, [*lines, "2 SIMPLE_RADIAL 64 48 50 32 24 -0.16"])
    scene.edit_fields("sparse/0/images.txt", 2, {8: "2"})
    report = scene.validate()
    (finding,) = [f for f in report.findings if f.code == "CS133"]
    assert finding.found.endswith("px in 1 image: 'a001.png'")
    assert finding.remedy == "undistort the images and the model: chronoscene undistort DIR OUT"


def test_undistorting_a_model_without_periods(scene, tmp_path):
    """The remedy, followed to the letter."""
    scene.write(CAMERAS, ["1 SIMPLE_RADIAL 64 48 50 32 24 -0.16"])
    names = [p.name for p in scene.path("images").iterdir()]
    table = tmp_path / "periods.csv"
    table.write_text("file,period\n" + "".join(f"{n},{n[0]}\n" for n in names))
    scene.path("sparse/split.txt").unlink()
    (finding,) = [f for f in scene.validate().findings if f.code == "CS133"]
    assert "chronoscene undistort DIR OUT" in finding.remedy and "table:FILE" in finding.remedy
    out = tmp_path / "out"
    succeed("undistort", scene.root, out, "--period-by", f"table:{table}")
    assert not validate_scene(out).count("error")


def test_distortion_that_nobody_sees_may_be_dropped(scene):
    scene.write(CAMERAS, ["1 RADIAL 64 48 50 32 24 0.0001 -0.0001"])
    report = scene.expect("CS133", place=PLACE, found="by up to 0.00")
    finding = next(f for f in report.findings if f.code == "CS133")
    assert finding.remedy.startswith("write the camera as PINHOLE")


@pytest.mark.parametrize(
    "line",
    [
        "1 SIMPLE_RADIAL 64 48 50 32 24 0",
        "1 RADIAL 64 48 50 32 24 0 -0",
        "1 FULL_OPENCV 64 48 50 50 32 24 0 0 0 0 0 0 0 0",
    ],
)
def test_zero_distortion(scene, line):
    scene.write(CAMERAS, [line])
    report = scene.expect("CS134", place=PLACE, found=line.split()[1])
    assert {f.severity for f in report.findings} == {"info"}


def test_implausible_focal(scene):
    also = {"CS513"}  # nor do the points project to where they are seen
    scene.write(CAMERAS, ["1 PINHOLE 64 48 6 6 32 24"])
    scene.expect("CS135", place=PLACE, found="159 degrees", also=also)
    scene.write(CAMERAS, ["1 PINHOLE 64 48 6000 6000 32 24"])
    scene.expect("CS135", place=PLACE, found="0.611 degrees", also=also)


def test_unequal_focal_lengths(scene):
    scene.write(CAMERAS, ["1 PINHOLE 64 48 50 25 32 24"])
    scene.expect("CS135", place=PLACE, found="fx = 50, fy = 25")


def test_principal_point_outside(scene):
    scene.write(CAMERAS, ["1 PINHOLE 64 48 50 50 70 24"])
    also = {"CS513", "CS705"}
    scene.expect("CS136", place=PLACE, found="(70, 24)", also=also)


def test_camera_unused(scene):
    scene.write(CAMERAS, [*scene.lines(CAMERAS), "2 PINHOLE 64 48 50 50 32 24"])
    scene.expect("CS137", place=f"{CAMERAS} (camera 2)", found="none")


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (500.0, 310.0, 250.0, -0.1)),
        ("RADIAL", (500.0, 310.0, 250.0, -0.1, 0.02)),
        ("OPENCV", (500.0, 510.0, 310.0, 250.0, -0.1, 0.02, 0.003, -0.004)),
        (
            "FULL_OPENCV",
            (500.0, 510.0, 310.0, 250.0, 0.1, 0.02, 0.003, -0.004, 0.01, 0.2, 0.1, 0.05),
        ),
    ],
)
def test_displacement_is_that_of_colmap(model, params):
    camera = Camera(1, model, 640, 480, params)
    K = camera.K
    along = np.linspace(0, 1, 65)
    zero, one = np.zeros(65), np.ones(65)
    border = np.hstack([[along, zero], [along, one], [zero, along], [one, along]]).T
    border *= [640, 480]
    rays = (border - K[:2, 2]) / K[[0, 1], [0, 1]]
    rays = np.hstack([rays, np.ones((len(rays), 1))])
    moved = np.array([to_pycolmap(camera).img_from_cam(ray) for ray in rays])
    expected = np.linalg.norm(moved - border, axis=1).max()
    assert displacement(camera) == pytest.approx(expected, rel=1e-9)


FRAMES, IMAGES = "sparse/0/frames.bin", "sparse/0/images.bin"
FRAME = struct.Struct("<II7dIiIQ")
"""A frame with one image: id, rig, pose, 1, sensor type and id, image id."""


@pytest.fixture
def rigs(scene):
    scene.to_binary(classic=False)
    return scene


def edit_frame(scene, index, change):
    """Apply a function to the values of a frame, the count of its images excepted."""
    data = bytearray(scene.path(FRAMES).read_bytes())
    at = 8 + index * FRAME.size
    values = list(FRAME.unpack_from(data, at))
    change(values)
    FRAME.pack_into(data, at, *values)
    scene.write(FRAMES, bytes(data))


def test_good_model_with_rigs(rigs):
    assert {f.code for f in rigs.validate().findings} == {"CS507"}


@pytest.mark.parametrize(("gone", "left"), [("frames", "rigs"), ("rigs", "frames")])
def test_rigs_partial(rigs, gone, left):
    rigs.path(f"sparse/0/{gone}.bin").unlink()
    rigs.expect("CS141", place=f"sparse/0/{gone}.bin", found="no such file")


def test_frame_of_an_unknown_rig(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(1, 77))
    rigs.expect("CS009", place="sparse/0")


def test_frame_of_an_unknown_image(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(-1, 77))
    rigs.expect("CS009", place="sparse/0")


def test_frame_of_an_unknown_sensor(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(-2, 77))
    rigs.expect("CS009", place="sparse/0")


def test_pose_of_the_frame_differs(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(6, v[6] + 1.0))
    rigs.expect("CS143", place=IMAGES, found="other poses for 1 image: 'a003.png'")


def test_pose_of_the_frame_is_not_finite(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(6, float("nan")))
    rigs.expect("CS143", place=IMAGES, found="'a003.png'")
