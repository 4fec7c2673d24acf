"""Pictures of the viewer are those of the runs: sides, fading periods, colours, depth."""

from dataclasses import replace

import numpy as np
import pytest

from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view.paths import KeyView
from chronoscene.harness.view.pictures import Side, color_depth, draw_picture, neighbours
from chronoscene.scene import Camera

SIZE = (48, 32)
FOV = 2 * np.arctan(16 / 40)
CAMERA = Camera(1, "SIMPLE_PINHOLE", 48, 32, (40.0, 24.0, 16.0))


@pytest.fixture(scope="module")
def runs(trained):
    return {name: open_run(folder) for name, folder in trained.items()}


@pytest.fixture
def view(runs):
    pose = runs["chronogs"].scene().frames[0].cam_from_world
    return KeyView(pose, FOV, 0.0)


def draw(view, *sides, pixels=48 * 32, **options):
    return draw_picture(view, SIZE, sides, pixels, **options)


def test_a_picture_is_that_of_the_run(runs, view):
    run = runs["chronogs"]
    rgb, depth = draw(view, Side(run, 0.5, 1.0))
    expected = run.render(CAMERA, view.pose, 0.5, appearance_period=1.0)
    assert np.abs(rgb - expected.rgb).max() < 1e-5
    assert np.isinf(depth[expected.depth == 0]).all()
    assert np.allclose(depth[expected.depth > 0], expected.depth[expected.depth > 0])


def test_a_method_of_whole_periods_fades_between_finished_pictures(runs, view):
    run = runs["4dgs"]
    assert not run.is_continuous and run.distinguishes_periods
    first, last = (run.render(CAMERA, view.pose, period) for period in (0, 1))
    rgb, depth = draw(view, Side(run, 0.25))
    assert np.abs(rgb - (0.75 * first.rgb + 0.25 * last.rgb)).max() < 1e-5
    assert np.abs(first.rgb - last.rgb).max() > 0.01
    surface = first.depth > 0
    assert np.allclose(depth[surface], first.depth[surface])


def test_weights_of_neighbours(runs):
    assert neighbours(runs["chronogs"], 0.3) == [(0.3, 1.0)]
    assert neighbours(runs["4dgs"], 1) == [(1, 1.0)]
    assert neighbours(runs["4dgs"], 0.75) == [(0, 0.25), (1, 0.75)]
    joint = runs["chronogs"]
    pooled = replace(joint, record=joint.record.model_copy(update={"strategy": "pooled"}))
    assert neighbours(pooled, 0.75) == [(0, 1.0)]  # one picture, as all are the same
    assert joint.separates_appearance and not pooled.separates_appearance


def test_each_side_has_its_period_and_method(runs, view):
    sides = Side(runs["chronogs"], 0), Side(runs["3dgs-period"], 1)
    rgb, depth = draw(view, *sides, wipe=0.25)
    left, right = (s.run.render(CAMERA, view.pose, s.period).rgb for s in sides)
    assert np.abs(rgb[:, :11] - left[:, :11]).mean() < 0.01  # measured: below 1e-6
    assert (rgb[:, 11] == 1).all()
    assert np.abs(rgb[:, 12:] - right[:, 12:]).mean() < 0.01
    assert np.abs(left - right).mean() > 0.05
    assert depth.shape == (32, 48)


@pytest.mark.parametrize("wipe", [0.0, 1.0])
def test_a_wipe_to_the_edge_leaves_one_side(runs, view, wipe):
    sides = Side(runs["chronogs"], 0), Side(runs["3dgs-period"], 1)
    alone, _ = draw(view, sides[0] if wipe else sides[1])
    assert np.array_equal(draw(view, *sides, wipe=wipe)[0], alone)


def test_few_pixels_keep_the_shape(runs, view):
    rgb, depth = draw(view, Side(runs["chronogs"], 0), pixels=24 * 16)
    assert rgb.shape == (16, 24, 3) and depth.shape == (16, 24)


def test_near_is_light_and_no_surface_is_black():
    depth = np.tile(np.linspace(1, 5, 100), (4, 1))
    depth[0] = np.inf
    colors = color_depth(depth)
    assert (colors[0] == 0).all()
    assert colors[1, 0].sum() > colors[1, 50].sum() > colors[1, -1].sum() > 0
    assert (color_depth(np.full((2, 2), np.inf)) == 0).all()
