"""Relocation and noise against their definitions, and a training with both."""

from dataclasses import replace
from math import comb, sqrt

import numpy as np
import pytest
import torch
from toy_scene import SHORT, mean_squared_error, toy_scene, train

from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.mcmc import (
    MAX_COPIES,
    make_generator,
    noise,
    relocate,
    shared_opacity_and_scale,
)
from chronoscene.gaussians.model import SHAPES, opacities_of, scales_of
from chronoscene.gaussians.trainer import Timeline
from chronoscene.kernels.runtime import set_threads
from chronoscene.scene.geometry import rotation_from_quaternion

MCMC = GaussianConfig(densification="mcmc", max_gaussians=1_000)


def generator(*key):
    return make_generator(torch.device("cpu"), *key)


def rows(opacities, seed=0):
    numbers = torch.Generator().manual_seed(seed)
    count = len(opacities)
    parameters = {n: torch.randn(count, *s, generator=numbers) for n, s in SHAPES.items()}
    parameters["logit_opacities"] = torch.logit(
        torch.tensor(opacities, dtype=torch.float64)
    ).float()
    return parameters


def light_lost(opacity, scale, copies):
    """Along a line of pixels through the centre of equal Gaussians behind each other. float64"""
    x = np.linspace(-12.0, 12.0, 200_001)
    passed = np.ones_like(x)
    for _ in range(copies):
        passed *= 1 - opacity * np.exp(-0.5 * (x / scale) ** 2)
    lost = 1 - passed
    return lost[len(x) // 2], lost.sum() * (x[1] - x[0])


@pytest.mark.parametrize("copies", [1, 2, 3, 10, MAX_COPIES])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.9999])
def test_copies_in_one_place_lose_the_light_that_the_one_lost(opacity, copies):
    shared, factor = shared_opacity_and_scale(
        torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    )
    one = light_lost(opacity, 1.0, 1)
    many = light_lost(shared.item(), factor.item(), copies)
    np.testing.assert_allclose(many, one, rtol=1e-9)


def test_the_formula_is_the_double_sum_of_the_paper():
    for opacity, copies in ((0.2, 4), (0.8, 7)):
        tensors = torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
        shared, factor = (value.item() for value in shared_opacity_and_scale(*tensors))
        assert shared == pytest.approx(1 - (1 - opacity) ** (1 / copies), rel=1e-12)
        total = sum(
            comb(i - 1, k) * (-1) ** k * shared ** (k + 1) / sqrt(k + 1)
            for i in range(1, copies + 1)
            for k in range(i)
        )
        assert factor == pytest.approx(opacity / total, rel=1e-12)


def test_an_opaque_gaussian_and_more_copies_than_allowed_stay_finite():
    shared, factor = shared_opacity_and_scale(torch.tensor([1.0, 0.5]), torch.tensor([51, 9_999]))
    capped = shared_opacity_and_scale(torch.tensor([0.5]), torch.tensor([MAX_COPIES]))
    assert 0 < shared[0] < 1 and factor[0] > 0
    assert (shared[1], factor[1]) == (capped[0][0], capped[1][0])


def test_dead_gaussians_move_to_live_ones_and_the_set_grows():
    opacities = [0.004] * 7 + [0.5] * 193
    parameters = rows(opacities)
    result = relocate(parameters, MCMC, generator(0))
    places = parameters["means"][7:]
    new = result.new["means"]
    assert not result.keep[:7].any()
    assert int(result.keep.sum()) + len(new) == 200 + 10
    for mean in places[result.keep[7:]]:
        assert not (new == mean).all(1).any()
    for mean in places[~result.keep[7:]]:
        same = (new == mean).all(1)
        one = int((parameters["means"] == mean).all(1).nonzero())
        shared, factor = shared_opacity_and_scale(torch.tensor([0.5]), same.sum()[None])
        found = opacities_of(result.new["logit_opacities"][same])
        np.testing.assert_allclose(found, shared.item(), rtol=1e-5)
        sizes = scales_of(result.new["log_scales"][same]) / scales_of(parameters["log_scales"][one])
        np.testing.assert_allclose(sizes, factor.item(), rtol=1e-5)
        for name in ("quats", "sh_dc", "sh_rest"):
            assert (result.new[name][same] == parameters[name][one]).all()


def test_places_are_drawn_by_opacity():
    parameters = rows([0.001] * 3_000 + [0.2, 0.6])
    result = relocate(parameters, replace(MCMC, mcmc_growth=0.0, max_gaussians=1), generator(0))
    at_second = int((result.new["means"] == parameters["means"][-1]).all(1).sum())
    assert len(result.new["means"]) == 3_002 and not result.keep.any()
    assert at_second / 3_002 == pytest.approx(0.75, abs=0.03)


