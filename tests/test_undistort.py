"""Undistorted scenes: pixels and observations are where the formulas of the models say."""

import dataclasses
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import ImageError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene
from chronoscene.images.decoding import load_rgb
from chronoscene.images.masks import mask_place
from chronoscene.images.store import ImageStore
from chronoscene.images.undistortion import (
    CameraChange,
    move_pixels,
    pinhole_camera,
    sampling_map,
    warp,
)
from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene import Camera, Period, WorldFrame
from chronoscene.scene.cameras import from_pycolmap, to_pycolmap
from chronoscene.scene.splits import split_hash
from chronoscene.undistort import undistort

SIZE = (256, 192)
F, CX, CY = 210.0, 120.5, 101.25

CAMERAS = {
    "SIMPLE_RADIAL": (F, CX, CY, -0.12),
    "RADIAL": (F, CX, CY, 0.1, -0.05),
    "OPENCV": (F, F + 4, CX, CY, -0.2, 0.05, 0.003, -0.002),
    "FULL_OPENCV": (F, F + 4, CX, CY, 0.1, 0.02, 0.002, 0.001, 0.01, 0.15, 0.03, 0.002),
    "OPENCV_FISHEYE": (F, F + 4, CX, CY, 0.05, -0.02, 0.003, 0.001),
}


def distort(model, params, x, y):
    """Pixel of a ray x, y, 1 by the published formulas; nothing of it comes from COLMAP."""
    single = model in ("SIMPLE_RADIAL", "RADIAL")
    fx, fy, cx, cy = (params[0], *params[:3]) if single else params[:4]
    k = params[3:] if single else params[4:]
    r2 = x * x + y * y
    if model == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        t = np.arctan(r)
        t = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8)
        factor = np.where(r > 1e-9, t / np.maximum(r, 1e-9), 1.0)
        return fx * x * factor + cx, fy * y * factor + cy
    k1, k2, p1, p2, k3, k4, k5, k6 = {
        "SIMPLE_RADIAL": (k[0], *[0] * 7),
        "RADIAL": (*k[:2], *[0] * 6),
        "OPENCV": (*k[:4], *[0] * 4),
        "FULL_OPENCV": k,
    }[model]  # fmt: skip
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return fx * u + cx, fy * v + cy


OTHER_CAMERAS = {
    "FOV": (F, F + 4, CX, CY, 0.6),
    "FISHEYE": (F, F + 4, CX, CY),
    "SIMPLE_FISHEYE": (F, CX, CY),
    "SIMPLE_RADIAL_FISHEYE": (F, CX, CY, 0.05),
    "RADIAL_FISHEYE": (F, CX, CY, 0.05, -0.02),
    "THIN_PRISM_FISHEYE": (F, F + 4, CX, CY, 0.05, -0.02, 1e-3, 2e-3, 3e-3, 1e-3, 2e-3, -1e-3),
    "EUCM": (F, F + 4, CX, CY, 0.5, 1.1),
    "DIVISION": (F, F + 4, CX, CY, -0.1),
    "SIMPLE_DIVISION": (F, CX, CY, -0.1),
}


def distort_other(model, params, x, y):
    """The same for the models that are rare."""
    single = model.startswith(("SIMPLE_", "RADIAL_"))
    fx, fy, cx, cy = (params[0], *params[:3]) if single else params[:4]
    k, r = params[3:] if single else params[4:], np.hypot(x, y)
    if model == "FOV":
        factor = np.arctan(2 * r * np.tan(k[0] / 2)) / (r * k[0])
    elif model == "EUCM":
        factor = 1 / (k[0] * np.sqrt(k[1] * r**2 + 1) + 1 - k[0])
    elif model.endswith("DIVISION"):  # r = s / (1 + k s^2), solved for s / r
        factor = 2 / (1 + np.sqrt(1 - 4 * k[0] * r**2))
    else:
        factor = np.arctan(r) / r
    u, v = x * factor, y * factor
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, s1, s2 = k
        q = u * u + v * v
        radial = k1 * q + k2 * q**2 + k3 * q**3 + k4 * q**4
        u, v = (
            u + u * radial + 2 * p1 * u * v + p2 * (q + 2 * u * u) + s1 * q,
            v + v * radial + p1 * (q + 2 * v * v) + 2 * p2 * u * v + s2 * q,
        )
    elif model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        q = u * u + v * v
        radial = 1 + k[0] * q + (k[1] * q**2 if len(k) > 1 else 0)
        u, v = u * radial, v * radial
    return fx * u + cx, fy * v + cy


