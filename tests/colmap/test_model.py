"""Models through pycolmap and through our records; damaged files; the import order of zlib."""

import random
import shutil
import signal
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from fresh_process import run_python
from surveyed import moved

from chronoscene.colmap.binary import read_images, read_points
from chronoscene.colmap.model import (
    copy_poses,
    read_model,
    read_raw_model,
    read_reconstruction,
    write_model,
)
from chronoscene.colmap.raw_model import model_kind
from chronoscene.errors import SceneError
from chronoscene.formats import read_scene
from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene import Camera, Points
from chronoscene.scene.cameras import project_points


@pytest.mark.parametrize("last", ["zlib.compress(b'x' * 1000)", "numpy.savez_compressed(f, a=[1])"])
def test_zlib_survives_pycolmap_outside_pytest(last):
    """pycolmap 4.2.1 aborts the process here unless zlib was loaded before it."""
    code = "import chronoscene.colmap.model, zlib, numpy, io; f = io.BytesIO(); "
    code += f"{last}; print('alive')"
    assert run_python(code) == "alive\n"


def test_the_package_alone_makes_pycolmap_safe():
    """Whatever else a script imports after it: the package itself loads zlib."""
    code = "import chronoscene, pycolmap, zlib; zlib.compress(b'x' * 1000); print('alive')"
    assert run_python(code) == "alive\n"


