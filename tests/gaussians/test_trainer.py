"""Schedule, and the bookkeeping of rows in training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_scene import EXTENT, HEIGHT, SHORT, WIDTH, toy_scene

from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.model import SHAPES, logit, opacities_of
from chronoscene.gaussians.trainer import Timeline
from chronoscene.training.drawing import draw
from chronoscene.training.views import ViewSampler


def test_the_published_schedule():
    timeline = Timeline(GaussianConfig())
    due = [timeline.at(i, i / 30_000) for i in range(30_000)]
    assert [d.moment for d in due] == list(range(1, 30_001))
    assert [d.moment for d in due if d.densify] == list(range(600, 15_000, 100))
    assert [d.moment for d in due if d.reset] == [3_000, 6_000, 9_000, 12_000]
    assert [d.moment for d in due if d.collect] == list(range(1, 15_000))
    assert next(d.moment for d in due if d.prune_large) == 3_001
    degrees = [d.sh_degree for d in due]
    assert [degrees.index(k) + 1 for k in range(4)] == [1, 1_000, 2_000, 3_000]
    assert due[14_999].position_lr == pytest.approx(1.6e-5, rel=1e-3)
    assert due[29_999].position_lr == 1.6e-6


def test_longer_training_is_not_stretched_unless_asked():
    plain = Timeline(GaussianConfig(iterations=40_000))
    late = plain.at(30_000, 0.9)  # whatever the progress
    assert late.moment == 30_001 and late.position_lr == 1.6e-6 and not late.collect
    stretched = Timeline(GaussianConfig(iterations=40_000, stretch=True))
    assert stretched.at(30_000, 0.75).moment == 22_501


def test_a_squeezed_schedule_passes_the_same_phases():
    config = GaussianConfig(iterations=3_000, stretch=True, reset_interval=7_500)
    timeline = Timeline(config)
    due = [timeline.at(i, i / 3_000) for i in range(3_000)]
    assert [i for i, d in enumerate(due) if d.reset] == [750]
    assert [i + 1 for i, d in enumerate(due) if d.densify] == list(range(100, 1_501, 100))
    assert due[-1].sh_degree == 3 and due[50].sh_degree == 0 and due[100].sh_degree == 1


def test_a_run_that_ends_by_the_clock_follows_progress():
    # Ten times faster than its iterations would say: 300 steps go through everything.
    timeline = Timeline(GaussianConfig(iterations=3_000, stretch=True))
    due = [timeline.at(i, i / 300) for i in range(300)]
    assert sum(d.reset for d in due) == 4
    assert due[-1].sh_degree == 3 and not due[-1].collect


@pytest.mark.parametrize(("unit", "kind"), [("world", "camera"), ("training", "scene")])
def test_positions_learn_in_units_of_the_extent(unit, kind):
    """Adam's first step is as long as the learning rate, whatever the gradient."""
    scene, config = toy_scene(), GaussianConfig()
    for extent in (EXTENT, 3.0):
        method = GaussianSplatting(replace(SHORT, length_unit=unit))
        method.setup(replace(scene, **{f"{kind}_extent": extent}), seed=0, device="cpu")
        before = method.model.parameters["means"].detach().clone()
        method.step(0, 0.0)
        moved = (method.model.parameters["means"].detach() - before).abs().max()
        assert float(moved) == pytest.approx(config.position_lr_initial * extent, rel=0.01)


def test_a_step_counts_its_gradients_once():
    scene = toy_scene()
    method = GaussianSplatting(SHORT)
    method.setup(scene, seed=0, device="cpu")
    number = ViewSampler(len(scene.views), 0).next()
    view, trainer = scene.views[number], method.trainer
    raster = draw(
        method.model.splats(view, 0), view, trainer.background, near_plane=SHORT.near_plane
    )
    trainer.loss(raster, number, None).backward()
    pixels = raster.info.means2d.grad[0].numpy() * [0.5 * WIDTH, 0.5 * HEIGHT]
    expected = np.where((raster.info.radii[0] > 0).all(-1), np.linalg.norm(pixels, axis=-1), 0)
    method.step(0, 0.0)
    assert expected.max() > 0
    np.testing.assert_allclose(trainer.statistics.mean(), expected, rtol=1e-5)


def test_moments_of_survivors_stay_and_new_rows_have_none():
    method = GaussianSplatting(replace(SHORT, gradient_threshold=0.0, max_gaussians=90))
    method.setup(toy_scene(), seed=0, device="cpu")
    for i in range(24):
        method.step(i, i / 250)
    before = {name: values.detach().clone() for name, values in method.model.parameters.items()}
    moments = {name: values.clone() for name, values in method.trainer.optimizer.state().items()}
    method.step(24, 24 / 250)
    after = method.trainer.optimizer.state()
    count = len(method.model.parameters["means"])
    assert 60 < count <= 90
    # Which old rows are still there, found by their values: nothing was stepped.
    kept = torch.tensor([bool((row == method.model.parameters["means"][:60]).all(1).any())
                         for row in before["means"]])  # fmt: skip
    survivors = int(kept.sum())
    assert 0 < survivors < count
    for name in SHAPES:
        assert torch.equal(method.model.parameters[name][:survivors], before[name][kept])
        for part in ("mean", "square"):
            assert torch.equal(after[f"{name}.{part}"][:survivors], moments[f"{name}.{part}"][kept])
            assert not after[f"{name}.{part}"][survivors:].any()


