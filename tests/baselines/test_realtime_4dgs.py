"""realtime4DGS: what it is with and without time, how it starts, splits and trains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from moving_scene import PERIODS, arc, decibels, moving_scene
from toy_scene import (
    EXTENT,
    SHORT,
    mean_squared_error,
    photo_of,
    ring_of_views,
    solid_gaussians,
    toy_scene,
    train,
)

from baselines.realtime_4dgs import SPEC
from baselines.realtime_4dgs.config import Realtime4DGSConfig
from baselines.realtime_4dgs.method import Realtime4DGS
from baselines.realtime_4dgs.model import SpacetimeModel, scatter_in_spacetime
from baselines.realtime_4dgs.slicing import SHAPES, turned
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.gaussians.model import SHAPES as SPACE
from chronoscene.gaussians.model import GaussianModel
from chronoscene.methods import TrainingSet, build_config
from chronoscene.training.checkpoint import load_tensors, save_tensors
from chronoscene.training.drawing import draw


def config(**changes: Any) -> Realtime4DGSConfig:
    """The preset for short trainings, made for the toy scene."""
    made = {"iterations": 300, "densify_interval": 25, "max_gaussians": 200, **changes}
    found: Realtime4DGSConfig = build_config(SPEC, preset="fast", overrides=made)
    return found


def started(scene: TrainingSet, given: Realtime4DGSConfig, seed: int = 0) -> Realtime4DGS:
    method = Realtime4DGS(given)
    method.setup(scene, seed=seed, device="cpu")
    return method


def random_model(count: int, **changes: Any) -> SpacetimeModel:
    generator = torch.Generator().manual_seed(0)
    made = {n: torch.randn(count, *shape, generator=generator) for n, shape in SHAPES.items()}
    made["means"] *= 0.3
    made["log_scales"] -= 3
    return SpacetimeModel(made, sh_degree=3, **{"periods": PERIODS, "cycle": 1.0, **changes})


@pytest.mark.parametrize("period", [0, 1.5, PERIODS - 1])
def test_wide_in_time_and_turned_in_space_alone_it_is_3dgs(period: float) -> None:
    """Equal quaternions turn space as the one of 3DGS does. Images, and gradients of what both
    have."""
    model = random_model(100)
    p = model.parameters
    p["right_quats"] = p["quats"].clone()
    p["log_time_scales"].fill_(12.0)
    p["waves_dc"] *= 0
    p["waves_rest"] *= 0
    static = GaussianModel({name: p[name] for name in SPACE}, sh_degree=3)
    view = toy_scene().views[0]
    found = []
    for case in (model, static):
        for name in SPACE:
            case.parameters[name] = case.parameters[name].detach().clone().requires_grad_()
        splats = case.splats(view, period)
        image = draw(splats, view, torch.zeros(3), near_plane=0.01).image
        (image * torch.linspace(0, 1, image.numel()).view(image.shape)).sum().backward()
        found.append((image.detach(), {n: case.parameters[n].grad for n in SPACE}))
    (image, grads), (true_image, true_grads) = found
    assert float(true_image.std()) > 0.05
    torch.testing.assert_close(image, true_image, rtol=0, atol=1e-5)
    for name in set(SPACE) - {"quats"}:  # there are two of these here
        scale = float(true_grads[name].abs().max())
        torch.testing.assert_close(grads[name], true_grads[name], rtol=0, atol=1e-4 * scale)


def test_a_gaussian_has_161_numbers() -> None:
    assert sum(int(np.prod(shape)) for shape in SHAPES.values()) == 161
    method = started(toy_scene(), config())
    assert method.size().parameters == 161 * method.size().primitives


def test_smooth_motion_is_followed() -> None:
    """Better than by static Gaussians, in the periods and between them.

    A turn towards the speed of the cluster takes larger steps than those of long trainings.
    Gaussians that start as short in time as in the released code fade between the periods.
    """
    smooth = moving_scene(arc)
    given = config(max_gaussians=400, rotation_lr=0.01, scale_lr=0.02, initial_time_scale=1.0)
    moving = train(smooth, given, method_class=Realtime4DGS)
    static = train(smooth, replace(SHORT, iterations=300, max_gaussians=400))
    for periods, more in (([0.0, 1.0, 2.0, 3.0, 4.0], 1.0), ([0.5, 1.5, 2.5, 3.5], 0.4)):
        assert decibels(moving, arc, periods) > decibels(static, arc, periods) + more


def test_what_blinks_is_there_in_its_period_alone() -> None:
    """Two periods of one scene in other colours; half of the Gaussians are in the first only."""
    means, colors = solid_gaussians(60, 0)
    views = ring_of_views(10, periods=2)
    images = [photo_of(means[:: 1 + v.period], colors[:: 1 + v.period], v) for v in views]
    seen = np.ones((60, 2), bool)
    seen[1::2, 1] = False
    scene = replace(
        toy_scene(),
        views=views,
        num_periods=2,
        colors=(255 * colors.numpy()).astype(np.uint8),
        point_periods=seen,
        load_image=images.__getitem__,
    )
    blinking = train(scene, config(), method_class=Realtime4DGS)
    static = train(scene, replace(SHORT, iterations=300, max_gaussians=200))
    ours, theirs = (mean_squared_error(method, scene) for method in (blinking, static))
    assert ours < 0.5 * theirs


def times_of(scene: TrainingSet, given: Realtime4DGSConfig, seed: int = 0) -> np.ndarray:
    return started(scene, given, seed).model.parameters["time_means"].detach().numpy()


def test_where_gaussians_start_in_time() -> None:
    scene = moving_scene(arc)
    seen = np.zeros((len(scene.points), PERIODS), bool)
    seen[0, 3] = seen[1, [0, 3]] = seen[2] = True
    scene = replace(scene, point_periods=seen)
    given = times_of(scene, config(start_times="seen"))
    np.testing.assert_allclose(given[:3], [0.75, 0.375, 0.5])
    drawn = times_of(scene, config(start_times="uniform"))
    np.testing.assert_array_equal(given[3:], drawn[3:])  # no period sees them
    assert -0.1 <= drawn.min() < 0.05 and 0.95 < drawn.max() <= 1.1
    assert not np.array_equal(drawn, times_of(scene, config(start_times="uniform"), seed=1))
    released = started(scene, Realtime4DGSConfig()).model.parameters["log_time_scales"]
    np.testing.assert_allclose(released.detach().exp(), np.sqrt(0.2), rtol=1e-6)


def test_parts_are_samples_in_space_and_time() -> None:
    """Parts of Gaussians that are long along one line through both lie on it."""
    model = random_model(1)
    p = {
        name: rows.detach().repeat(4_000, *(1,) * (rows.dim() - 1))
        for name, rows in model.parameters.items()
    }
    parts = {name: rows.clone() for name, rows in p.items()}
    scatter_in_spacetime(parts, config(), np.random.default_rng(0))
    moves = torch.cat(
        [parts["means"] - p["means"], (parts["time_means"] - p["time_means"])[:, None]], dim=-1
    )
    basis = torch.eye(4).double()
    left, right = (p[n][:1].double().repeat(4, 1) for n in ("quats", "right_quats"))
    scales = torch.cat([p["log_scales"][0], p["log_time_scales"][:1]]).exp().double()
    factor = turned(left, right, basis).T * scales
    covariance = (factor @ factor.T).numpy()
    size = np.abs(covariance).max()
    np.testing.assert_allclose(np.cov(moves.numpy().T), covariance, atol=0.06 * size)
    for name in ("log_scales", "log_time_scales"):
        torch.testing.assert_close(parts[name], p[name] - np.log(1.6).astype(np.float32))
    for name in set(SHAPES) - {"means", "time_means", "log_scales", "log_time_scales"}:
        assert torch.equal(parts[name], p[name])


def test_training_splits_in_time_too() -> None:
    method = started(moving_scene(arc), config(clone_scale=0.0, gradient_threshold=0.0))
    before = dict(method.model.parameters)
    for index in range(25):
        method.step(index, 0.1)
    after = method.model.parameters
    assert len(after["means"]) > len(before["means"])
    assert after["log_time_scales"].min() < np.log(config().initial_time_scale) - 0.3


def test_waves_of_colours_come_in_after_the_spherical_harmonics() -> None:
    method = started(moving_scene(arc), Realtime4DGSConfig(densify_interval=10**6))
    assert method.trainer is not None
    steps = []
    for number in (3_998, 3_999, 4_998, 4_999, 29_999):
        method.step(number, number / 30_000)
        steps.append((method.model.sh_degree, method.model.order))
    assert steps == [(3, 0), (3, 1), (3, 1), (3, 2), (3, 2)]
    assert int(method.trainer.optimizer.state()["waves_dc.steps"]) == 4
    assert int(method.trainer.optimizer.state()["waves_rest.steps"]) == 4


def test_waves_stay_in_use_where_a_training_is_resumed_or_extended(tmp_path: Path) -> None:
    scene = moving_scene(arc)
    methods = [started(scene, config()) for _ in range(2)]
    assert [method.model.order for method in methods] == [0, 0]
    methods[0].step(0, 0.5)
    methods[0].save_training(tmp_path)
    methods[1].load_training(tmp_path)
    assert [method.model.order for method in methods] == [2, 2]
    methods[1].extend(scene)
    methods[1].step(0, 0.0)
    assert methods[1].model.order == 2


def test_a_colour_of_the_first_period_is_that_of_the_last_where_a_wave_is_as_long() -> None:
    """Colours agree as in the released code; with waves of twice the length they differ."""
    for cycle, alike in ((1.0, True), (2.0, False)):
        model = random_model(50, cycle=cycle)
        model.parameters["log_time_scales"].fill_(5.0)
        first, last = (model.at_period(p)["sh_dc"] for p in (0, PERIODS - 1))
        assert torch.allclose(first, last, atol=1e-4) == alike


def test_what_is_exported_is_what_is_there_and_looks_the_same() -> None:
    scene = moving_scene(arc)
    method = started(scene, config())
    method.model = random_model(200)
    for period in (0, 1.5):
        cloud = method.to_gaussians(period, scene.views)
        there = method.model.at_period(period)["logit_opacities"].isfinite()
        assert len(cloud) == int(there.sum()) < 200
        view = scene.views[0]
        images = method.render(view, period).rgb, method.render_gaussians(cloud, view).rgb
        np.testing.assert_allclose(*images, atol=1e-5)


def test_a_model_without_its_times_is_refused(tmp_path: Path) -> None:
    started(moving_scene(arc), config()).save(tmp_path)
    tensors, meta = load_tensors(tmp_path, method="realtime4dgs")
    del tensors["time_means"]
    save_tensors(tmp_path, tensors, meta)
    with pytest.raises(CheckpointError, match="time_means"):
        Realtime4DGS(config()).load(tmp_path, device="cpu")


def test_times_are_learned_at_the_extent_in_the_unit_that_was_asked_for() -> None:
    scene = moving_scene(arc)
    for unit, extent in (("world", EXTENT / 0.2), ("training", EXTENT)):
        method = started(scene, config(length_unit=unit))
        assert method.trainer is not None
        rates = method.learning_rates(method.trainer.timeline.at(0, 0.0))
        assert rates["time_means"] == pytest.approx(config().time_lr * extent)


@pytest.mark.parametrize(
    ("name", "value"), [("start_times", "random"), ("densification", "mcmc"), ("wave_interval", 0)]
)
def test_impossible_options_are_named(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        Realtime4DGSConfig(**{name: value})
