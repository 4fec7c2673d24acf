"""Stored models make the scene that they were taken of, with the photos."""

from dataclasses import replace

import numpy as np
import pytest

from chronoscene.errors import SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.undistort import undistort
from leaderboard import photo_scenes, scenes
from leaderboard.photo_scenes import make_scene, save_model
from leaderboard.scenes import fixed_scenes, main

IMAGES = {"a/0.png": 0, "a/1.png": 0, "b/0.png": 1, "b/1.png": 1}


@pytest.fixture
def distorted(make_scene_folder):
    """A scene of one camera with distortion; single precision holds its points."""
    scene = read_scene(make_scene_folder(IMAGES, tests=["b/1.png"]))
    pinhole = scene.frames[0].camera
    params = (pinhole.K[0, 0], pinhole.K[0, 2], pinhole.K[1, 2], 0.05)
    camera = replace(pinhole, model="SIMPLE_RADIAL", params=tuple(map(float, params)))
    points = replace(scene.points, xyz=scene.points.xyz.astype(np.float32).astype(np.float64))
    frames = tuple(replace(frame, camera=camera) for frame in scene.frames)
    return replace(scene, frames=frames, points=points)


def test_a_model_and_photos_make_the_scene_again(distorted, tmp_path):
    save_model(distorted, tmp_path / "place.npz")
    make_scene(tmp_path / "place.npz", distorted.images_root, tmp_path / "again")
    undistort(distorted, tmp_path / "directly", threads=1)
    again, directly = (read_scene(tmp_path / name) for name in ("again", "directly"))
    assert scene_hash(again) == scene_hash(directly)
    assert again.frames[0].camera.is_pinhole
    assert [f.split for f in again.frames] == [f.split for f in distorted.frames]
    assert again.periods == distorted.periods


def test_a_missing_photo_is_named(distorted, tmp_path):
    save_model(distorted, tmp_path / "place.npz")
    (distorted.images_root / "b/0.png").unlink()
    with pytest.raises(SceneError, match=r"b/0\.png: expected a photo of again, found no such"):
        make_scene(tmp_path / "place.npz", distorted.images_root, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_the_command_takes_the_photos(distorted, tmp_path, monkeypatch, capsys):
    save_model(distorted, tmp_path / "place.npz")
    monkeypatch.setattr(scenes, "MODELS", tmp_path)
    fixed = replace(fixed_scenes()["ranking-stone-bench"], made="give --photos")
    monkeypatch.setattr(scenes, "fixed_scenes", lambda: {"place": fixed})
    folder = tmp_path / "new"
    assert main([str(folder), "place"]) == 1
    assert "found nothing there; give --photos" in capsys.readouterr().err
    assert main([str(folder), "place", "--photos", str(distorted.images_root)]) == 1
    assert "make it again in another folder" in capsys.readouterr().err  # another scene
    assert read_scene(folder / "place").num_periods == 2


def test_the_models_of_the_table_are_there():
    stored = {path.stem for path in photo_scenes.MODELS.iterdir()}
    assert stored <= {*fixed_scenes()}


def test_the_bench_is_the_one_of_the_table(shared_data, tmp_path):
    photos = shared_data / "stone_bench"
    if not photos.is_dir():
        pytest.skip("no photos of the stone bench")
    name = "ranking-stone-bench"
    assert main([str(tmp_path), name, "--photos", str(photos)]) == 0
