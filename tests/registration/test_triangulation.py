"""Points at known poses: their number, their accuracy against the true depth, and refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.edit import Edits, edit
from chronoscene.errors import RegistrationError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene
from chronoscene.images.truth import load_depth
from chronoscene.registration.features.pairs import posed_pairs
from chronoscene.registration.reconstruct.estimation import without_twins
from chronoscene.registration.triangulation import Triangulated, triangulate
from chronoscene.scene import Points, Scene
from chronoscene.scene.cameras import project_points
from chronoscene.scene.geometry import pose_from_rotation_translation
from chronoscene.scene.tracks import reproject
from chronoscene.validation.run import validate_scene


@pytest.fixture(scope="module")
def bare(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half of the images of a generated city, without points; blanks in a name are allowed."""
    out = tmp_path_factory.mktemp("bare") / "scene"
    names = [f.name for f in truth.frames]
    few = replace(truth, points=Points.empty())
    edit(few, out, Edits(keep=tuple(names[::2]), rename={names[0]: "a photo.jpg"}))
    return out


@pytest.fixture(scope="module")
def done(bare: Path) -> tuple[Path, Triangulated]:
    out = bare.with_name("out")
    steps: set[str] = set()
    model = bare / our_format.MODEL
    result = triangulate(
        read_scene(bare), out, threads=1, model=model, report=lambda what, *_: steps.add(what)
    )
    assert {"features", "pairs", "triangulate", "images"} <= steps
    return out, result


def test_a_scene_with_points_comes_out_and_nothing_else_changes(
    bare: Path, done: tuple[Path, Triangulated]
) -> None:
    old, new = read_scene(bare), read_scene(done[0])
    assert len(new.points) > 150
    assert len(np.unique(new.points.rgb, axis=0)) > 100
    assert (new.point_periods().sum(axis=1) > 1).sum() > 20
    for a, b in zip(old.frames, new.frames, strict=True):
        assert a.cam_from_world.tobytes() == b.cam_from_world.tobytes()
        assert (a.name, a.camera, a.period, a.split) == (b.name, b.camera, b.period, b.split)
    assert (old.periods, old.world) == (new.periods, new.world)
    assert not [f for f in validate_scene(done[0]).findings if f.severity == "error"]
    assert not bare.with_name("out.triangulation").exists()
    assert done[1].agreeing > 0.8 * done[1].matches


def test_points_project_to_where_they_were_found(done: tuple[Path, Triangulated]) -> None:
    scene = read_scene(done[0])
    points = scene.points
    views = [(f.camera, f.cam_from_world) for f in scene.frames]
    found = reproject(views, points.xyz, points.track_start, points.track_frame, points.track_xy)
    errors = np.concatenate([error for _, error, _ in found])
    assert np.isfinite(errors).all() and np.median(errors) < 0.5 and errors.max() < 6
    assert len(without_twins(points)) == len(points)


def test_points_lie_on_the_true_surfaces(done: tuple[Path, Triangulated], truth: Scene) -> None:
    scene, errors = read_scene(done[0]), []
    for i, frame in enumerate(scene.frames):
        depth = load_depth(truth.root / "gt", frame.name, None)
        if depth is None:
            continue
        rows = np.flatnonzero(scene.points.track_frame == i)
        point = np.repeat(np.arange(len(scene.points)), np.diff(scene.points.track_start))[rows]
        pose = frame.cam_from_world
        local = scene.points.xyz[point] @ pose[:3, :3].T + pose[:3, 3]
        u, v = project_points(frame.camera, local).astype(int).T
        height, width = depth.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        true = depth[v[inside], u[inside]]
        errors.append(np.abs(local[inside, 2] / np.where(true > 0, true, np.nan) - 1))
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    assert len(error) > 30
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.9) < 0.05  # edges of roofs have two depths


@pytest.mark.slow
def test_poses_of_other_photos_are_refused(bare: Path, tmp_path: Path) -> None:
    scene = read_scene(bare)
    turned = scene.frames[1:] + scene.frames[:1]
    frames = [
        replace(f, cam_from_world=g.cam_from_world)
        for f, g in zip(scene.frames, turned, strict=True)
    ]
    few = scene.with_frames(frames)
    few = replace(few, frames=few.frames[:3])
    with pytest.raises(RegistrationError, match=r"at least 50 points, found \d+: \d+ of") as caught:
        triangulate(few, tmp_path / "out", threads=1)
    assert "chronoscene validate --decode" in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_photos_that_were_corrected_are_looked_at_again(bare: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "scene", tmp_path / "out"
    scene = read_scene(bare)
    some = [f.name for f in scene.frames if f.period == 0][:4]
    edit(scene, folder, Edits(keep=tuple(some)))
    photos = [folder / "images" / name for name in some]
    right = [photo.read_bytes() for photo in photos]
    agreeing = []
    for contents in (right[1:] + right[:1], right):
        for photo, data in zip(photos, contents, strict=True):
            photo.write_bytes(data)
        # What only two of so few photos have in common is no point.
        with pytest.raises(RegistrationError, match=r"found \d+: \d+ of \d+ matches") as caught:
            triangulate(read_scene(folder), out, threads=1)
        agreeing.append(int(str(caught.value).split(": ")[2].split()[0]))
    assert agreeing[1] > 3 * agreeing[0]


def test_files_of_another_size_and_single_images_are_refused(bare: Path, tmp_path: Path) -> None:
    scene = read_scene(bare)
    with pytest.raises(RegistrationError, match="expected two images or more, found 1"):
        triangulate(replace(scene, frames=scene.frames[:1]), tmp_path / "out")
    camera = replace(scene.frames[0].camera, width=800)
    frames = [replace(f, camera=camera) for f in scene.frames]
    with pytest.raises(SceneError, match="of its camera, 800 x 300, found 400 x 300"):
        triangulate(scene.with_frames(frames), tmp_path / "out")


def test_neighbours_look_the_same_way_in_every_period() -> None:
    count = 80
    poses = np.stack([pose_from_rotation_translation(np.eye(3), [-i, 0, 0]) for i in range(count)])
    back = np.diag([-1.0, 1.0, -1.0])
    poses[1] = pose_from_rotation_translation(back, back @ [-1, 0, 0])
    periods = np.arange(count) % 2
    pairs = posed_pairs(poses, periods)
    assert not any(1 in pair for pair in pairs)
    near = {j - i for i, j in pairs}
    assert {1, 2, 3} <= near and max(near) < 40
    assert max(j - i for i, j in pairs if 30 < i < 40) <= 14