@pytest.mark.parametrize("handler", ["lambda *_: sys.exit(7)", "signal.SIG_DFL"])
def test_pycolmap_leaves_the_termination_signal_alone(handler):
    """Its own handler would print a stack trace and keep ours from cleaning up."""
    code = (
        f"import signal, sys; signal.signal(signal.SIGTERM, {handler})\n"
        "import chronoscene.colmap.model; signal.raise_signal(signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == (-signal.SIGTERM if "SIG_DFL" in handler else 7)
    assert done.stderr == ""


def test_quaternions_of_few_digits_are_rotations(make_scene_folder):
    folder = make_scene_folder(form="text") / "sparse" / "0"
    for stem in ("rigs", "frames"):
        (folder / f"{stem}.txt").unlink()  # else the poses are theirs
    exact = read_model(folder)
    lines = (folder / "images.txt").read_text().splitlines()
    for row, line in enumerate(lines):
        words = line.split()
        if not line.startswith("#") and len(words) == 10 and words[9].endswith(".png"):
            words[1:5] = [f"{float(w):.4f}" for w in words[1:5]]
            lines[row] = " ".join(words)
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    for image, old in zip(read_model(folder).images, exact.images, strict=True):
        rotation = image.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(rotation, old.cam_from_world[:3, :3], atol=3e-4)
        assert not np.array_equal(rotation, old.cam_from_world[:3, :3])


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_records_agree_with_pycolmap(make_scene_folder, form):
    folder = make_scene_folder(form=form) / "sparse" / "0"
    model, theirs = read_model(folder), read_reconstruction(folder)
    assert len(model.images) == theirs.num_reg_images()
    for image in model.images:
        other = theirs.images[image.image_id]
        assert image.name == other.name
        np.testing.assert_array_equal(image.cam_from_world[:3], other.cam_from_world().matrix())
    points = model.points
    assert points.ids.tolist() == sorted(theirs.point3D_ids())
    for i, point_id in enumerate(points.ids.tolist()):
        point = theirs.points3D[point_id]
        np.testing.assert_array_equal(points.xyz[i], point.xyz)
        np.testing.assert_array_equal(points.rgb[i], point.color)
        assert points.error[i] == point.error
        span = range(points.track_start[i], points.track_start[i + 1])
        for j, element in zip(span, point.track.elements, strict=True):
            assert model.images[points.track_frame[j]].image_id == element.image_id
            keypoint = theirs.images[element.image_id].points2D[element.point2D_idx]
            np.testing.assert_array_equal(points.track_xy[j], keypoint.xy)


def test_rigs_of_several_cameras(tmp_path):
    """Poses of images in a rig come out with the sensor's place in the rig applied."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 20
    theirs = pycolmap.synthesize_dataset(options)
    theirs.write_binary(str(tmp_path))
    model = read_model(tmp_path)
    assert len(model.images) == 12
    for image in model.images:
        expected = theirs.images[image.image_id].cam_from_world().matrix()
        np.testing.assert_allclose(image.cam_from_world[:3], expected, atol=1e-14)
    for i, xyz in enumerate(model.points.xyz):
        for j in range(*model.points.track_start[i : i + 2]):
            image = model.images[model.points.track_frame[j]]
            x = image.cam_from_world[:3, :3] @ xyz + image.cam_from_world[:3, 3]
            (pixel,) = project_points(image.camera, x[None])
            np.testing.assert_allclose(pixel, model.points.track_xy[j], atol=1e-6)


def test_an_image_without_a_pose_is_not_registered(make_scene_folder):
    folder = make_scene_folder() / "sparse" / "0"
    model = read_reconstruction(folder)
    model.deregister_frame(model.images[2].frame_id)
    model.write_binary(str(folder))
    assert [i.image_id for i in read_model(folder).images] == [1, 3, 4]


def test_names_with_blanks_in_a_text_model(make_scene_folder):
    """COLMAP reads both images of the first folder as `2016`."""
    names = {"2016 spring/a 1.png": 0, "2016 spring/b.png": 0, "2017/c.png": 1, "2017/d  ü.png": 1}
    scene = read_scene(make_scene_folder(names, form="text"))
    assert {frame.name: frame.period for frame in scene.frames} == names
    images = scene.root / "sparse" / "0" / "images.txt"
    images.write_bytes(images.read_bytes().replace(b"a 1.png", b"a \xff.png"))
    with pytest.raises(SceneError, match="expected image names in UTF-8, found image"):
        read_scene(scene.root)


def test_binary_wins_over_text(make_scene_folder):
    folder = make_scene_folder() / "sparse" / "0"
    for stem in ("cameras", "images", "points3D"):
        (folder / f"{stem}.txt").write_text("broken")
    assert model_kind(folder) == "binary"
    assert len(read_model(folder).images) == 4


def test_large_coordinates_keep_their_digits(make_scene_folder, tmp_path):
    """A model in projected coordinates: 0.1 mm is kept at 4 000 km from the origin."""
    scene = moved(read_scene(make_scene_folder()), [442_000.0, 4_427_000.0, 50.0])
    write_model(tmp_path, scene.frames, scene.points)
    model = read_model(tmp_path)
    np.testing.assert_array_equal(model.points.xyz, scene.points.xyz)
    for image, frame in zip(model.images, scene.frames, strict=True):
        np.testing.assert_allclose(image.cam_from_world, frame.cam_from_world, rtol=1e-14)


def test_a_model_without_points(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    write_model(tmp_path, scene.frames, Points.empty())
    points = read_model(tmp_path).points
    assert len(points) == 0
    assert points.track_xy.shape == (0, 2) and points.track_start.tolist() == [0]


def records(folder, **overrides) -> None:
    """A model of one image with one keypoint and one point, written byte by byte."""
    values = {"track": (1, 0), "point_ids": (1,), "images": (1,), "camera_model": 0} | overrides
    camera = struct.pack("<QiiQQ3d", 1, 1, values["camera_model"], 8, 8, 8.0, 4.0, 4.0)
    image = b"".join(
        struct.pack("<i7di", i, 1, 0, 0, 0, 0, 0, 0, 1)
        + f"{n}.png\0".encode()
        + struct.pack("<Qddq", 1, 4.0, 4.0, 1)
        for n, i in enumerate(values["images"])
    )
    point = b"".join(
        struct.pack("<Q3d3Bd", i, 0, 0, 5, 1, 2, 3, 0.5) + struct.pack("<Qii", 1, *values["track"])
        for i in values["point_ids"]
    )
    (folder / "cameras.bin").write_bytes(camera)
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(values["images"])) + image)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(values["point_ids"])) + point)


def test_records_written_by_hand(tmp_path):
    records(tmp_path)
    model = read_model(tmp_path)
    assert model.images[0].camera == Camera(1, "SIMPLE_PINHOLE", 8, 8, (8.0, 4.0, 4.0))
    assert model.points.rgb.tolist() == [[1, 2, 3]]
    assert model.points.track_xy.tolist() == [[4.0, 4.0]]


def test_ids_of_32_bits(tmp_path):
    """COLMAP's ids of images and cameras are unsigned."""
    image_id, camera_id = 2**32 - 2, 2**31
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=camera_id, model="SIMPLE_PINHOLE", width=8, height=8, params=[8, 4, 4]
    )
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", camera_id=camera_id, image_id=image_id)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D([4, 4])])
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.add_point3D([0, 0, 5], pycolmap.Track([pycolmap.TrackElement(image_id, 0)]), [1, 2, 3])
    model.write_binary(str(tmp_path))
    (posed,), points = (found := read_model(tmp_path)).images, found.points
    assert (posed.image_id, posed.camera.camera_id) == (image_id, camera_id)
    assert points.track_xy.tolist() == [[4, 4]]
    raw = read_raw_model(tmp_path)
    assert raw.images.ids.tolist() == raw.points.track_image.tolist() == [image_id]
    assert raw.images.camera_ids.tolist() == [raw.cameras[0].camera_id] == [camera_id]


