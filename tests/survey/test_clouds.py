"""Points of a scene whose surfaces are known, and signed distances between two clouds."""

import logging
from dataclasses import fields

import numpy as np
import pytest
from surveyed import HIGH, LOW, ToyRun

from chronoscene.survey.cloud import PointCloud, dense_cloud, sparse_cloud
from chronoscene.survey.distances import measure_distances
from chronoscene.survey.grid import choose_grid
from chronoscene.survey.map_frame import map_frame
from chronoscene.survey.views import depth_views


def test_points_lie_on_ground_roof_and_facades(scene):
    frame = map_frame(scene, None)
    grid = choose_grid(scene, frame, 0.25)
    cloud = dense_cloud(list(depth_views(ToyRun(), scene, 1)), frame, grid)
    xyz = cloud.xyz
    on_box = ((xyz >= LOW - 1e-3) & (xyz <= HIGH + 1e-3)).all(axis=1)
    ground, roof = np.abs(xyz[:, 2]) < 1e-3, np.abs(xyz[:, 2] - 3) < 1e-3
    assert (ground | on_box).all()
    facade = on_box & ~roof & ~ground
    assert facade.sum() > 50 and roof.sum() > 100 and ground.sum() > 1000
    sides = np.abs(xyz[facade, None, :2] - np.stack([LOW, HIGH])[:, :2]).min(axis=(1, 2))
    assert sides.max() < 1e-3
    cells = np.floor(xyz / 0.25).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert np.nanmedian(cloud.spread[ground]) < 0.01
    assert (cloud.to_camera[:, 2] > 30).all()


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_photos_give_no_points(scene, count):
    frame = map_frame(scene, None)
    views = list(depth_views(ToyRun(), scene, 1))[:count]
    cloud = dense_cloud(views, frame, choose_grid(scene, frame, 0.25))
    assert len(cloud) == 0 and cloud.rgb.dtype == np.uint8


def test_sparse_points_of_a_period(scene):
    frame = map_frame(scene, None)
    both = [sparse_cloud(scene, period, frame) for period in (0, 1)]
    assert sum(map(len, both)) == len(scene.points)
    assert len(sparse_cloud(scene, 0, frame, alone=True)) == len(both[0])


def test_one_point_in_each_cube_however_far_one_lies_away():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 1, (400, 3))
    xyz[7], xyz[9] = [1e8, -1e8, 1e8], [1e8, -1e8, 1e8]
    cloud = PointCloud(xyz, np.zeros((400, 3), np.uint8), xyz, np.arange(400.0))
    made = cloud.thinned(0.25)
    _, first = np.unique(np.floor(xyz / 0.25), axis=0, return_index=True)
    np.testing.assert_array_equal(made.spread, np.sort(first))
    assert 7 in made.spread and 9 not in made.spread


def plane(normal, shift, seed):
    """A patch of 12 x 12 m, a quarter of which is shifted, seen from where the normal points."""
    rng = np.random.default_rng(seed)
    normal = np.asarray(normal, np.float64)
    places = rng.uniform(-6, 6, (6000, 2))
    xyz = places @ np.linalg.svd(normal[None])[2][1:] + [500, 900, 20]
    xyz += (rng.normal(0, 0.02, 6000) + shift * (places > 0).all(axis=1))[:, None] * normal
    towards = np.tile(40 * normal, (6000, 1))
    return PointCloud(xyz, np.zeros((6000, 3), np.uint8), towards, np.full(6000, 0.02))


@pytest.mark.parametrize(
    ("normal", "shift"), [((0, 0, 1), 0.4), ((1, 0, 0), -0.4), ((0, -1, 0), 0.4)]
)
def test_what_was_added_has_a_positive_distance(normal, shift):
    found = measure_distances(plane(normal, 0, 1), plane(normal, shift, 2), 0.2, 0.01)
    offsets = found.cores.xyz - [500, 900, 20]
    places = offsets @ np.linalg.svd(np.asarray(normal, np.float64)[None])[2][1:].T
    moved, still = (places > 0.6).all(axis=1), (places < -0.6).any(axis=1)
    significant = np.abs(found.values) > found.level
    assert np.median(found.values[moved]) == pytest.approx(shift, abs=0.02)
    assert significant[moved].mean() > 0.95 and significant[still].mean() < 0.05
    assert np.median(found.slope) == pytest.approx(0 if normal[2] else 90, abs=3)
    assert len(found.cores) == len(found.values) > 100


def test_the_level_of_detection_covers_points_that_are_not_independent():
    """Waves longer than a cylinder, which M3C2 takes for changes."""
    first, second = plane((0, 0, 1), 0, 1), plane((0, 0, 1), 0, 2)
    second.xyz[:, 2] += 0.1 * np.sin(second.xyz[:, 0]) * np.sin(second.xyz[:, 1])
    found = measure_distances(first, second, 0.2, 0.0)
    assert (np.abs(found.values) > found.level).mean() < 0.1


def test_the_level_of_detection_has_the_registration_in_it():
    levels = [
        np.median(measure_distances(plane((0, 0, 1), 0, 1), plane((0, 0, 1), 0, 2), 0.2, r).level)
        for r in (0.0, 0.05)
    ]
    assert levels[1] - levels[0] == pytest.approx(1.96 * 0.05, rel=0.2)


def test_nothing_is_logged_into_the_current_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    measure_distances(plane((0, 0, 1), 0, 1), plane((0, 0, 1), 0, 2), 0.2, 0.0)
    assert not capsys.readouterr().out
    logging.getLogger("py4dgeo").warning("nothing")
    assert not list(tmp_path.iterdir())


def test_few_points_give_a_reason():
    first, second = plane((0, 0, 1), 0, 1), plane((0, 0, 1), 0, 2)
    few = PointCloud(*(getattr(second, f.name)[:99] for f in fields(PointCloud)))
    assert measure_distances(first, few, 0.2, 0.0) == "6000 and 99 points are too few for surfaces"