@pytest.fixture(params=CAMERAS)
def camera(request) -> Camera:
    params = CAMERAS[request.param]
    return Camera(1, request.param, *SIZE, tuple(float(p) for p in params))


@pytest.fixture
def make_distorted(make_scene_folder, tmp_path):
    """Factory of scenes in the ChronoScene format with exact observations of a given camera."""

    def make(camera, pixels=None, *, name="distorted", size=SIZE, suffix=".png", **save):
        names = {f"a/{i}{suffix}": 0 for i in range(3)} | {f"b/{i}{suffix}": 1 for i in range(3)}
        scene = read_scene(make_scene_folder(names, name=f"{name}-source", tests=["a/1", "b/2"]))
        points = scene.points
        xyz = np.repeat(points.xyz, np.diff(points.track_start), axis=0)
        poses = scene.frame_poses[points.track_frame]
        rays = np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
        xy = distort(camera.model, camera.params, *(rays[:, :2] / rays[:, 2:]).T)
        scene = scene.with_frames([dataclasses.replace(f, camera=camera) for f in scene.frames])
        scene = dataclasses.replace(
            scene,
            points=dataclasses.replace(points, track_xy=np.stack(xy, axis=1)),
            periods=(Period(0, "old", "2016-09"), Period(1, "new")),
            world=WorldFrame("metre"),
        )
        root = our_format.write(scene, tmp_path / name, image_source="none")
        for i, frame in enumerate(scene.frames):
            rng = np.random.default_rng(i)
            image = rng.integers(0, 256, (*size[::-1], 3), np.uint8) if pixels is None else pixels
            path = root / "images" / frame.name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(path, **save)
        return read_scene(root)

    return make


def reprojection_errors(scene):
    points = scene.points
    xyz = np.repeat(points.xyz, np.diff(points.track_start), axis=0)
    poses = scene.frame_poses[points.track_frame]
    Ks = np.stack([f.camera.K for f in scene.frames])[points.track_frame]
    x = np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
    pixels = np.einsum("nij,nj->ni", Ks, x / x[:, 2:])[:, :2]
    return np.abs(pixels - points.track_xy)


def blobs():
    """White blobs of 1.5 px at known places, on black. Image and places [N, 2]."""
    x, y = np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5
    places = np.array([(a, b) for a in range(24, 240, 32) for b in range(24, 180, 32)], float)
    places += np.random.default_rng(0).uniform(-2, 2, places.shape)
    image = sum(np.exp(-((x - a) ** 2 + (y[:, None] - b) ** 2) / (2 * 1.5**2)) for a, b in places)
    return np.repeat(np.round(255 * image).astype(np.uint8)[..., None], 3, axis=2), places


def undistorted_place(camera, target, place):
    """Pixel of the new camera whose ray the old one sees at a place; by Newton's method."""
    K = target.K

    def old_pixel(uv):
        ray = (uv - K[:2, 2]) / K[[0, 1], [0, 1]]
        return np.array(distort(camera.model, camera.params, *ray))

    uv = np.array(place)
    for _ in range(20):
        steps = [(old_pixel(uv + d) - old_pixel(uv - d)) / 2e-4 for d in 1e-4 * np.eye(2)]
        uv = uv - np.linalg.solve(np.stack(steps, axis=1), old_pixel(uv) - place)
    assert np.abs(old_pixel(uv) - place).max() < 1e-6
    return uv


def centroid(image, place, radius=6):
    """Centre of mass around a place, in pixels; pixel (0, 0) is centred at (0.5, 0.5)."""
    a, b = np.floor(place).astype(int)
    window = image[b - radius : b + radius + 1, a - radius : a + radius + 1, 0].astype(float)
    ys, xs = np.mgrid[b - radius : b + radius + 1, a - radius : a + radius + 1] + 0.5
    return np.array([(xs * window).sum(), (ys * window).sum()]) / window.sum()


@pytest.mark.parametrize("center", [False, True])
def test_pixels_are_where_the_formula_says(camera, make_distorted, tmp_path, center):
    image, places = blobs()
    scene = make_distorted(camera, image)
    new = undistort(scene, tmp_path / "out", center=center).scene
    result = np.array(Image.open(new.image_path(new.frames[0])))
    target = new.frames[0].camera
    assert result.shape == (target.height, target.width, 3)
    found = 0
    for place in places:
        u, v = undistorted_place(camera, target, place)
        if 12 < u < target.width - 12 and 12 < v < target.height - 12:
            np.testing.assert_allclose(centroid(result, (u, v)), [u, v], atol=0.05)
            found += 1
    assert found > 20