def test_points_in_any_order_come_out_by_id(tmp_path):
    """COLMAP writes points in the order of a hash table; tracks must follow their points."""
    records(tmp_path, images=(1, 2), point_ids=())
    point = struct.Struct("<Q3d3BdQ")
    written = {9: [(1, 0)], 4: [], 7: [(2, 0), (1, 0)]}
    data = struct.pack("<Q", 3)
    for point_id, track in written.items():
        data += point.pack(point_id, point_id, 0, 5, 1, 2, point_id, 0.5, len(track))
        data += b"".join(struct.pack("<ii", *pair) for pair in track)
    (tmp_path / "points3D.bin").write_bytes(data)
    points = read_points(tmp_path / "points3D.bin")
    assert points.ids.tolist() == [4, 7, 9]
    assert points.xyz[:, 0].tolist() == [4, 7, 9]
    assert points.track_start.tolist() == [0, 0, 2, 3]
    assert points.track_image.tolist() == [2, 1, 1]
    assert points.track_keypoint.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"track": (2, 0)}, "tracks over images of the model, found image 2"),
        ({"track": (1, 1)}, "found keypoint 1 of image 1, which has 1"),
        ({"track": (1, -1)}, "found keypoint -1 of image 1, which has 1"),
        ({"point_ids": (5, 5)}, "found point id 5 twice"),
        ({"point_ids": (2**64 - 1,)}, "more than 63 bits"),
        ({"images": (1, 1)}, "found image id 1 twice"),
        ({"camera_model": 77}, "unknown model id 77"),
        ({"images": ()}, "found image 1, which it lacks"),
    ],
)
def test_records_that_contradict_each_other(tmp_path, overrides, message):
    records(tmp_path, **overrides)
    with pytest.raises(SceneError) as error:
        read_model(tmp_path)
    assert message in str(error.value)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D", "rigs", "frames"])
