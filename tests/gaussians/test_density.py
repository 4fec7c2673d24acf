"""One round of density control on cases worked out by hand."""

from dataclasses import replace

import numpy as np
import torch
from toy_scene import EXTENT

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.density import (
    GradientStatistics,
    choose_growth,
    densify,
    reset_opacities,
    scatter_in_space,
)
from chronoscene.gaussians.model import SHAPES, logit, opacities_of, scales_of
from chronoscene.rasterizer import RasterInfo
from chronoscene.scene.geometry import rotation_from_quaternion


def rows(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    parameters = {
        name: torch.randn(count, *shape, generator=generator) for name, shape in SHAPES.items()
    }
    parameters["logit_opacities"] = torch.full((count,), logit(0.5))
    parameters["log_scales"] = torch.full((count, 3), float(np.log(0.005)))
    return parameters


def run_round(parameters, gradient, *, prune_large=False, config=None, seed=0):
    return densify(
        parameters,
        gradient,
        extent=EXTENT,
        prune_large=prune_large,
        config=config or GaussianConfig(),
        generator=np.random.default_rng(seed),
        scatter=scatter_in_space,
    )


def view_of(gradients, radii):
    """Info of a call with one camera whose ``backward`` is done."""
    means2d = torch.zeros(1, len(gradients), 2, requires_grad=True)
    means2d.grad = torch.tensor([gradients])
    return RasterInfo(means2d, torch.tensor([radii], dtype=torch.int32), torch.ones(1, 1))


def test_gradients_count_in_half_images_and_are_averaged_over_the_views():
    statistics = GradientStatistics(3, "cpu")
    statistics.add(view_of([[3e-3, 4e-3], [1e-3, 0], [9.0, 9.0]], [[1, 1], [2, 2], [0, 4]]), 20, 40)
    statistics.add(view_of([[0, 1e-3], [9.0, 9.0], [9.0, 9.0]], [[1, 1], [0, 0], [3, 0]]), 20, 40)
    expected = [(np.hypot(0.03, 0.08) + 0.02) / 2, 0.01, 0]
    np.testing.assert_allclose(statistics.mean(), expected, rtol=1e-6)


def test_views_do_not_count_for_gaussians_in_what_their_mask_ignores():
    """One of four lies where the photo counts, one where it does not, two beside the photo."""
    info = view_of([[1e-3, 0.0]] * 4, [[1, 1]] * 4)
    with torch.no_grad():
        info.means2d[0] = torch.tensor([[19.9, 0.1], [0.1, 39.9], [-0.1, 5.0], [5.0, 40.0]])
    mask = torch.zeros(40, 20, dtype=torch.bool)
    mask[0, 19] = True
    statistics = GradientStatistics(4, "cpu")
    statistics.add(info, 20, 40, mask)
    assert statistics.views.tolist() == [1, 0, 1, 1]
    np.testing.assert_allclose(statistics.sums, [0.01, 0, 0.01, 0.01], rtol=1e-6)


def test_gaussians_drawn_before_those_in_training_do_not_count():
    info = view_of([[9.0, 9.0], [1e-3, 0.0]], [[1, 1], [1, 1]])
    info.means2d.absgrad = torch.tensor([[[9.0, 9.0], [2e-3, 0.0]]])
    mask = torch.ones(40, 20, dtype=torch.bool)
    statistics = GradientStatistics(1, "cpu")
    statistics.add(info, 20, 40, mask)
    np.testing.assert_allclose(statistics.mean(), [0.02], rtol=1e-6)


def test_a_small_gaussian_is_copied():
    parameters = rows(4)
    result = run_round(parameters, torch.tensor([0.0, 3e-4, 1e-4, 2e-4]))
    assert result.keep.all()
    for name in SHAPES:
        assert torch.equal(result.new[name], parameters[name][[1, 3]])


def test_a_large_gaussian_becomes_two_samples_of_itself():
    parameters = rows(3)
    parameters["log_scales"][1] = torch.log(torch.tensor([0.02, 0.3, 0.01]))
    result = run_round(parameters, torch.tensor([0.0, 3e-4, 0.0]))
    assert result.keep.tolist() == [True, False, True]
    assert len(result.new["means"]) == 2
    assert torch.equal(result.new["sh_rest"], parameters["sh_rest"][[1, 1]])
    assert torch.equal(result.new["quats"], parameters["quats"][[1, 1]])
    torch.testing.assert_close(
        scales_of(result.new["log_scales"]),
        scales_of(parameters["log_scales"][[1, 1]]) / 1.6,
        rtol=1e-6,
        atol=0,
    )


def test_parts_are_distributed_as_their_gaussian():
    count = 20_000
    parameters = {name: values[:1].repeat(count, *(1,) * (values.dim() - 1)) for name, values in
                  rows(1, seed=3).items()}  # fmt: skip
    scales = np.array([0.02, 0.3, 0.1])
    parameters["log_scales"][:] = torch.from_numpy(np.log(scales).astype(np.float32))
    result = run_round(parameters, torch.full((count,), 1.0))
    moves = (result.new["means"] - parameters["means"][0]).double().numpy()
    R = rotation_from_quaternion(parameters["quats"][0].double().numpy())
    expected = R @ np.diag(scales**2) @ R.T
    # 40,000 samples: the standard error of a covariance is under 0.8 % of the largest variance.
    np.testing.assert_allclose(np.cov(moves.T), expected, atol=0.03 * 0.3**2)
    np.testing.assert_allclose(moves.mean(0), 0, atol=0.01)


def test_faint_and_later_large_gaussians_go():
    parameters = rows(4)
    parameters["logit_opacities"][1] = logit(0.0049)
    parameters["log_scales"][2, 0] = float(np.log(0.111))
    quiet = torch.zeros(4)
    assert run_round(parameters, quiet).keep.tolist() == [True, False, True, True]
    assert run_round(parameters, quiet, prune_large=True).keep.tolist() == [
        True,
        False,
        False,
        True,
    ]
    # New rows are judged as the old ones are.
    assert len(run_round(parameters, torch.tensor([0, 1.0, 0, 0])).new["means"]) == 0
    parameters["log_scales"][3] = float(np.log(0.111 * 1.6 + 0.001))
    large = torch.tensor([0, 0, 0, 1.0])
    assert len(run_round(parameters, large).new["means"]) == 2
    assert len(run_round(parameters, large, prune_large=True).new["means"]) == 0


def test_the_limit_takes_the_largest_gradients():
    config = GaussianConfig(max_gaussians=6)
    gradient = torch.tensor([5e-4, 1e-4, 9e-4, 7e-4])
    scale = torch.tensor([0.001, 0.001, 0.001, 0.5])
    clone, split = choose_growth(gradient, scale, EXTENT, config)
    assert clone.tolist() == [False, False, True, False]
    assert split.tolist() == [False, False, False, True]
    full, _ = choose_growth(gradient, scale, EXTENT, replace(config, max_gaussians=3))
    assert not full.any()


def test_reset_leaves_no_opacity_above_the_limit():
    logits = torch.tensor([5.0, logit(0.01), -8.0])
    after = reset_opacities(logits, 0.01)
    assert (opacities_of(after) <= 0.01 * (1 + 1e-6)).all()
    assert after[1:].tolist() == logits[1:].tolist()


def test_rounds_grow_small_sets_and_prune_large_ones_where_limits_say_so():
    """Row 0 is to be cloned, row 1 to be pruned."""
    parameters = rows(4)
    parameters["logit_opacities"][1] = logit(0.001)
    gradient = torch.tensor([3e-4, 0.0, 0.0, 0.0])
    sizes = {}
    for limits in (
        {},
        {"grow_below": 5},
        {"grow_below": 4},
        {"prune_above": 4},
        {"prune_above": 5},
    ):
        result = run_round(parameters, gradient, config=GaussianConfig(**limits))
        sizes[tuple(limits.items())] = len(result.new["means"]), int(result.keep.sum())
    assert list(sizes.values()) == [(1, 3), (1, 3), (0, 3), (1, 3), (1, 4)]


def test_absolute_gradients_count_where_there_are_some():
    statistics = GradientStatistics(2, "cpu")
    info = view_of([[0.0, 0.0], [1e-3, 0.0]], [[1, 1], [1, 1]])
    info.means2d.absgrad = torch.tensor([[[3e-3, 4e-3], [2e-3, 0.0]]])
    statistics.add(info, 20, 40)
    np.testing.assert_allclose(statistics.mean(), [np.hypot(0.03, 0.08), 0.02], rtol=1e-6)
