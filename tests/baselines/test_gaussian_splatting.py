"""3DGS: what it learns, and its specification."""

from dataclasses import replace

import numpy as np
import pytest
from toy_scene import SHORT, mean_squared_error, toy_scene, train

from baselines.gaussian_splatting import PERIOD_SPEC, SPEC
from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.trainer import Timeline
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import build_config, import_object


def test_it_learns_a_static_scene():
    scene = toy_scene(count=150)
    method = train(scene, replace(SHORT, iterations=600, max_gaussians=1_000))
    assert -10 * np.log10(mean_squared_error(method, scene)) > 32


@pytest.mark.slow
def test_it_learns_a_static_scene_to_35_db():
    scene = toy_scene(count=150)
    method = train(scene, replace(SHORT, iterations=1_500, densify_interval=50, max_gaussians=0))
    assert -10 * np.log10(mean_squared_error(method, scene)) > 35


def test_contradicting_periods_end_between_them():
    # One image per camera cannot be nearer to both periods than their average is; and one that
    # lies between them pixel by pixel is at most twice as far, in squares.
    scene = toy_scene(colors_per_period=2)
    images = np.stack([scene.load_image(i) / 255.0 for i in range(len(scene.views))])
    half = len(images) // 2
    average_error = np.mean((images[:half] - images[half:]) ** 2) / 4
    error = mean_squared_error(train(scene, SHORT), scene)
    assert average_error <= error < 2 * average_error


def test_every_period_renders_the_same():
    scene = toy_scene()
    method = train(scene, replace(SHORT, iterations=3))
    first, second = (method.render(scene.views[0], period).rgb for period in (0, 3))
    assert np.array_equal(first, second)


def test_equal_seeds_give_equal_bytes_for_any_number_of_threads(tmp_path):
    # Enough rows for every kernel to share its work.
    scene = toy_scene(count=3_000, views=4)
    config = replace(SHORT, iterations=40, densify_interval=10, max_gaussians=4_000)
    contents = []
    for run, (threads, seed) in enumerate([(1, 0), (2, 0), (2, 0), (2, 1)]):
        set_threads(threads)
        folder = tmp_path / str(run)
        folder.mkdir()
        train(scene, config, seed=seed).save(folder)
        contents.append((folder / "model.safetensors").read_bytes())
    assert contents[0] == contents[1] == contents[2]
    assert contents[3] != contents[0]


@pytest.mark.parametrize("preset", ["paper", "accurate", "balanced", "fast"])
def test_presets_are_configurations(preset):
    config = build_config(SPEC, preset=preset)
    assert isinstance(config, GaussianConfig)
    assert (config == GaussianConfig()) == (preset == "paper")
    assert config.max_gaussians == 0


@pytest.mark.parametrize("spec", [SPEC, PERIOD_SPEC])
@pytest.mark.parametrize(
    ("preset", "resets", "rounds"), [("accurate", 1, 39), ("balanced", 1, 15), ("fast", 0, 5)]
)
def test_short_presets_reset_while_there_is_time_to_recover(spec, preset, resets, rounds):
    config = build_config(spec, preset=preset)
    timeline = Timeline(config)
    due = [timeline.at(i, i / config.iterations) for i in range(config.iterations)]
    found = [i for i, d in enumerate(due) if d.reset]
    assert len(found) == resets and sum(d.densify for d in due) == rounds
    for i in found:
        # As published, a reset follows a round, so that the next one prunes 100 steps later; and
        # nearly as many steps are left in which the set grows as there were before.
        assert due[i - 1].densify and due[2 * i - 200].collect


def test_iterations_are_those_of_the_other_methods():
    from baselines.scaffold_gs import SPEC as ANCHORS

    for preset in ("accurate", "balanced"):
        ours, theirs = (build_config(spec, preset=preset) for spec in (SPEC, ANCHORS))
        assert ours.iterations == theirs.iterations


def test_the_class_is_found():
    assert import_object(SPEC.method) is GaussianSplatting


def test_the_variant_for_periods_renders_each_with_its_exposure():
    scene = toy_scene(colors_per_period=2)
    dark = [scene.load_image(i) // (1 + view.period) for i, view in enumerate(scene.views)]
    scene = replace(scene, load_image=dark.__getitem__, num_periods=2)
    method_class = import_object(PERIOD_SPEC.method)
    assert method_class.name == PERIOD_SPEC.name and PERIOD_SPEC.period_input == "continuous"
    config = build_config(PERIOD_SPEC, preset="fast", overrides={"iterations": 60})
    method = train(scene, config, method_class=method_class)
    levels = [method.render(scene.views[0], p).rgb.mean() for p in (0, 0.5, 1)]
    assert levels[0] > levels[1] > levels[2] and levels[2] < 0.8 * levels[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("iterations", 0), ("sh_degree", 4), ("near_plane", -1.0), ("ssim_weight", 20.0)],
)
def test_impossible_options_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        GaussianConfig(**{name: value})