@pytest.mark.parametrize("center", [False, True])
@pytest.mark.parametrize("model", OTHER_CAMERAS)
def test_rare_models_follow_their_formulas(model, center):
    """The map of pixels, and observations, which go the other way."""
    camera = Camera(1, model, *SIZE, OTHER_CAMERAS[model])
    change = CameraChange(camera, pinhole_camera(camera, center=center))
    K = change.target.K
    maps = np.stack(sampling_map(change))
    columns, rows = np.meshgrid(np.arange(maps.shape[2]) + 0.5, np.arange(maps.shape[1]) + 0.5)
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    np.testing.assert_allclose(maps, distort_other(model, camera.params, x, y), atol=1e-4)
    places = maps[:, 5:-5:7, 5:-5:7].reshape(2, -1).T.astype(float)
    expected = np.stack([columns, rows], axis=-1)[5:-5:7, 5:-5:7].reshape(-1, 2)
    np.testing.assert_allclose(move_pixels(change, places), expected, atol=1e-3)


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_agrees_with_opencv(model):
    """Its pixels are counted from the centre of the first one."""
    camera = Camera(1, model, *SIZE, CAMERAS[model])
    change = CameraChange(camera, pinhole_camera(camera))
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    make = cv2.fisheye if model == "OPENCV_FISHEYE" else cv2
    maps = make.initUndistortRectifyMap(
        camera.K - half,
        np.array(camera.distortion),
        np.eye(3),
        change.target.K - half,
        (change.target.width, change.target.height),
        cv2.CV_32FC1,
    )
    np.testing.assert_allclose(np.array(sampling_map(change)) - 0.5, maps, atol=1e-4)