def test_every_truncation_is_noticed(make_scene_folder, stem):
    folder = make_scene_folder(points=2) / "sparse" / "0"
    path = folder / f"{stem}.bin"
    whole = path.read_bytes()
    for length in range(0, len(whole), 1 + len(whole) // 300):
        path.write_bytes(whole[:length])
        with pytest.raises(SceneError):
            read_model(folder)
    path.write_bytes(whole + b"\0")
    with pytest.raises(SceneError, match="1 bytes after the last record"):
        read_model(folder)


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_random_damage_is_our_error_or_harmless(make_scene_folder, tmp_path, form):
    """Neither a crash of the process, nor an endless loop, nor another exception."""
    source = make_scene_folder(form=form, points=3) / "sparse" / "0"
    rng = random.Random(0)
    outcomes = set()
    for i in range(80):
        folder = shutil.copytree(source, tmp_path / str(i))
        path = rng.choice(sorted(folder.iterdir()))
        data = bytearray(path.read_bytes())
        for _ in range(rng.choice((1, 8))):
            data[rng.randrange(min(len(data), rng.choice((16, 10_000))))] = rng.choice((0, 7, 255))
        path.write_bytes(data)
        try:
            read_model(folder)
            outcomes.add("read")
        except SceneError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


@pytest.mark.parametrize(
    ("stem", "record"),
    [
        ("cameras", "camera record 0"),
        ("images", "image record 3, which announces"),
        ("points3D", "point record 1, which announces"),
        ("rigs", "rig record 0"),
        ("frames", "frame record 3, which announces 1 images"),
    ],
)
def test_the_record_that_a_file_ends_inside_is_named(make_scene_folder, stem, record):
    folder = make_scene_folder(points=2) / "sparse" / "0"
    path = folder / f"{stem}.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(SceneError, match=f"found a file that ends inside {record}"):
        read_model(folder)
    path.write_bytes(b"123")
    with pytest.raises(SceneError, match="ends inside the number of its records"):
        read_model(folder)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(SceneError, match="found nothing; copy the model there"):
        read_model(tmp_path / "none")
    (tmp_path / "cameras.bin").touch()
    with pytest.raises(SceneError, match=r"found cameras\.bin"):
        read_model(tmp_path)
    with pytest.raises(SceneError, match=r"images\.bin: expected complete COLMAP records"):
        read_images(tmp_path / "images.bin")
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2**60))
    with pytest.raises(SceneError, match="records announced in 8 bytes"):
        read_points(tmp_path / "points3D.bin")


def test_real_models(shared_data):
    models = shared_data / "colmap_models"
    sceaux = read_model(models / "sceaux_txt")
    assert (len(sceaux.images), len(sceaux.points)) == (11, 7862)
    assert [i.name for i in sceaux.images] == [f"100_7{n}.JPG" for n in range(100, 111)]
    shared = read_model(models / "shared_camera_8of_many")
    assert (len(shared.images), len(shared.points)) == (8, 10_160)
    assert len({i.camera for i in shared.images}) == 1
    with pytest.raises(SceneError, match="expected a model that COLMAP reads"):
        read_model(models / "t265_fisheye_txt")


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_poses_are_copied_to_the_last_bit(make_scene_folder, tmp_path, form):
    source = make_scene_folder(form=form) / "sparse" / "0"
    scene = read_scene(source.parents[1])
    rng = np.random.default_rng(0)
    turned = [
        replace(f, cam_from_world=f.cam_from_world + rng.normal(0, 1e-3, (4, 4)) * np.eye(4)[3])
        for f in scene.frames
    ]
    write_model(tmp_path, turned, scene.points)
    before = read_raw_model(tmp_path)
    assert not copy_poses(tmp_path / "none", tmp_path, scene.frames)
    assert not copy_poses(source, tmp_path, turned)  # it has other poses
    assert read_raw_model(tmp_path).images.translations.tobytes() == (
        before.images.translations.tobytes()
    )
    assert copy_poses(source, tmp_path, scene.frames)
    old, new = read_raw_model(source).images, read_raw_model(tmp_path)
    row = [old.names.index(name) for name in new.images.names]
    assert new.images.quaternions.tobytes() == old.quaternions[row].tobytes()
    assert new.images.translations.tobytes() == old.translations[row].tobytes()
    assert new.points.track_keypoint.tolist() == before.points.track_keypoint.tolist()
    assert new.images.keypoint_xy.tobytes() == before.images.keypoint_xy.tobytes()
    for image, frame in zip(read_model(tmp_path).images, scene.frames, strict=True):
        assert image.cam_from_world.tobytes() == frame.cam_from_world.tobytes()
