"""Scaffold-GS: counts, blindness to periods, equality with ChronoGS of one period."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.scaffold_gs import SPEC
from baselines.scaffold_gs.config import ScaffoldGSConfig
from baselines.scaffold_gs.method import ScaffoldGS, ScaffoldGSPeriod
from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.errors import ConfigError
from chronoscene.methods import TrainingSet, TrainingView, build_config
from chronoscene.scene.similarity import Sim3

GROWING: dict[str, Any] = {
    "iterations": 20,
    "voxel_size": 0.02,
    "voxel_unit": "training",
    "statistics_from": 0.1,
    "density_from": 0.2,
    "density_interval": 5,
    "grad_threshold": 1e-5,
    "success_threshold": 0.3,
}


@pytest.fixture
def train_set() -> TrainingSet:
    """Four views along a line of a random cloud, with noise for images."""
    generator = np.random.default_rng(1)
    K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
    poses = [np.eye(4) for _ in range(4)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = [0.2 * i - 0.3, 0.1, 2.0]
    views = tuple(
        TrainingView(K=K, width=32, height=24, cam_from_world=p, name=f"{i}.png", period=0)
        for i, p in enumerate(poses)
    )
    images = generator.integers(0, 256, (4, 6, 8, 3), np.uint8).repeat(4, 1).repeat(4, 2)
    return TrainingSet(
        views=views,
        num_periods=1,
        points=generator.uniform(-0.5, 0.5, (50, 3)).astype(np.float32),
        colors=np.zeros((50, 3), np.uint8),
        point_periods=np.ones((50, 1), bool),
        training_from_world=Sim3.identity(),
        camera_extent=1.1,
        scene_extent=1.1,
        background=np.zeros(3, np.float32),
        load_image=lambda index: images[index],
    )


def test_parameter_counts(train_set: TrainingSet) -> None:
    made = ScaffoldGS(ScaffoldGSConfig())
    made.setup(train_set, seed=0, device="cpu")
    counts = {name: sum(t.numel() for t in head) for name, head in made.model.heads.items()}
    assert counts == {"opacity": 1_482, "covariance": 3_462, "color": 2_142}
    anchor = sum(
        made.model.tensors()[n][0].numel() for n in ("anchors", "offsets", "features", "log_scales")
    )
    # The official file has 79 columns, of which 3 normals, 1 opacity and 4 rotations are unused.
    assert anchor == 79 - 8


def test_the_schedule_of_the_official_code() -> None:
    config = build_config(SPEC, preset="paper")
    steps = [config.iterations * s for s in (config.statistics_from, config.density_from)]
    assert (config.iterations, *steps) == (30_000, 500, 1_500)
    assert config.iterations * config.density_until == 15_000


@pytest.mark.parametrize("name", ["statistics_from", "density_from", "density_until"])
def test_moments_are_shares_and_not_steps(name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: expected a value less than or equal to 1"):
        ScaffoldGSConfig(**{name: 500.0})


def test_the_near_plane_of_a_stored_model_is_in_its_own_unit(
    train_set: TrainingSet, tmp_path: Path
) -> None:
    """Exports draw by it; options that a model is loaded with are in the unit of the world."""
    scaled = replace(train_set, training_from_world=Sim3(0.1, np.eye(3), np.zeros(3)))
    config = ScaffoldGSConfig(iterations=20, near_plane=15.0, antialiased=True, voxel_size=0.2)
    method = ScaffoldGS(config)
    method.setup(scaled, seed=0, device="cpu")
    method.save(tmp_path)
    loaded = ScaffoldGS(config)
    loaded.load(tmp_path, device="cpu")
    assert loaded.config.near_plane == method.config.near_plane == 1.5
    cloud = method.to_gaussians(0.0, scaled.views)
    one, two = (m.adapt_to_plain(cloud, scaled.views).opacities for m in (method, loaded))
    np.testing.assert_array_equal(one, two)
    assert (one < cloud.opacities).any()


def test_one_period_equals_chronogs_without_time_step_by_step(train_set: TrainingSet) -> None:
    scaffold = ScaffoldGS(ScaffoldGSConfig(**GROWING))
    chronogs = ChronoGS(ChronoGSConfig(**GROWING, base_dim=32, period_dim=0, global_dim=0))
    sizes = set()
    for made in (scaffold, chronogs):
        made.setup(train_set, seed=7, device="cpu")
    for index in range(20):
        progress = index / 20
        assert scaffold.step(index, progress) == chronogs.step(index, progress)
        ours, theirs = scaffold.model.tensors(), chronogs.model.tensors()
        sizes.add(len(ours["anchors"]))
        for name in ours:
            assert torch.equal(ours[name], theirs[name]), (index, name)
    assert len(sizes) > 1, "anchors were meant to grow on the way"


def test_the_period_changes_nothing(train_set: TrainingSet, tmp_path: Path) -> None:
    made = ScaffoldGS(ScaffoldGSConfig(**GROWING))
    made.setup(train_set, seed=0, device="cpu")
    made.step(0, 0.0)
    first = made.render(train_set.views[0], 0).rgb
    np.testing.assert_array_equal(made.render(train_set.views[0], 7).rgb, first)
    made.save(tmp_path)
    loaded = ScaffoldGS(ScaffoldGSConfig())
    loaded.load(tmp_path, device="cpu")
    np.testing.assert_array_equal(loaded.render(train_set.views[0], 0).rgb, first)


@pytest.mark.parametrize("preset", SPEC.presets)
def test_every_preset_builds(preset: str) -> None:
    assert build_config(SPEC, preset=preset).base_dim == 32


def test_appearance_of_each_image_is_rendered_with_its_mean(train_set: TrainingSet) -> None:
    made = ScaffoldGS(ScaffoldGSConfig(**GROWING, appearance_dim=8))
    made.setup(train_set, seed=0, device="cpu")
    start = made.model.global_features.detach().clone()
    assert start.shape == (len(train_set.views), 8)
    made.step(0, 0.0)
    moved = (made.model.global_features != start).any(dim=1)
    assert moved.sum() == 1, "a step trains the vector of its image alone"
    with torch.no_grad():
        image = made.render(train_set.views[0], 0).rgb
        made.model.global_features.copy_(made.model.global_features.mean(dim=0).expand_as(start))
        np.testing.assert_allclose(made.render(train_set.views[0], 0).rgb, image, atol=1e-6)


def test_appearance_of_a_period_is_chronogs_without_features_that_vary(
    train_set: TrainingSet,
) -> None:
    views = tuple(replace(view, period=i % 2) for i, view in enumerate(train_set.views))
    two = replace(train_set, views=views, num_periods=2, point_periods=np.ones((50, 2), bool))
    ours = ScaffoldGSPeriod(ScaffoldGSConfig(**GROWING, appearance_dim=8))
    theirs = ChronoGS(
        ChronoGSConfig(**GROWING, base_dim=32, period_dim=0, global_dim=8, global_heads=("color",))
    )
    for made in (ours, theirs):
        made.setup(two, seed=7, device="cpu")
        for index in range(20):
            made.step(index, index / 20)
    for name, tensor in ours.model.tensors().items():
        assert torch.equal(tensor, theirs.model.tensors()[name]), name
    images = [ours.render(two.views[0], period).rgb for period in (0, 0.5, 1)]
    assert not np.array_equal(images[0], images[2])
    np.testing.assert_array_equal(images[1], theirs.render(two.views[0], 0.5).rgb)


def test_vectors_of_other_images_start_at_the_mean_by_which_views_are_rendered(train_set):
    method = ScaffoldGS(ScaffoldGSConfig(**GROWING, appearance_dim=8))
    method.setup(train_set, seed=0, device="cpu")
    for i in range(6):
        method.step(i, i / 20)
    before = method.render(train_set.views[0], 0.0).rgb
    method.extend(replace(train_set, views=train_set.views[:2]))
    assert method.model.global_features.shape == (2, 8)
    np.testing.assert_allclose(method.render(train_set.views[0], 0.0).rgb, before, atol=1e-6)
    method.step(0, 0.0)