def test_agrees_with_the_undistorter_of_colmap(camera):
    """Where an image is smooth, both filters give the same."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    image = np.stack([x * 0.9, y * 1.2, 128 + 60 * np.sin(x / 25) * np.cos(y / 20)], axis=-1)
    image = np.round(image).astype(np.uint8)
    options = pycolmap.UndistortCameraOptions()
    theirs, target = pycolmap.undistort_image(
        options, pycolmap.Bitmap.from_array(image), to_pycolmap(camera)
    )
    change = CameraChange(camera, pinhole_camera(camera))
    assert from_pycolmap(target).params == change.target.params
    difference = warp(image, *sampling_map(change)).astype(int) - theirs.to_array()
    assert np.abs(difference[3:-3, 3:-3]).max() <= 2  # rounded to whole levels twice


@pytest.mark.parametrize("center", [False, True])
def test_observations_reproject(camera, make_distorted, tmp_path, center):
    scene = make_distorted(camera)
    done = undistort(scene, tmp_path / "out", center=center)
    again = read_scene(tmp_path / "out")
    errors = reprojection_errors(again)
    assert len(errors) > 60 and errors.max() < 1e-3
    kept = len(again.points.track_xy)
    assert kept + done.observations_lost == len(scene.points.track_xy)
    limits = np.array([[f.camera.width, f.camera.height] for f in again.frames])
    assert (again.points.track_xy >= 0).all()
    assert (again.points.track_xy <= limits[again.points.track_frame]).all()


def test_all_but_cameras_stays(camera, make_distorted, tmp_path):
    scene = make_distorted(camera)
    done = undistort(scene, tmp_path / "out")
    again = read_scene(tmp_path / "out")
    assert (again.periods, again.world) == (scene.periods, scene.world)
    assert split_hash(again) == split_hash(scene)
    assert {f.camera.model for f in again.frames} == {"PINHOLE"}
    for a, b in zip(scene.frames, again.frames, strict=True):
        assert (a.name, a.image_id) == (b.name, b.image_id)
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-13)
    assert len(again.points) + done.points_lost == len(scene.points)


def test_principal_point_in_the_centre(camera, make_distorted, tmp_path):
    new = undistort(make_distorted(camera), tmp_path / "out", center=True).scene
    target = new.frames[0].camera
    assert target.params[2:] == (target.width / 2, target.height / 2)
    plain = pinhole_camera(camera)
    assert 0 < plain.width - target.width < 40 and 0 <= plain.height - target.height < 40


def pinhole(**changes):
    return dataclasses.replace(Camera(1, "PINHOLE", *SIZE, (F, F + 4, CX, CY)), **changes)


@pytest.mark.parametrize(
    "camera",
    [
        pinhole(),
        pinhole(model="SIMPLE_PINHOLE", params=(F, CX, CY)),
        pinhole(model="OPENCV", params=(F, F + 4, CX, CY, 0, 0, 0, 0)),
    ],
    ids=lambda c: c.model,
)
def test_images_without_distortion_are_copied(make_distorted, tmp_path, camera):
    as_opencv = Camera(1, "OPENCV", *SIZE, (*camera.K[[0, 1], [0, 1]], CX, CY, 0, 0, 0, 0))
    scene = make_distorted(as_opencv)
    scene = scene.with_frames([dataclasses.replace(f, camera=camera) for f in scene.frames])
    done = undistort(scene, tmp_path / "out")
    assert [change.is_copy for change in done.changes] == [True]
    for a, b in zip(scene.frames, done.scene.frames, strict=True):
        assert scene.image_path(a).read_bytes() == done.scene.image_path(b).read_bytes()
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    np.testing.assert_allclose(done.scene.points.track_xy, scene.points.track_xy, atol=1e-12)


def test_centring_by_whole_pixels_keeps_pixels(make_distorted, tmp_path):
    camera = Camera(1, "OPENCV", *SIZE, (F, F, 120.0, 100.0, 0, 0, 0, 0))
    scene = make_distorted(camera)
    new = undistort(scene, tmp_path / "out", center=True).scene
    assert (new.frames[0].camera.width, new.frames[0].camera.height) == (240, 184)
    for a, b in zip(scene.frames, new.frames, strict=True):
        old = np.array(Image.open(scene.image_path(a)))
        np.testing.assert_array_equal(np.array(Image.open(new.image_path(b))), old[8:192, 0:240])


def test_files_of_another_size_than_their_camera(make_distorted, tmp_path):
    """The camera is scaled to the file; observations follow."""
    camera = Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"])
    half = make_distorted(camera, size=(SIZE[0] // 2, SIZE[1] // 2))
    done = undistort(half, tmp_path / "out")
    (change,) = done.changes
    assert (change.source.width, change.source.height) == (128, 96)
    assert change.source.params[0] == F / 2
    assert abs(change.target.width - 128) < 15
    assert reprojection_errors(done.scene).max() < 1e-3


def test_two_sizes_of_one_camera_become_two_cameras(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    Image.new("RGB", (128, 96)).save(scene.image_path(scene.frames[0]))
    again = undistort(scene, tmp_path / "out").scene
    ids = [f.camera.camera_id for f in read_scene(tmp_path / "out").frames]
    assert ids[0] == 1 and set(ids[1:]) == {2}
    assert reprojection_errors(again).max() < 1e-3


def test_points_without_observations_left_are_dropped(make_distorted, tmp_path):
    """With the principal point near a corner, little is left around it."""
    camera = Camera(1, "OPENCV", *SIZE, (F, F, 10.0, 10.0, 0, 0, 0, 0))
    scene = make_distorted(camera)
    done = undistort(scene, tmp_path / "out", center=True)
    assert done.points_lost > 0
    again = read_scene(tmp_path / "out")
    assert len(again.points) == len(scene.points) - done.points_lost
    assert (np.diff(again.points.track_start) > 0).all()
    assert set(again.points.ids) < set(scene.points.ids)


def test_observations_at_infinity_are_dropped(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    xy = scene.points.track_xy.copy()
    xy[0] = np.nan
    scene = dataclasses.replace(scene, points=dataclasses.replace(scene.points, track_xy=xy))
    done = undistort(scene, tmp_path / "out")
    assert done.observations_lost >= 1
    assert np.isfinite(done.scene.points.track_xy).all()


def test_pixels_beyond_the_field_of_view_have_no_place():
    """Rays at 90 degrees and more from the axis of a fisheye are not on the image plane."""
    params = (284.468, 285.51, 424.355, 393.742, 0.0008, 0.031, -0.03, 0.005)
    fisheye = Camera(1, "OPENCV_FISHEYE", 848, 800, params)
    change = CameraChange(fisheye, pinhole_camera(fisheye))
    inside, corner = move_pixels(change, np.array([[500.0, 300.0], [0.0, 0.0]]))
    assert np.isnan(corner).all()
    ray = (inside - change.target.K[:2, 2]) / change.target.K[[0, 1], [0, 1]]
    np.testing.assert_allclose(distort("OPENCV_FISHEYE", params, *ray), [500, 300], atol=1e-3)


def test_exif_and_quality_of_jpegs(make_distorted, tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = "2020:01:02 03:04:05"
    image, _ = blobs()
    camera = Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"])
    scene = make_distorted(camera, image, suffix=".jpg", exif=exif, quality=98)
    new = undistort(scene, tmp_path / "out").scene
    with Image.open(new.image_path(new.frames[0])) as result:
        assert result.format == "JPEG"
        assert result.getexif().get_ifd(0x8769)[0x9003] == "2020:01:02 03:04:05"


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_exif_of_every_kind_of_file(make_distorted, tmp_path, suffix):
    """Dates and positions of capture stay, and so does the orientation tag: pixels do not turn."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    exif.get_ifd(0x8769)[0x9003] = "2020:01:02 03:04:05"
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 7.0, 30.5)})
    exif[0x8769] = exif[0x8825] = 0  # where the blocks are; Pillow fills it in
    camera = Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"])
    scene = make_distorted(camera, suffix=suffix, exif=exif)
    plain = make_distorted(camera, suffix=suffix, name="plain")
    new, straight = (
        undistort(source, tmp_path / f"out{i}").scene for i, source in enumerate((scene, plain))
    )
    paths = [s.image_path(s.frames[0]) for s in (new, straight)]
    np.testing.assert_array_equal(load_rgb(paths[0]), load_rgb(paths[1]))
    with Image.open(paths[0]) as result:
        found = result.getexif()
        assert (found[0x0112], found[0x010F]) == (6, "Maker")
        assert found.get_ifd(0x8769)[0x9003] == "2020:01:02 03:04:05"
        assert found.get_ifd(0x8825)[1] == "N"