def test_growth_ends_at_the_maximum_and_nothing_alive_is_left_alone():
    parameters = rows([0.5] * 100)
    full = relocate(parameters, replace(MCMC, max_gaussians=103), generator(0))
    assert int(full.keep.sum()) + len(full.new["means"]) == 103
    over = relocate(parameters, replace(MCMC, max_gaussians=50), generator(0))
    assert over.keep.all() and len(over.new["means"]) == 0
    dead = relocate(rows([0.001] * 5), MCMC, generator(0))
    assert dead.keep.all() and len(dead.new["means"]) == 0


def test_noise_has_the_covariance_of_the_gaussian_and_spares_opaque_ones():
    count = 40_000
    one = rows([0.001])
    many = {name: values.repeat(count, *[1] * (values.dim() - 1)) for name, values in one.items()}
    found = noise(many, 1e-3, replace(MCMC, mcmc_noise=10.0), generator(0)).double().numpy()
    axes = rotation_from_quaternion(one["quats"][0]) * np.exp(one["log_scales"][0].numpy())
    covariance = axes @ axes.T
    gate = 1 / (1 + np.exp(-100 * (0.005 - 0.001)))
    expected = (1e-3 * 10.0 * gate) ** 2 * covariance @ covariance
    np.testing.assert_allclose(found.T @ found / count, expected, atol=0.03 * expected.max())
    np.testing.assert_allclose(found.mean(0), 0, atol=0.03 * np.sqrt(expected.max()))
    opaque = noise(rows([0.5]), 1e-3, MCMC, generator(0)) / noise(
        rows([0.004]), 1e-3, MCMC, generator(0)
    )
    assert (opaque.abs() < 1e-15).all()


def test_noise_without_a_rotation_is_none():
    parameters = rows([0.001])
    parameters["quats"].zero_()
    assert not noise(parameters, 1.0, MCMC, generator(0)).any()


def test_lengths_in_world_units_are_converted():
    """A scene in another unit trains the same."""
    world = GaussianConfig(densification="mcmc", max_gaussians=9)
    config = world.in_training_frame(0.25)
    sizes = {"log_scales": torch.full((1, 3), float(np.log(2.0)))}
    here = noise(rows([0.001]) | sizes, 1e-3, world, generator(0))
    sizes = {"log_scales": torch.full((1, 3), float(np.log(0.5)))}
    there = noise(rows([0.001]) | sizes, 0.25e-3, config, generator(0))
    np.testing.assert_allclose(there, 0.25 * here, rtol=1e-5)
    assert config.mcmc_scale_weight * 0.5 == pytest.approx(world.mcmc_scale_weight * 2.0)
    same = replace(world, length_unit="training")
    assert same.in_training_frame(0.25) == same


def test_there_are_no_resets_and_no_gradients_to_collect():
    timeline = Timeline(MCMC)
    due = [timeline.at(i, i / 30_000) for i in range(30_000)]
    assert not any(d.reset or d.collect for d in due)
    assert [d.moment for d in due if d.densify] == list(range(600, 15_000, 100))


def test_a_maximum_must_be_given():
    with pytest.raises(ConfigError, match="max_gaussians"):
        GaussianConfig(densification="mcmc")
    with pytest.raises(ConfigError, match="'adaptive' or 'mcmc'"):
        GaussianConfig(densification="random")


def test_regularisers_make_gaussians_fainter_and_smaller():
    scene, means = toy_scene(), []
    config = replace(SHORT, iterations=60, densification="mcmc", mcmc_noise=0.0, mcmc_growth=0.0)
    for weight in (0.0, 1.0):
        weights = {"mcmc_opacity_weight": weight, "mcmc_scale_weight": 5 * weight}
        parameters = train(scene, replace(config, **weights)).model.parameters
        opacity = opacities_of(parameters["logit_opacities"].detach()).mean()
        means.append((float(opacity), float(scales_of(parameters["log_scales"].detach()).mean())))
    assert means[1][0] < 0.9 * means[0][0] and means[1][1] < 0.9 * means[0][1]


def test_it_learns_a_static_scene():
    scene = toy_scene(count=150)
    config = replace(SHORT, densification="mcmc", iterations=300, mcmc_growth=0.2)
    start = GaussianSplatting(config)
    start.setup(scene, seed=0, device="cpu")
    method = train(scene, config)
    assert 150 < len(method.model) <= config.max_gaussians
    assert mean_squared_error(method, scene) < 0.2 * mean_squared_error(start, scene)


def test_equal_seeds_give_equal_bits_for_any_number_of_threads():
    scene = toy_scene(count=3_000, views=4)
    config = replace(
        SHORT, iterations=30, densify_interval=10, densification="mcmc", max_gaussians=4_000
    )
    found = []
    for threads, seed in ((1, 0), (2, 0), (2, 1)):
        set_threads(threads)
        found.append(train(scene, config, seed=seed).model.parameters["means"].detach())
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])
