"""Growth and pruning on cases worked out by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.density import AnchorRows, DensityStatistics, grow, prune_mask
from chronoscene.errors import ConfigError
from chronoscene.methods import build_config, load_spec

CONFIG = AnchorConfig(random_growth=False)


both_codes = pytest.mark.usefixtures("both_codes")


def grown(
    arrays: AnchorRows,
    statistics: DensityStatistics,
    config: AnchorConfig = CONFIG,
    *,
    voxel_size: float = 0.001,
    seed: int = 0,
) -> AnchorRows:
    return grow(arrays, statistics, config, voxel_size, np.random.default_rng(seed))


def arrays_of(positions: list[list[float]], features: list[list[float]]) -> AnchorRows:
    """One anchor in the origin cell with one Gaussian per position: offset scale 1."""
    count = len(positions)
    return AnchorRows(
        anchors=torch.zeros(count, 3),
        offsets=torch.tensor(positions)[:, None],
        log_scales=torch.zeros(count, 6),
        features=torch.tensor(features),
    )


def statistics_of(gradients: list[float], hits: float) -> DensityStatistics:
    statistics = DensityStatistics(len(gradients), 1)
    statistics.hits[:, 0] = hits
    statistics.grad_sum[:, 0] = torch.tensor(gradients) * hits
    return statistics


def sizes(new_log_scales: torch.Tensor) -> list[float]:
    return sorted(new_log_scales[:, 0].double().exp().round(decimals=6).tolist(), reverse=True)


@pytest.mark.parametrize(
    ("gradient", "levels"), [(1e-4, 0), (3e-4, 1), (5e-4, 2), (7e-4, 2), (9e-4, 3)]
)
def test_larger_gradients_reach_finer_levels(gradient: float, levels: int) -> None:
    """Each level finds its own free cell: 16, 4 and 1 voxels away from the anchors."""
    arrays = arrays_of([[0.5, 0.0062, 0.0]], [[1.0]])
    new = grown(arrays, statistics_of([gradient], 41))
    # The Gaussian's cells at 0.016, 0.004 and 0.001 are three different ones.
    assert sizes(new.log_scales) == [0.016, 0.004, 0.001][:levels]


def test_levels_end_where_their_threshold_is_no_number() -> None:
    arrays = arrays_of([[0.5, 0.0062, 0.0]], [[1.0]])
    most = dataclasses.replace(CONFIG, growth_levels=1_024)
    assert len(grown(arrays, statistics_of([9e-4], 41), most).anchors) == 3
    with pytest.raises(ConfigError, match="growth_levels: expected a value less than or equal to"):
        build_config(load_spec("chronogs"), preset="fast", overrides={"growth_levels": 1_025})


def test_a_gaussian_needs_more_than_forty_hits() -> None:
    arrays = arrays_of([[0.5, 0.0, 0.0]], [[1.0]])
    assert len(grown(arrays, statistics_of([9e-4], 40)).anchors) == 0
    assert len(grown(arrays, statistics_of([9e-4], 41)).anchors) > 0


def test_nothing_at_the_coarsest_level_means_nothing_at_all() -> None:
    # The coarse cell holds the anchor in the origin, the cells of 0.004 do not.
    arrays = arrays_of([[0.0062, 0.0, 0.0]], [[1.0]])
    statistics = statistics_of([9e-4], 41)
    assert len(grown(arrays, statistics).anchors) == 0
    unchained = dataclasses.replace(CONFIG, chained_levels=False)
    statistics = statistics_of([9e-4], 41)
    new = grown(arrays, statistics, unchained)
    assert sizes(new.log_scales) == [0.004, 0.001]


def test_a_new_anchor_sits_in_its_cell_with_the_largest_features_of_its_parents() -> None:
    arrays = arrays_of([[0.501, 0, 0], [0.499, 0, 0]], [[1.0, -5.0], [-2.0, 3.0]])
    one_level = dataclasses.replace(CONFIG, growth_levels=1)
    statistics = statistics_of([3e-4, 3e-4], 41)
    new = grown(arrays, statistics, one_level)
    cell = np.round(0.5 / 0.016) * 0.016
    np.testing.assert_allclose(new.anchors, [[cell, 0, 0]], rtol=1e-6)
    np.testing.assert_array_equal(new.features, [[1.0, 3.0]])
    np.testing.assert_allclose(new.log_scales, np.full((1, 6), np.log(0.016)), rtol=1e-6)


def test_offsets_count_in_units_of_the_anchor() -> None:
    log_scales = torch.full((1, 6), float(np.log(0.32)))
    arrays = arrays_of([[1.0, 0, 0]], [[1.0]])._replace(log_scales=log_scales)
    rules = dataclasses.replace(CONFIG, growth_levels=1)
    new = grown(arrays, statistics_of([3e-4], 41), rules)
    np.testing.assert_allclose(new.anchors, [[0.32, 0, 0]], rtol=1e-6)


def test_only_judged_gaussians_lose_their_counters() -> None:
    arrays = arrays_of([[0.5, 0, 0], [0.6, 0, 0]], [[1.0], [1.0]])
    statistics = statistics_of([1e-4, 1e-4], 41)
    statistics.hits[1], statistics.grad_sum[1] = 40, 1.0
    grown(arrays, statistics)
    assert statistics.hits[:, 0].tolist() == [0.0, 40.0]
    assert statistics.grad_sum[:, 0].tolist() == [0.0, 1.0]


def test_the_random_masks_keep_more_at_finer_levels() -> None:
    count = 4000
    # 0.0062 lies in other cells at every level, so no level takes the place of the next.
    positions = [[0.5 + 0.1 * i, 0.0062, 0.0] for i in range(count)]
    arrays = arrays_of(positions, [[0.0]] * count)
    rules = dataclasses.replace(CONFIG, random_growth=True)
    new = grown(arrays, statistics_of([9e-4] * count, 41), rules)
    edges, counts = np.unique(sizes(new.log_scales), return_counts=True)
    shares = dict(zip(edges.tolist(), (counts / count).tolist(), strict=True))
    expected = {0.016: 0.5, 0.004: 0.75, 0.001: 0.875}
    assert shares == pytest.approx(expected, abs=0.03)


def test_growth_stops_at_the_limit_and_repeats_with_the_seed() -> None:
    arrays = arrays_of([[0.5 + 0.1 * i, 0, 0] for i in range(50)], [[0.0]] * 50)
    limited = dataclasses.replace(CONFIG, max_anchors=57)
    runs = [grown(arrays, statistics_of([9e-4] * 50, 41), limited, seed=3) for _ in range(2)]
    assert len(runs[0].anchors) == 7
    np.testing.assert_array_equal(runs[0].anchors, runs[1].anchors)


@pytest.mark.parametrize(
    ("visits", "opacity_sum", "kept"), [(81, 0.404, False), (81, 0.406, True), (80, 0.0, True)]
)
def test_faint_anchors_are_pruned(visits: float, opacity_sum: float, kept: bool) -> None:
    statistics = DensityStatistics(1, 2)
    statistics.visits[0], statistics.opacity_sum[0] = visits, opacity_sum
    assert prune_mask(statistics, CONFIG).tolist() == [kept]
    assert statistics.visits[0] == (80 if visits == 80 else 0)


def test_the_paper_prunes_anchors_that_do_not_move() -> None:
    statistics = DensityStatistics(2, 1)
    statistics.visits[:], statistics.opacity_sum[:] = 100, 50.0
    statistics.motion[:] = torch.tensor([0.0, 1.0])
    rules = dataclasses.replace(CONFIG, prune_by="gradient")
    assert prune_mask(statistics, rules).tolist() == [False, True]


@both_codes
def test_statistics_of_a_view() -> None:
    statistics = DensityStatistics(3, 2)
    positions = torch.tensor([0, 2, 3])  # the second Gaussian of the first anchor is off
    opacities = torch.tensor([0.5, 0.25, 0.5])
    radii = torch.tensor([[1, 1], [0, 4], [2, 2]], dtype=torch.int32)
    grads = torch.tensor([[3e-3, 4e-3], [9.0, 9.0], [0.0, 1e-3]])
    statistics.update(torch.tensor([0, 2]), positions, opacities, radii, grads, 20, 40)
    np.testing.assert_array_equal(statistics.visits, [1, 0, 1])
    np.testing.assert_allclose(statistics.opacity_sum, [0.5, 0, 0.75])
    # Gradients count in half images: 10 pixels across, 20 down. Off or culled ones do not count.
    np.testing.assert_array_equal(statistics.hits, [[1, 0], [0, 0], [0, 1]])
    np.testing.assert_allclose(
        statistics.grad_sum, [[np.hypot(0.03, 0.08), 0], [0, 0], [0, 0.02]], rtol=1e-6
    )


@both_codes
def test_a_view_does_not_count_for_anchors_in_what_its_mask_ignores() -> None:
    """No visit of the anchor; a Gaussian of it that lies elsewhere is hit all the same."""
    statistics = DensityStatistics(2, 2)
    positions, opacities = torch.arange(4), torch.full((4,), 0.5)
    radii = torch.tensor([[1, 1], [0, 0], [2, 2], [2, 2]], dtype=torch.int32)
    grads = torch.full((4, 2), 1e-3)
    counted = torch.tensor([False, True])
    statistics.update(torch.arange(2), positions, opacities, radii, grads, 2, 2, counted)
    assert statistics.visits.tolist() == [0, 1] and statistics.opacity_sum.tolist() == [0, 1]
    assert statistics.motion[0] == 0 and statistics.motion[1] > 0
    assert statistics.hits.tolist() == [[1, 0], [1, 1]]


@both_codes
def test_statistics_of_many_anchors() -> None:
    """As counted one by one, whatever the anchors that a task takes together."""
    rng = np.random.default_rng(0)
    anchors, k = 1_700, 3
    visible = np.flatnonzero(rng.random(anchors) < 0.9)
    positions = np.flatnonzero(rng.random(len(visible) * k) < 0.3)
    count = len(positions)
    opacities = rng.random(count, dtype=np.float32)
    radii = rng.integers(0, 2, (count, 2)).astype(np.int32)
    grads = rng.normal(size=(count, 2)).astype(np.float32)
    statistics = DensityStatistics(anchors, k)
    arrays = (visible, positions, opacities, radii, grads)
    statistics.update(*map(torch.from_numpy, arrays), 2, 2)
    seen = radii.min(axis=1) > 0
    owner = visible[positions // k]
    norms = np.hypot(grads[:, 0], grads[:, 1])
    np.testing.assert_array_equal(statistics.visits, np.isin(np.arange(anchors), visible))
    np.testing.assert_allclose(
        statistics.opacity_sum, np.bincount(owner, opacities, anchors), rtol=1e-6
    )
    np.testing.assert_allclose(
        statistics.motion, np.bincount(owner[seen], norms[seen], anchors), rtol=1e-6
    )
    expected = np.zeros((anchors, k))
    expected[owner[seen], positions[seen] % k] = norms[seen]
    np.testing.assert_allclose(statistics.grad_sum, expected, rtol=1e-6)
    np.testing.assert_array_equal(statistics.hits, expected > 0)


def test_counters_follow_their_anchors() -> None:
    statistics = DensityStatistics(3, 2)
    statistics.visits[:] = torch.tensor([1.0, 2.0, 3.0])
    statistics.extend(1)
    statistics.keep(torch.tensor([True, False, True, True]))
    assert statistics.visits.tolist() == [1, 3, 0]
    assert statistics.hits.shape == (3, 2)