def test_exif_that_no_file_can_hold_is_dropped(make_distorted, tmp_path):
    """Two blocks come as one of twice the length; a tag of a wrong type cannot be written."""
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]), suffix=".jpg")
    block = b"Exif\0\0" + bytes(60_000)
    segment = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
    for frame in scene.frames:
        path = scene.image_path(frame)
        path.write_bytes(path.read_bytes()[:2] + 2 * segment + path.read_bytes()[2:])
    new = undistort(scene, tmp_path / "out").scene
    with Image.open(new.image_path(new.frames[0])) as result:
        assert "exif" not in result.info


def test_tiff_tags_of_wrong_types_are_dropped(make_distorted, tmp_path):
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 7.0, 30.5)})
    exif[0x8825] = 0
    camera = Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"])
    scene = make_distorted(camera, suffix=".tif", exif=exif)
    for frame in scene.frames:
        path = scene.image_path(frame)
        data = path.read_bytes()
        fractions, text = struct.pack("<HHI", 2, 5, 3), struct.pack("<HHI", 2, 2, 3)
        assert data.count(fractions) == 1
        path.write_bytes(data.replace(fractions, text))
    new = undistort(scene, tmp_path / "out").scene
    with Image.open(new.image_path(new.frames[0])) as result:
        assert result.getexif()[0x010F] == "Maker"
        assert result.getexif().get_ifd(0x8825) == {1: "N"}


@pytest.mark.parametrize(("space", "kept"), [(b"RGB ", True), (b"GRAY", False), (b"CMYK", False)])
def test_colour_profiles_of_other_colours_are_dropped(make_distorted, tmp_path, space, kept):
    profile = bytes(16) + space + bytes(108)
    camera = Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"])
    new = undistort(make_distorted(camera, icc_profile=profile), tmp_path / "out").scene
    with Image.open(new.image_path(new.frames[0])) as result:
        assert result.info.get("icc_profile") == (profile if kept else None)


@pytest.mark.parametrize("source", ["link", "symlink"])
def test_images_that_stay_may_be_linked(make_distorted, tmp_path, source):
    as_opencv = Camera(1, "OPENCV", *SIZE, (F, F, CX, CY, 0, 0, 0, 0))
    scene = make_distorted(as_opencv)
    new = undistort(scene, tmp_path / "out", image_source=source).scene
    for a, b in zip(scene.frames, new.frames, strict=True):
        assert new.image_path(b).samefile(scene.image_path(a))
        assert new.image_path(b).is_symlink() == (source == "symlink")


