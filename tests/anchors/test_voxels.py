"""Voxels, neighbour distances, culling."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.anchors.visibility import visible_anchors
from chronoscene.anchors.voxels import (
    MIN_DISTANCE,
    cell_indices,
    initial_anchors,
    initial_log_scales,
    median_spacing,
    neighbour_distances,
    pack_cells,
    resolve_voxel_size,
    voxelize,
)
from chronoscene.methods import View
from chronoscene.rasterizer import NEAR_PLANE, rasterize

cells = st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=30)


def test_a_cell_is_the_nearest_multiple_and_halves_go_to_even() -> None:
    points = np.array([[0.24, 0.26, 0.75], [-0.25, 0.25, 1.25]])
    np.testing.assert_array_equal(cell_indices(points, 0.5), [[0, 1, 2], [0, 0, 2]])


def test_voxels_are_unique_and_keep_far_coordinates_apart() -> None:
    points = np.array([[1000.0, 0, 0], [1000.0001, 0, 0], [1000.002, 0, 0]])
    np.testing.assert_allclose(voxelize(points, 0.001)[:, 0], [1000.0, 1000.002], rtol=0, atol=1e-4)


def test_cells_of_the_box_rule_start_in_its_corner() -> None:
    points = np.array([[0.3, 0.3, 0.3], [1.3, 0.3, 0.3]])
    np.testing.assert_allclose(voxelize(points, 1.0, "box"), points, atol=1e-7)
    np.testing.assert_allclose(voxelize(points, 1.0, "zero"), np.round(points), atol=1e-7)


@given(cells, st.sampled_from([1, 2**40]))
def test_packed_cells_are_equal_exactly_where_the_cells_are(
    rows: list[tuple[int, int, int]], far: int
) -> None:
    array = np.array(rows, np.int64) * far
    keys = pack_cells(array)
    same_cell = (array[:, None] == array[None]).all(axis=2)
    np.testing.assert_array_equal(keys[:, None] == keys[None], same_cell)


def test_neighbour_distance_is_the_root_mean_square_of_three() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]])
    expected = np.sqrt([(1 + 4 + 16) / 3, (1 + 1 + 9) / 3, (1 + 4 + 4) / 3, (4 + 9 + 16) / 3])
    np.testing.assert_allclose(neighbour_distances(points), expected)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_anchors_still_have_a_finite_scale(count: int) -> None:
    anchors = np.arange(3.0 * count).reshape(count, 3)
    assert np.isfinite(initial_log_scales(anchors)).all()
    if count > 1:
        np.testing.assert_allclose(neighbour_distances(anchors).min(), np.sqrt(27.0))


def test_coinciding_points_get_the_lower_bound() -> None:
    np.testing.assert_allclose(neighbour_distances(np.ones((5, 3))), MIN_DISTANCE)


def test_voxel_units(grid: np.ndarray) -> None:
    size = {
        unit: resolve_voxel_size(grid, 0.5, unit, training_from_world=0.1)
        for unit in ("spacing", "training", "world")
    }
    assert size == pytest.approx({"spacing": 1.0, "training": 0.5, "world": 0.05})
    # Every inner point of the grid has three neighbours at distance 2: the mean square is 4.
    assert resolve_voxel_size(grid, 0.0, "world", training_from_world=0.1) == pytest.approx(4.0)


@pytest.fixture
def grid() -> np.ndarray:
    """Points two units apart. [125, 3]"""
    axis = np.arange(5) * 2.0
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


def test_the_limit_coarsens_the_voxel(grid: np.ndarray) -> None:
    anchors, size = initial_anchors(grid, 0.5, limit=60)
    assert 1 <= len(anchors) <= 60
    assert size > 2.0
    everything, unchanged = initial_anchors(grid, 0.5, limit=125)
    assert (len(everything), unchanged) == (125, 0.5)


def test_median_spacing_ignores_an_outlier(grid: np.ndarray) -> None:
    assert median_spacing(np.concatenate([grid, [[1e6, 0, 0]]])) == 2.0


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_anchor_that_the_rasterizer_would_draw_is_decoded(seed: int) -> None:
    generator = np.random.default_rng(seed)
    anchors = generator.normal(0.0, 3.0, (200, 3)).astype(np.float32)
    log_scales = np.log(generator.uniform(0.001, 1.0, (200, 6))).astype(np.float32)
    K = np.array([[30.0, 0, 17.3], [0, 32.0, 9.1], [0, 0, 1]])
    view = View(K=K, width=40, height=24, cam_from_world=np.eye(4))
    raster = rasterize(
        torch.from_numpy(anchors),
        torch.tensor([[1.0, 0, 0, 0]]).expand(200, 4),
        torch.from_numpy(np.exp(log_scales[:, :3])),
        torch.full((200,), 0.999),
        torch.ones(200, 1),
        torch.eye(4)[None],
        torch.from_numpy(K.astype(np.float32))[None],
        40,
        24,
        backend="reference",
    )
    drawn = np.flatnonzero((raster.info.radii[0] > 0).all(dim=1).numpy())
    visible = visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE)
    assert set(drawn) <= set(visible)
    assert len(visible) - len(drawn) <= 10  # the two bounds round differently


def test_the_frustum_rule_asks_for_the_centre() -> None:
    K = np.array([[10.0, 0, 5], [0, 10.0, 5], [0, 0, 1]])
    view = View(K=K, width=10, height=10, cam_from_world=np.eye(4))
    anchors = np.array([[0, 0, 1], [0.6, 0, 1], [0, 0, -1], [0, 0, 0.005]], np.float32)
    log_scales = np.full((4, 6), np.log(0.2), np.float32)
    np.testing.assert_array_equal(
        visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE), [0, 1]
    )
    np.testing.assert_array_equal(
        visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE, by="frustum"), [0]
    )
