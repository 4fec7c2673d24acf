"""What every dataset format must do. A new format adds a builder of its sample to conftest.py."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from chronoscene.convert import losses
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import (
    FORMATS,
    detect,
    load_format,
    match_format,
    read_scene,
    writable_formats,
)
from chronoscene.formats import chronoscene as our_format
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash


@pytest.fixture(params=sorted(FORMATS))
def sample(request, builders) -> tuple[str, Path]:
    """A format and the folder of its sample."""
    return request.param, builders[request.param]()


def snapshot(folder: Path) -> dict[str, tuple[int, str]]:
    """Change time and content of every file, and every folder."""
    return {
        str(p.relative_to(folder)): (
            p.stat().st_mtime_ns,
            hashlib.sha256(p.read_bytes()).hexdigest() if p.is_file() else "",
        )
        for p in sorted(folder.rglob("*"))
    }


def assert_equal_scenes(a: Scene, b: Scene) -> None:
    """Same frames, points, periods and world; poses to the last bits of a quaternion."""
    assert [(f.name, f.image_id, f.camera, f.period, f.split) for f in a.frames] == [
        (f.name, f.image_id, f.camera, f.period, f.split) for f in b.frames
    ]
    for x, y in zip(a.frames, b.frames, strict=True):
        np.testing.assert_allclose(x.cam_from_world, y.cam_from_world, rtol=1e-14, atol=1e-14)
    for field in ("ids", "xyz", "rgb", "error", "track_start", "track_frame", "track_xy"):
        np.testing.assert_array_equal(getattr(a.points, field), getattr(b.points, field), field)
    assert (a.periods, a.world, split_hash(a)) == (b.periods, b.world, split_hash(b))


def test_every_format_has_a_sample(builders):
    assert builders.keys() == FORMATS.keys()


def test_module_says_what_it_is(sample):
    name, _ = sample
    module = load_format(name)
    assert name == module.NAME
    assert module.MARKS


def test_exactly_one_format_matches(sample):
    name, folder = sample
    detected = detect(folder)
    assert (detected.name, detected.others) == (name, ())


def test_no_format_matches_an_empty_folder(tmp_path):
    assert match_format(tmp_path) is None


def test_frames(sample):
    name, folder = sample
    scene = read_scene(folder)
    names = [f.name for f in scene.frames]
    assert scene.format == name
    assert names == sorted(set(names))
    assert len({f.image_id for f in scene.frames}) == len(names)
    assert [p.id for p in scene.periods] == list(range(scene.num_periods))
    assert {f.period for f in scene.frames} == set(range(scene.num_periods))
    assert {f.split for f in scene.frames} == {"train", "test"}
    assert all(scene.image_path(f).is_file() for f in scene.frames)
    assert scene.split_rule


def test_poses_are_rigid_and_cameras_usable(sample):
    for frame in read_scene(sample[1]).frames:
        pose, K = frame.cam_from_world, frame.camera.K
        assert pose.shape == (4, 4) and pose.dtype == np.float64
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert pose[3].tolist() == [0, 0, 0, 1] and np.isfinite(pose).all()
        assert K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()
        assert frame.camera.width > 0 and frame.camera.height > 0


def test_tracks_are_in_range(sample):
    scene = read_scene(sample[1])
    points = scene.points
    count, observations = len(points), len(points.track_frame)
    assert points.ids.shape == points.error.shape == (count,)
    assert points.xyz.shape == points.rgb.shape == (count, 3)
    assert (points.xyz.dtype, points.rgb.dtype) == (np.float64, np.uint8)
    assert len(np.unique(points.ids)) == count
    assert points.track_start.shape == (count + 1,)
    assert points.track_start[0] == 0 and points.track_start[-1] == observations
    assert (np.diff(points.track_start) >= 0).all()
    assert points.track_xy.shape == (observations, 2)
    assert points.track_frame.dtype == np.int32
    assert ((points.track_frame >= 0) & (points.track_frame < len(scene.frames))).all()


def test_observations_reproject(sample):
    """Cameras, poses, points and tracks belong together: samples are free of noise."""
    scene = read_scene(sample[1])
    points = np.repeat(scene.points.xyz, np.diff(scene.points.track_start), axis=0)
    poses = scene.frame_poses[scene.points.track_frame]
    Ks = np.stack([f.camera.K for f in scene.frames])[scene.points.track_frame]
    x = np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
    pixels = np.einsum("nij,nj->ni", Ks, x)
    error = pixels[:, :2] / pixels[:, 2:] - scene.points.track_xy
    assert np.abs(error).max(initial=0) < 0.01


def test_reading_is_repeatable_and_leaves_no_trace(sample):
    _, folder = sample
    before = snapshot(folder)
    assert_equal_scenes(read_scene(folder), read_scene(folder))
    assert snapshot(folder) == before


@pytest.mark.parametrize("name", writable_formats())
def test_round_trip(builders, name, tmp_path):
    module, folder = load_format(name), builders[name]()
    scene, before = read_scene(folder), snapshot(folder)
    module.write(scene, tmp_path / "out")
    again = read_scene(tmp_path / "out", format=name)  # a name of its folder is the mark of wat
    assert again.format == name
    assert_equal_scenes(scene, again)
    assert snapshot(folder) == before
    for frame in scene.frames:
        assert again.image_path(frame).read_bytes() == scene.image_path(frame).read_bytes()


@pytest.mark.parametrize("target", writable_formats())
def test_converts_to_every_writable_format(sample, target, tmp_path):
    """Images, periods, poses and positions of points survive; of the rest, what is lost is said."""
    scene = read_scene(sample[1])
    load_format(target).write(scene, tmp_path / "out", image_source="symlink")
    again = read_scene(tmp_path / "out", format=target)
    lost = " ".join(losses(scene, target))
    assert again.format == target
    labels = [[period.label for period in s.periods] for s in (scene, again)]
    assert (labels[0] == labels[1]) == ("labels" not in lost)
    dates = [[period.date for period in s.periods] for s in (scene, again)]
    assert (dates[0] == dates[1]) == ("dates" not in lost)
    new = {again.image_path(frame).resolve(): frame for frame in again.frames}
    splits, names = [], []
    for old in scene.frames:
        frame = new.pop(scene.image_path(old).resolve())
        assert (frame.period, frame.image_id) == (old.period, old.image_id)
        assert frame.name.endswith((old.name, old.name.replace("/", "_")))
        np.testing.assert_allclose(frame.cam_from_world, old.cam_from_world, atol=1e-13)
        np.testing.assert_array_equal(frame.camera.K, old.camera.K)
        splits.append(frame.split == old.split)
        names.append(frame.name == old.name)
    assert not new
    assert all(splits) == ("split" not in lost) and all(names) == ("image names" not in lost)
    assert (again.world == scene.world) == ("reference system" not in lost)
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
    observed = len(again.points.track_xy) == len(scene.points.track_xy)
    assert observed == ("observations" not in lost)


def test_converts_to_our_format(sample, tmp_path):
    scene = read_scene(sample[1])
    our_format.write(scene, tmp_path / "out", image_source="link")
    assert_equal_scenes(scene, read_scene(tmp_path / "out"))


def test_an_empty_folder_is_our_error(sample, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ChronoSceneError):
        read_scene(empty)
    with pytest.raises(ChronoSceneError):
        read_scene(empty, format=sample[0])


@pytest.mark.parametrize("damage", ["half", "empty", "noise", "gone"])
def test_damage_is_our_error_or_harmless(sample, damage):
    """Each file beside the images in turn; nothing but our errors may come out."""
    _, folder = sample
    refused = 0
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix != ".png"]
    for path in files:
        original = path.read_bytes()
        noise = np.random.default_rng(0).bytes(len(original))
        broken = {"half": original[: len(original) // 2], "empty": b"", "noise": noise}
        if damage == "gone":
            path.unlink()
        else:
            path.write_bytes(broken[damage])
        try:
            read_scene(folder)
        except ChronoSceneError:
            refused += 1
        path.write_bytes(original)
    assert refused >= len(files) // 2