def test_the_number_of_threads_does_not_matter(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    for threads in (1, 3):
        undistort(scene, tmp_path / str(threads), threads=threads)
    for frame in scene.frames:
        one, three = (tmp_path / n / "images" / frame.name for n in ("1", "3"))
        assert one.read_bytes() == three.read_bytes()


def test_progress(make_distorted, tmp_path):
    seen = []
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    undistort(scene, tmp_path / "out", progress=lambda *counts: seen.append(counts))
    assert seen == [(i, 6) for i in range(1, 7)]


@pytest.mark.parametrize(
    ("camera", "center", "message"),
    [
        (pinhole(params=(F, F, -3, 10)), True, "a principal point inside the image"),
        (pinhole(params=(F, F, 0.5, 10)), True, "a principal point inside the image"),
        (Camera(1, "EQUIRECTANGULAR", 64, 32, (64.0, 32.0)), False, "a perspective camera"),
        (pinhole(width=70000, height=10), False, "at most 65535 pixels a side"),
    ],
)
def test_cameras_that_are_refused(camera, center, message):
    with pytest.raises(SceneError, match=f"camera 1: expected {message}"):
        pinhole_camera(camera, center=center)


def test_a_damaged_image_leaves_nothing_behind(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    path = scene.image_path(scene.frames[2])
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ImageError, match=r"2\.png: expected an image that can be decoded"):
        undistort(scene, tmp_path / "target/out")
    assert not (tmp_path / "target").exists()


def test_kinds_of_files_that_cannot_be_written(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]), suffix=".gif")
    with pytest.raises(SceneError, match=r"expected an image file that can be written: \.png"):
        undistort(scene, tmp_path / "out")


def test_a_folder_in_use_is_refused_before_the_work(make_distorted, tmp_path):
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    with pytest.raises(SceneError, match="expected a new or empty folder"):
        undistort(scene, tmp_path)


def test_a_mask_that_ignores_nothing_stays(make_distorted, tmp_path):
    """Else some images of a period had masks and some had none, which nerfstudio refuses."""
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, CAMERAS["OPENCV"]))
    for frame in scene.frames:
        mask = scene.root / mask_place(frame.name)
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", SIZE, 255).save(mask)
    new = undistort(read_scene(scene.root), tmp_path / "out").scene
    assert list(new.masks) == [frame.name for frame in scene.frames]
    mask = np.asarray(Image.open(new.masks["b/1.png"]))
    assert mask.shape[::-1] == new.frames[0].camera.size and mask.all()


@pytest.mark.parametrize("distorted", [True, False])
def test_masks_are_resampled_or_copied_with_their_images(make_distorted, tmp_path, distorted):
    """One photo has a mask file, one has alpha, which only its own file can keep."""
    params = CAMERAS["OPENCV"] if distorted else (*CAMERAS["OPENCV"][:4], 0.0, 0.0, 0.0, 0.0)
    scene = make_distorted(Camera(1, "OPENCV", *SIZE, params))
    values = np.full(SIZE[::-1], 255, np.uint8)
    values[60:120, 80:160] = 0
    (scene.root / "masks/a").mkdir(parents=True)
    Image.fromarray(values).save(scene.root / "masks/a/0.png.png")
    clear = scene.image_path(scene.frames[1])
    pixels = np.array(Image.open(clear))
    Image.fromarray(np.dstack([pixels, values])).save(clear)
    scene = read_scene(scene.root)
    new = undistort(scene, tmp_path / "out").scene
    assert new.masks == read_scene(tmp_path / "out").masks
    store = ImageStore(new)
    masks = [store.load_mask(frame) for frame in new.frames]
    np.testing.assert_array_equal(masks[0], masks[1])
    assert masks[2] is None
    if not distorted:
        assert list(new.masks) == ["a/0.png"]
        np.testing.assert_array_equal(masks[0], values != 0)
        return
    assert list(new.masks) == ["a/0.png", "a/1.png"]
    assert Image.open(new.masks["a/0.png"]).mode == "L"
    # Centres of what was ignored, and of what is by the places that the new pixels look at.
    x, y = sampling_map(CameraChange(scene.frames[0].camera, new.frames[0].camera))
    outside = (x < 77) | (x > 163) | (y < 57) | (y > 123)
    inside = (x > 80) & (x < 160) & (y > 60) & (y < 120)
    assert masks[0][outside].all() and not masks[0][inside].any()
