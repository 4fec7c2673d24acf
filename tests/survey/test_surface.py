"""Maps of a scene whose heights are known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_erosion as erode
from surveyed import CAMERA, HIGH, LOW, ROOF, ToyRun, render

from chronoscene.errors import ConfigError
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.methods import Prediction
from chronoscene.survey.grid import choose_grid, natural_resolution
from chronoscene.survey.map_frame import map_frame
from chronoscene.survey.surface import TILE, camera_above, check_heights, map_surface
from chronoscene.survey.views import DepthView, depth_views, look, solid_depth


def surface_of(scene, period, resolution=0.5, views=None, noise=0.0):
    frame = map_frame(scene, None)
    grid = choose_grid(scene, frame, resolution)
    if views is None:
        views = list(depth_views(ToyRun(noise=noise), scene, period))
    return grid, map_surface(partial(render, period=period, noise=noise), views, frame, grid)


def on_roof(grid):
    east, north = np.moveaxis(grid.centres, 2, 0)
    return (east > LOW[0]) & (east < HIGH[0]) & (north > LOW[1]) & (north < HIGH[1])


@pytest.mark.parametrize("resolution", [0.5, 0.1])
def test_each_cell_has_the_height_at_its_centre(scene, resolution):
    grid, surface = surface_of(scene, 1, resolution)
    assert max(grid.shape) > TILE or resolution == 0.5
    roof = on_roof(grid)
    assert roof.sum() == round(20 / resolution**2)
    np.testing.assert_allclose(surface.heights[roof], 3.0, atol=1e-3)
    known = np.isfinite(surface.heights)
    np.testing.assert_allclose(surface.heights[known & ~roof], 0.0, atol=1e-3)
    assert known.mean() > 0.9
    assert (surface.colors[roof] == np.round(ROOF * 255)).all()


def test_what_masks_ignore_is_not_known(scene):
    masks = {}
    for frame in scene.select(period=1)[2:]:  # two photos see everything
        camera, pose = frame.camera, frame.cam_from_world
        masks[frame.name] = scene.root / f"{frame.name}.mask.png"
        roof = (render(camera, pose, 1).rgb == ROOF.astype(np.float32)).all(axis=2)
        Image.fromarray(np.where(roof, 0, 255).astype(np.uint8)).save(masks[frame.name])
    scene = replace(scene, masks=masks)
    views = list(depth_views(ToyRun(), scene, 1))
    grid, surface = surface_of(scene, 1, views=views)
    inside = erode(on_roof(grid), iterations=2)  # far from pixels that count
    assert (surface.views[inside] == 2).all() and (surface.views[~on_roof(grid)] > 2).mean() > 0.9
    grid, surface = surface_of(scene, 1, views=views[1:])
    assert np.isnan(surface.heights[inside]).all()
    assert (views[0].depth > 0).all() and np.isinf(views[2].depth).any()


def test_metres_that_differ_between_east_and_north(scene):
    frame = replace(map_frame(scene, None), matrix=np.diag([1.01, 0.99, 1.0]))
    grid = choose_grid(scene, frame, 0.1)
    views = list(depth_views(ToyRun(), scene, 1))
    heights = map_surface(partial(render, period=1), views, frame, grid).heights
    places = np.dstack([grid.centres, np.zeros(grid.shape)]).reshape(-1, 3)
    east, north, _ = frame.to_world(places).T.reshape(3, *grid.shape)
    inside = np.minimum(
        np.minimum(east - LOW[0], HIGH[0] - east), np.minimum(north - LOW[1], HIGH[1] - north)
    )
    known = np.isfinite(heights) & (np.abs(inside) > 0.02)
    np.testing.assert_allclose(heights[known], np.where(inside > 0, 3.0, 0.0)[known], atol=1e-3)


def test_heights_are_compared_with_the_points_that_the_period_sees(scene):
    frame = map_frame(scene, None)
    grid, surface = surface_of(scene, 0)
    surface = replace(surface, heights=surface.heights - 0.25)
    seen = np.isfinite(surface.heights[grid.cells(scene.points.xyz[::2])]).sum()
    found = check_heights(surface, scene, 0, frame, grid)
    assert found["count"] == seen > 100
    assert found["median"] == pytest.approx(-0.25, abs=1e-3)
    assert found["nmad"] == pytest.approx(0, abs=1e-3)
    two_images = replace(scene, points=scene.points.select_observations(
        scene.points.track_frame % 16 != 5, np.arange(32, dtype=np.int32)
    ))  # fmt: skip
    assert check_heights(surface, two_images, 0, frame, grid) is None


def test_cells_are_those_below_the_places(scene):
    grid = choose_grid(scene, map_frame(scene, None), 0.5)
    row, column = grid.cells(np.array([[-8.99, 6.99, 0.0], [-8.4, 6.99, 0.0], [9.0, -7.0, 0.0]]))
    assert (list(row), list(column)) == ([0, 0, 27], [0, 1, 35])


def test_edges_are_multiples_of_the_resolution_around_the_points(scene):
    grid = choose_grid(scene, map_frame(scene, None), 0.5)
    assert (grid.left, grid.top, grid.width, grid.height) == (-9.0, 7.0, 36, 28)
    np.testing.assert_allclose(grid.centres[0, 0], [-8.75, 6.75])


def test_natural_resolution_is_that_of_a_pixel(scene):
    assert natural_resolution(scene, 1600) == pytest.approx(40 / 80, rel=0.05)
    assert natural_resolution(scene, 48) == pytest.approx(2 * natural_resolution(scene, 1600), 0.05)


def test_places_that_one_photo_sees_are_unknown(scene):
    views = list(depth_views(ToyRun(), scene, 0))
    assert np.isnan(surface_of(scene, 0, views=views[:1])[1].heights).all()
    surface = surface_of(scene, 0, views=views[:2])[1]
    assert (np.isfinite(surface.heights) == (surface.views == 2)).all()


def test_what_no_camera_sees_is_unknown(scene):
    """The photos of period 1 see no box: what the model shows there is seen by none."""
    views = list(depth_views(ToyRun(), scene, 0))
    grid, surface = surface_of(scene, 1, views=views)
    assert np.isnan(surface.heights[on_roof(grid)]).all()


def test_the_spread_is_the_standard_deviation_of_the_depths(scene):
    (view,) = list(depth_views(ToyRun(), scene, 0))[:1]
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[2, 3] = 40.0
    rng = np.random.default_rng(0)
    views = [
        DepthView(Viewpoint("", CAMERA, down, 0), np.full_like(view.depth, 40 + error), view.rgb)
        for error in rng.normal(0, 0.2, 400)
    ]
    places = np.column_stack([rng.uniform(-5, 5, (2000, 2)), np.zeros(2000)])
    count, spread = look(places, views, 0.05, up=np.array([0.0, 0.0, 1.0]))
    assert (count == 400).all()
    assert spread.mean() == pytest.approx(0.2, rel=0.1)
    assert np.isnan(look(places + 1000, views, 0.05)[1]).all()


def test_the_camera_is_far_enough_and_not_too_far(scene):
    frame = map_frame(scene, None)
    grid = choose_grid(scene, frame, 0.1)
    rows, columns = next(grid.tiles(TILE))
    camera, pose, altitude = camera_above(frame, grid, rows, columns)
    top = np.array([grid.left, grid.top, grid.high, 1.0])
    x, y, z = (pose @ top)[:3]
    at = camera.K @ np.array([x / z, y / z, 1])
    assert np.abs(at[:2]).max() == pytest.approx(0.1 / np.sqrt(2), rel=0.01)  # of a cell
    assert altitude * 2.0**-24 < 1e-4 * (grid.high - grid.low) / 2


def test_transparent_places_are_no_surface():
    depth = np.full((2, 2), 5.0, np.float32)
    alpha = np.array([[1, 0.5], [0.49, 0]], np.float32)
    found = solid_depth(Prediction(np.zeros((2, 2, 3), np.float32), alpha, depth))
    np.testing.assert_array_equal(found, [[5, 5], [np.inf, np.inf]])


def test_a_method_without_depth_is_refused():
    with pytest.raises(ConfigError, match="renders depth"):
        solid_depth(Prediction(np.zeros((2, 2, 3), np.float32)))


def test_too_many_cells(scene):
    with pytest.raises(ConfigError, match=r"at most 20,000,000 cells.*choose 0\.00") as raised:
        choose_grid(scene, map_frame(scene, None), 1e-3)
    advised = float(str(raised.value).split("choose ")[1].split()[0])
    choose_grid(scene, map_frame(scene, None), advised)
