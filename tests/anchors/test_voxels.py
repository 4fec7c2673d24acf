"""Voxels and neighbour distances."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.anchors.density import (
    COARSER,
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
from chronoscene.errors import ConfigError

cells = st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=30)


def test_a_cell_is_the_nearest_multiple_and_halves_go_to_even() -> None:
    points = torch.tensor([[0.24, 0.26, 0.75], [-0.25, 0.25, 1.25]])
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
    keys = pack_cells(torch.from_numpy(array)).numpy()
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


@pytest.mark.parametrize("unit", ["spacing", "training", "world"])
def test_voxels_that_64_bits_cannot_number_are_refused(grid: np.ndarray, unit: str) -> None:
    size = resolve_voxel_size(grid, 1e-16, unit, training_from_world=1.0)
    assert len(np.unique(pack_cells(cell_indices(torch.from_numpy(grid), size)))) == len(grid)
    with pytest.raises(ConfigError, match="voxel_size: expected at least 1e-18 of the largest"):
        resolve_voxel_size(grid, 1e-19, unit, training_from_world=1.0)


@pytest.fixture
def grid() -> np.ndarray:
    """Points two units apart. [125, 3]"""
    axis = np.arange(5) * 2.0
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


def test_the_limit_coarsens_the_voxel(grid: np.ndarray) -> None:
    anchors, size = initial_anchors(grid, 0.5, limit=60)
    assert 1 <= len(anchors) <= 60
    assert size > 2.0
    assert len(voxelize(grid, size / COARSER)) > 60, "it is no coarser than needed"
    everything, unchanged = initial_anchors(grid, 0.5, limit=125)
    assert (len(everything), unchanged) == (125, 0.5)


def test_median_spacing_ignores_an_outlier(grid: np.ndarray) -> None:
    assert median_spacing(np.concatenate([grid, [[1e6, 0, 0]]])) == 2.0