def test_an_extended_training_begins_anew_with_the_degree_that_was_reached():
    method = GaussianSplatting(replace(SHORT, sh_interval=1_000))
    method.setup(toy_scene(), seed=0, device="cpu")
    method.step(0, 0.9)
    degree, before = method.model.sh_degree, method.model.parameters["means"]
    assert degree == 3
    method.extend(toy_scene(views=4))
    assert method.model.parameters["means"] is before
    assert not any(values.any() for values in method.trainer.optimizer.state().values())
    method.step(0, 0.0)
    assert method.model.sh_degree == degree and method.trainer.sampler.count == 4


def test_a_reset_leaves_the_opacities_alone_otherwise():
    config = replace(SHORT, reset_interval=3_000, densify_from=30_000)
    method = GaussianSplatting(config)
    method.setup(toy_scene(), seed=0, device="cpu")
    for i in range(25):
        method.step(i, i / 250)
    before = method.model.parameters["logit_opacities"].detach().clone()
    means = method.model.parameters["means"].detach().clone()
    method.step(25, 0.1)
    assert torch.equal(method.model.parameters["logit_opacities"], before.clamp_max(logit(0.01)))
    assert not method.trainer.optimizer.state()["logit_opacities.mean"].any()
    assert not torch.equal(method.model.parameters["means"], means)


@pytest.mark.parametrize("opacity", [0.0, 1.0, 2.0])
def test_a_reset_is_to_an_opacity_that_has_a_logit(opacity):
    with pytest.raises(ConfigError, match="reset_opacity: expected"):
        replace(SHORT, reset_opacity=opacity)


def test_an_empty_step_changes_nothing_but_the_schedule_goes_on():
    """Every camera is turned away, also when a round and a reset are due."""
    scene = toy_scene()
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    method = GaussianSplatting(replace(SHORT, reset_interval=3_000, gradient_threshold=0.0))
    method.setup(scene, seed=0, device="cpu")
    for i in range(24):
        method.step(i, i / 250)
    trainer, before = method.trainer, {n: t.clone() for n, t in method.model.tensors().items()}
    moments = {name: values.clone() for name, values in trainer.optimizer.state().items()}
    views = tuple(replace(v, cam_from_world=turn @ v.cam_from_world) for v in scene.views)
    trainer.train = replace(scene, views=views)
    assert trainer.step(23, 23 / 250).skipped == "empty"
    assert all(torch.equal(t, before[name]) for name, t in method.model.tensors().items())
    after = trainer.optimizer.state()
    assert all(torch.equal(after[name], values) for name, values in moments.items())
    report = trainer.step(24, 24 / 250)
    assert report.skipped == "empty" and report.primitives > 60
    assert trainer.step(25, 0.1).skipped == "empty"
    logits = method.model.parameters["logit_opacities"].detach()
    assert opacities_of(logits).max() < 0.0101


def test_a_gaussian_with_a_scale_beyond_all_numbers_is_not_drawn_and_stops_no_other():
    method = GaussianSplatting(SHORT)
    method.setup(toy_scene(), seed=0, device="cpu")
    with torch.no_grad():
        method.model.parameters["log_scales"][7] = 200.0
    before = method.model.parameters["means"].detach().clone()
    assert method.step(0, 0.0).skipped is None
    moved = (method.model.parameters["means"] != before).any(1)
    assert moved.sum() > 10 and not moved[7]
    assert np.isfinite(method.render(toy_scene().views[0], 0).rgb).all()


def test_a_number_that_is_none_is_a_step_that_is_not_finite():
    method = GaussianSplatting(SHORT)
    method.setup(toy_scene(), seed=0, device="cpu")
    with torch.no_grad():
        method.model.parameters["log_scales"][7] = torch.nan
    before = method.model.parameters["means"].detach().clone()
    assert method.step(0, 0.0).skipped == "not finite"
    assert torch.equal(method.model.parameters["means"], before)


def test_a_set_that_died_out_still_trains_and_renders():
    scene = toy_scene(views=2)
    method = GaussianSplatting(replace(SHORT, min_opacity=2.0, densify_interval=2))
    method.setup(scene, seed=0, device="cpu")
    for i in range(20):
        report = method.step(i, i / 250)
    assert report.primitives == 0 and np.isfinite(report.loss)
    assert not method.render(scene.views[0], 0).rgb.any()
