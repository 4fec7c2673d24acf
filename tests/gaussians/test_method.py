"""Saving and loading; what a method with a deformation field reuses."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_scene import HEIGHT, SHORT, WIDTH, mean_squared_error, toy_scene, train

from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.model import GaussianModel
from chronoscene.scene.similarity import Sim3


def test_saved_models_render_the_same(tmp_path):
    scene = toy_scene()
    method = train(scene, replace(SHORT, iterations=40))
    assert method.model.sh_degree == 3
    method.save(tmp_path)
    loaded = GaussianSplatting(GaussianConfig())
    loaded.load(tmp_path, device="cpu")
    assert loaded.config == method.config and loaded.size() == method.size()
    for view in scene.views[:3]:
        mine, theirs = method.render(view, 0), loaded.render(view, 0)
        assert np.array_equal(mine.rgb, theirs.rgb)
        assert np.array_equal(mine.alpha, theirs.alpha)
        assert np.array_equal(mine.depth, theirs.depth)
        assert mine.rgb.shape == (HEIGHT, WIDTH, 3) and mine.rgb.dtype == np.float32


def test_a_model_with_a_missing_group_is_refused(tmp_path):
    method = train(toy_scene(), replace(SHORT, iterations=1))
    del method.model.parameters["quats"]
    method.save(tmp_path)
    with pytest.raises(CheckpointError, match="parameter groups"):
        GaussianSplatting(GaussianConfig()).load(tmp_path, device="cpu")


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_a_model_that_is_not_finite_is_refused(value, tmp_path):
    method = train(toy_scene(), replace(SHORT, iterations=1))
    method.model.parameters["means"].data[7, 1] = value
    method.save(tmp_path)
    match = r"expected finite numbers .* found others in 'means';"
    with pytest.raises(CheckpointError, match=match):
        GaussianSplatting(GaussianConfig()).load(tmp_path, device="cpu")


def test_a_description_that_does_not_fit_is_refused(tmp_path):
    method = train(toy_scene(), replace(SHORT, iterations=1))
    method.meta["background"] = [0, None, 0]
    method.save(tmp_path)
    with pytest.raises(CheckpointError, match="fit together, found TypeError"):
        GaussianSplatting(GaussianConfig()).load(tmp_path, device="cpu")


@pytest.mark.parametrize("values", [None, [], {"views_per_step": 1}])
def test_a_training_that_does_not_fit_is_refused(values, tmp_path):
    method = train(toy_scene(), replace(SHORT, iterations=1))
    method.save_training(tmp_path)
    path = tmp_path / "training.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"values": values}))
    with pytest.raises(CheckpointError, match=r"expected a training that .* found \w+Error"):
        method.load_training(tmp_path)


def test_a_near_plane_is_trained_stored_and_rendered_with(tmp_path):
    scene = toy_scene()
    method = train(scene, replace(SHORT, iterations=3, near_plane=1.0))
    method.save(tmp_path)
    loaded = GaussianSplatting(GaussianConfig())
    loaded.load(tmp_path, device="cpu")
    mine, theirs = method.render(scene.views[0], 0), loaded.render(scene.views[0], 0)
    assert np.array_equal(mine.rgb, theirs.rgb) and np.array_equal(mine.depth, theirs.depth)
    # About half of the Gaussians are nearer than 1, and the rest is farther.
    assert mine.depth[mine.alpha > 0].min() >= 1.0
    usual = train(scene, replace(SHORT, iterations=3)).render(scene.views[0], 0)
    assert usual.depth[usual.alpha > 0].min() < 1.0


def test_a_near_plane_in_world_units_is_that_of_the_training_frame_times_its_scale(tmp_path):
    scene = replace(toy_scene(), training_from_world=Sim3(0.25, np.eye(3), np.zeros(3)))
    world = train(scene, replace(SHORT, iterations=3, near_plane=4.0, length_unit="world"))
    frame = train(scene, replace(SHORT, iterations=3, near_plane=1.0, length_unit="training"))
    world.save(tmp_path)
    loaded = GaussianSplatting(GaussianConfig())
    loaded.load(tmp_path, device="cpu")
    images = [m.render(scene.views[0], 0).rgb for m in (world, frame, loaded)]
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])


class PaintedModel(GaussianModel):
    """The simplest field: what each period adds to the colours of all Gaussians."""

    def at_period(self, period):
        added = self.shared["added_color"][round(period)]
        return self.parameters | {"sh_dc": self.parameters["sh_dc"] + added}


class Painted(GaussianMethod):
    """The least that a method with a field has to write."""

    name = "painted"
    config_class = GaussianConfig

    def make_model(self, parameters, train, seed):
        periods = 1 + max(view.period for view in train.views)
        added = torch.zeros(periods, 3, device=parameters["means"].device)
        return PaintedModel(parameters, {"added_color": added})

    def restore_model(self, tensors):
        parameters = dict(tensors)
        shared = {"added_color": parameters.pop("added_color")}
        return PaintedModel(parameters, shared, sh_degree=self.meta["sh_degree"])

    def learning_rates(self, due):
        return {**super().learning_rates(due), "added_color": 0.01}


class DrawnModel(PaintedModel):
    """The same, but for what it draws only."""

    def at_period(self, period):
        return self.parameters

    def splats(self, view, period):
        drawn = super().splats(view, period)
        return drawn._replace(colors=drawn.colors + self.shared["added_color"][round(period)])


class Drawn(Painted):
    def make_model(self, parameters, train, seed):
        painted = super().make_model(parameters, train, seed)
        return DrawnModel(painted.parameters, painted.shared)


def test_colours_that_an_export_would_lose_are_refused():
    method = train(toy_scene(), replace(SHORT, iterations=3), method_class=Drawn)
    with pytest.raises(ConfigError, match="painted: expected static_gaussians beside splats"):
        method.to_gaussians(0.0, [])


def test_a_field_needs_no_trainer_of_its_own(tmp_path):
    """Density control, optimiser and checkpoints take what `at_period` draws."""
    scene = toy_scene(colors_per_period=2)
    dark = [scene.load_image(i) // (1 + view.period) for i, view in enumerate(scene.views)]
    scene = replace(scene, load_image=dark.__getitem__)
    config = replace(SHORT, gradient_threshold=1e-5)
    method = train(scene, config, method_class=Painted)
    assert len(method.model) > 60, "Gaussians were meant to be added on the way"
    static = train(scene, config)
    assert mean_squared_error(method, scene) < 0.8 * mean_squared_error(static, scene)
    method.save(tmp_path)
    loaded = Painted(config)
    loaded.load(tmp_path, device="cpu")
    for period in (0, 1):
        mine, theirs = (m.render(scene.views[0], period).rgb for m in (method, loaded))
        assert np.array_equal(mine, theirs)
    assert loaded.size() == method.size()


def test_a_stored_model_is_deformed_once_for_the_views_of_a_period(tmp_path, monkeypatch):
    scene = toy_scene(colors_per_period=2)
    method = train(scene, replace(SHORT, iterations=20), method_class=Painted)
    method.model.shared["added_color"].data[1] += 0.5
    method.save(tmp_path)
    loaded = Painted(SHORT)
    loaded.load(tmp_path, device="cpu")
    views, expected = scene.views[:2], {}
    for period in (0, 1):
        expected[period] = [method.render(view, period).rgb for view in views]
    assert np.abs(expected[0][0] - expected[1][0]).max() > 0.1
    deformed, at_period = [], PaintedModel.at_period

    def counted(model, period):
        deformed.append(period)
        return at_period(model, period)

    monkeypatch.setattr(PaintedModel, "at_period", counted)
    for period in (0, 1, 0):
        for view, image in zip(views, expected[period], strict=True):
            assert np.array_equal(loaded.render(view, period).rgb, image)
    assert deformed == [0, 1, 0]
    loaded.permute(np.arange(len(loaded.model))[::-1].copy())
    np.testing.assert_allclose(loaded.render(views[0], 1).rgb, expected[1][0], atol=1e-4)
