"""Skeletons: valid scenes of exactly the size that was asked for."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data.skeletons.dataset import write_skeleton
from benchmarks.data.skeletons.tracks import LARGEST_RESIDUAL, LEAST_TRACK
from chronoscene.errors import SceneError
from chronoscene.formats import read_scene
from chronoscene.images.decoding import load_rgb
from chronoscene.scene import Scene
from chronoscene.statistics.counts import PAPER_COUNTS, count_scene
from chronoscene.validation.run import validate_scene

COUNTS = [(20, 700), (9, 300), (31, 1100)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("skeletons") / "place"
    write_skeleton(out, COUNTS, seed=3)
    return out


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return read_scene(folder)


def test_the_validator_finds_nothing_wrong(folder: Path) -> None:
    findings = validate_scene(folder, decode=True).findings
    assert [f for f in findings if f.severity != "info"] == []


def test_images_and_points_are_those_asked_for(scene: Scene) -> None:
    counted = count_scene(scene)
    assert [(p.images, p.points) for p in counted.periods] == COUNTS
    assert counted.points_without_period == 0
    assert [p.test for p in counted.periods] == [3, 2, 4]


def test_observations_are_projections(scene: Scene) -> None:
    points = scene.points
    of = np.repeat(np.arange(len(points)), np.diff(points.track_start))
    poses = scene.frame_poses[points.track_frame]
    local = np.einsum("nij,nj->ni", poses[:, :3, :3], points.xyz[of]) + poses[:, :3, 3]
    assert local[:, 2].min() > 1
    K = scene.frames[0].camera.K
    at = local[:, :2] / local[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    residual = np.linalg.norm(at - points.track_xy, axis=1)
    assert residual.max() < LARGEST_RESIDUAL + 1e-9
    assert 0.2 < residual.mean() < 0.3  # Rayleigh: 1.25 times the noise along an axis
    error = np.bincount(of, residual) / np.diff(points.track_start)
    np.testing.assert_allclose(points.error, error, atol=1e-9)
    size = [scene.frames[0].camera.width, scene.frames[0].camera.height]
    assert (points.track_xy >= 0).all() and (points.track_xy < size).all()


def test_tracks_are_as_long_as_those_of_real_scenes(scene: Scene) -> None:
    length = np.diff(scene.points.track_start)
    assert length.min() >= LEAST_TRACK
    assert 3.5 < length.mean() < 6
    shared = (scene.point_periods().sum(axis=1) > 1).mean()
    assert 0.15 < shared < 0.35


def test_images_have_the_cameras_size_and_differ(scene: Scene) -> None:
    images = [load_rgb(scene.image_path(f)) for f in scene.frames]
    assert {image.shape for image in images} == {(48, 64, 3)}
    assert len({image.tobytes() for image in images}) == len(images)


def digests(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_equal_arguments_give_equal_bytes(folder: Path, tmp_path: Path) -> None:
    write_skeleton(tmp_path / "same", COUNTS, seed=3)
    write_skeleton(tmp_path / "other", COUNTS, seed=4)
    same, other = digests(tmp_path / "same"), digests(tmp_path / "other")
    assert same == digests(folder)
    assert same.keys() == other.keys()
    assert same["sparse/0/points3D.bin"] != other["sparse/0/points3D.bin"]
    assert same["images/p00_00000.jpg"] != other["images/p00_00000.jpg"]


@pytest.mark.parametrize("counts", [[(3, 40)], [(3, 5), (3, 0)], [(4, 30)] * 9])
def test_extremes(tmp_path: Path, counts: list[tuple[int, int]]) -> None:
    write_skeleton(tmp_path / "s", counts)
    counted = count_scene(read_scene(tmp_path / "s"))
    assert [(p.images, p.points) for p in counted.periods] == counts


def test_a_folder_in_use_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match="new or empty"):
        write_skeleton(tmp_path, COUNTS)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


PAPER_TOTALS = (
    (2_682, 1_379_697),
    (2_404, 1_445_761),
    (2_605, 1_524_500),
    (1_200, 595_357),
    (8_891, 4_945_315),
)
"""The last row of the table as printed: images and points of periods 0 to 3, and of all."""


def test_counts_of_the_paper_add_up() -> None:
    sums = np.zeros((5, 2), int)
    for periods in PAPER_COUNTS.values():
        sums[: len(periods)] += np.array(periods)
        sums[4] += np.sum(periods, axis=0)
    assert [tuple(row) for row in sums.tolist()] == list(PAPER_TOTALS)
    assert sum(map(len, PAPER_COUNTS.values())) == 42
