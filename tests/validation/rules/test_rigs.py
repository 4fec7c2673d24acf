import struct

import pytest

FRAMES, RIGS, IMAGES = (f"sparse/0/{stem}.bin" for stem in ("frames", "rigs", "images"))
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
    rigs.expect("CS141", place=f"sparse/0/{gone}.bin", found="none")


def test_frame_of_an_unknown_rig(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(1, 77))
    rigs.expect("CS142", place=FRAMES, found="rig 77 of frame 4")


def test_frame_of_an_unknown_image(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(-1, 77))
    rigs.expect("CS142", place=FRAMES, found="image 77", times=2)


def test_frame_of_an_unknown_sensor(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(-2, 77))
    rigs.expect("CS142", place=FRAMES, found="sensor 77 of frame 4", times=2)


def test_pose_of_the_frame_differs(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(6, v[6] + 1.0))
    rigs.expect("CS143", place=IMAGES, found="another one for 1 image: 'a003.png'")


def test_pose_of_the_frame_is_not_finite(rigs):
    edit_frame(rigs, 3, lambda v: v.__setitem__(6, float("nan")))
    rigs.expect("CS143", place=IMAGES, found="'a003.png'")
