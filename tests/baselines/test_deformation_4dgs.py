"""4DGS: what it follows and what it does not, its two stages, and its specification."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from moving_scene import PERIODS, arc, decibels, moving_scene
from toy_scene import EXTENT, SHORT, toy_scene, train

from baselines.deformation_4dgs import SPEC
from baselines.deformation_4dgs.config import Deformation4DGSConfig
from baselines.deformation_4dgs.field import HEADS
from baselines.deformation_4dgs.method import Deformation4DGS
from baselines.deformation_4dgs.model import find_box
from baselines.deformation_4dgs.trainer import TwoStages
from chronoscene.errors import ConfigError
from chronoscene.gaussians.model import GaussianModel
from chronoscene.methods import TrainingSet, build_config


def config(**changes: Any) -> Deformation4DGSConfig:
    """The preset for short trainings, made for the toy scene."""
    made = {"iterations": 300, "densify_interval": 25, "max_gaussians": 200, **changes}
    found: Deformation4DGSConfig = build_config(SPEC, preset="fast", overrides=made)
    return found


def jump(period: float) -> tuple[float, float, float]:
    return (0.25, -0.1, 0.0) if period < 2.2 else (-0.25, 0.1, 0.0)


@pytest.mark.parametrize("color_and_opacity", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_smooth_motion_is_followed_between_periods_and_a_jump_is_not(
    color_and_opacity: bool,
) -> None:
    """Periods 2 and 3 are on either side of the jump, which smears what is drawn between them."""
    given = config(deform_opacity=color_and_opacity, deform_color=color_and_opacity)
    whole, between = [float(p) for p in range(PERIODS)], [0.5, 1.5, 2.5, 3.5]
    smooth = moving_scene(arc)
    moving = train(smooth, given, method_class=Deformation4DGS)
    static = train(smooth, replace(SHORT, iterations=300, max_gaussians=200))
    assert decibels(moving, arc, whole) > decibels(static, arc, whole) + 3
    assert decibels(moving, arc, between) > decibels(static, arc, between) + 3
    assert decibels(moving, arc, [2.5]) > decibels(moving, arc, [2.0, 3.0]) - 1
    jumping = train(moving_scene(jump), given, method_class=Deformation4DGS)
    assert decibels(jumping, jump, [2.5]) < decibels(jumping, jump, [2.0, 3.0]) - 3


def changed_method(scene: TrainingSet, **changes: Any) -> Deformation4DGS:
    """In its second stage, with random output layers."""
    method = Deformation4DGS(config(coarse_until=0, zero_start=False, **changes))
    method.setup(scene, seed=0, device="cpu")
    method.step(0, 0.0)
    return method


def test_a_field_of_zeros_draws_the_canonical_gaussians() -> None:
    scene = toy_scene()
    method = Deformation4DGS(config())
    method.setup(scene, seed=0, device="cpu")
    method.model.is_deforming = True
    canonical = GaussianModel(method.model.parameters)
    for mine, theirs in zip(
        method.model.splats(scene.views[0], 0), canonical.splats(scene.views[0], 0), strict=True
    ):
        assert torch.equal(mine, theirs)


def test_the_first_stage_trains_static_gaussians_as_3dgs_does() -> None:
    """Until the field comes in, the same bits, growth included."""
    scene = toy_scene()
    options = {"coarse_until": 30_000, "schedule_length": 30_000, "densify_until": 15_000}
    mine = train(scene, config(**options, iterations=60), method_class=Deformation4DGS)
    theirs = train(scene, replace(SHORT, iterations=60, max_gaussians=200))
    assert len(mine.model) > 60 and not mine.model.is_deforming
    for name, tensor in theirs.model.tensors().items():
        assert torch.equal(mine.model.parameters[name], tensor), name
    start = Deformation4DGS(config())
    start.setup(scene, seed=0, device="cpu")
    for name, tensor in start.model.shared.items():
        assert torch.equal(mine.model.shared[name], tensor), name


def test_the_schedule_of_the_released_configuration() -> None:
    timeline = TwoStages(Deformation4DGSConfig())
    due = [timeline.at(i, i / 18_000) for i in range(18_000)]
    assert [d.moment for d in due] == [*range(1, 3_001), *range(1, 15_001)]
    rounds = [*range(600, 3_001, 100), *range(600, 10_000, 100)]
    assert [d.moment for d in due if d.densify] == rounds
    assert [d.moment for d in due if d.reset] == [3_000, 3_000, 6_000, 9_000]
    degrees = [d.sh_degree for d in due]
    assert [degrees.index(k) + 1 for k in range(4)] == [1, 1_000, 2_000, 3_000]
    assert degrees[3_000:] == [3] * 15_000 and due[3_000].position_lr == due[0].position_lr


def test_the_released_configuration_trains_in_both_stages() -> None:
    scene = moving_scene(arc)
    method = Deformation4DGS(Deformation4DGSConfig(coarse_until=1))
    method.setup(scene, seed=0, device="cpu")
    # 62 numbers of each Gaussian are stored there, three of them normals.
    assert sum(t[0].numel() for t in method.model.parameters.values()) == 62 - 3
    planes = [t.numel() for n, t in method.model.shared.items() if n.startswith("planes.")]
    assert sum(planes) == sum(3 * 16 * (s * s + 150 * s) for s in (64, 128))
    reports = [method.step(index, index / 3) for index in range(3)]
    assert all(np.isfinite(report.loss) for report in reports)
    assert not np.array_equal(*(method.render(scene.views[0], p).rgb for p in (0, PERIODS - 1)))


@pytest.mark.parametrize(("cells", "rows"), [(0, PERIODS), (2, 2), (9, 9)])
def test_planes_have_as_many_rows_in_time_as_asked_for(cells: int, rows: int) -> None:
    method = changed_method(moving_scene(arc), time_cells=cells)
    assert len(method.model.shared["planes.0.xt"]) == rows


def test_the_second_stage_begins_with_a_new_optimiser_and_new_statistics() -> None:
    method = Deformation4DGS(config(densify_interval=1_000, coarse_until=3_000))
    method.setup(toy_scene(), seed=0, device="cpu")
    trainer = method.trainer
    assert trainer is not None
    seen = []
    for index in range(4):
        method.step(index, 0.14 + 0.005 * index)  # The first stage ends at 0.15.
        steps = int(trainer.optimizer.state()["means.steps"])
        views = float(trainer.statistics.views.max())
        seen.append((method.model.is_deforming, steps, views))
    assert seen == [(False, 1, 1), (False, 2, 2), (True, 1, 1), (True, 2, 2)]
    assert all(int(trainer.optimizer.state()[f"{n}.steps"]) == 2 for n in method.model.shared)


def test_a_training_resumed_in_the_first_stage_stays_there(tmp_path: Path) -> None:
    methods = [Deformation4DGS(config()) for _ in range(2)]
    for method in methods:
        method.setup(toy_scene(), seed=0, device="cpu")
    methods[0].step(0, 0.0)
    methods[0].save_training(tmp_path)
    methods[1].load_training(tmp_path)
    assert not methods[1].model.is_deforming
    assert methods[0].step(1, 0.5) == methods[1].step(1, 0.5)
    assert methods[1].model.is_deforming


@pytest.mark.parametrize("progress", [0.0, 0.5])
def test_models_of_both_stages_are_saved_and_loaded(tmp_path: Path, progress: float) -> None:
    scene = moving_scene(arc)
    method = Deformation4DGS(config(zero_start=False))
    method.setup(scene, seed=0, device="cpu")
    for index in range(6):
        method.step(index, progress)
    method.save(tmp_path)
    loaded = Deformation4DGS(config())
    loaded.load(tmp_path, device="cpu")
    assert loaded.config == method.config and loaded.model.field == method.model.field
    first, last = (method.render(scene.views[0], period).rgb for period in (0, PERIODS - 1))
    assert np.array_equal(first, last) == (progress == 0)
    for period in (0, 1.3, PERIODS - 1):
        mine, theirs = (m.render(scene.views[0], period).rgb for m in (method, loaded))
        assert np.array_equal(mine, theirs)


def test_one_period_is_at_time_zero_and_others_are_evenly_spaced() -> None:
    scene = moving_scene(arc)
    assert changed_method(scene).model.times == (0, 0.25, 0.5, 0.75, 1)
    assert changed_method(scene, half_time_axis=True).model.times == (0.5, 0.625, 0.75, 0.875, 1)
    one = changed_method(toy_scene())
    assert one.model.times == (0,)
    near, far = (one.render(toy_scene().views[0], period).rgb for period in (0, 2.5))
    assert np.array_equal(near, far)


@pytest.mark.parametrize("cells", [0, 9])
def test_earlier_periods_read_the_same_rows_after_one_is_added(cells: int) -> None:
    first = changed_method(moving_scene(arc), time_cells=cells).model
    second = first.with_new_period()
    third = second.with_new_period()
    rows = first.field.time_cells
    assert len(third.shared["planes.0.xt"]) == third.field.time_cells == rows + 2
    places = [period * (rows - 1) / (PERIODS - 1) for period in range(PERIODS)]
    assert third.times == pytest.approx([place / (rows + 1) for place in (*places, rows, rows + 1)])
    for model in (second, third):
        for period in (*range(PERIODS), PERIODS):
            as_before = first.at_period(min(period, PERIODS - 1))
            for name, tensor in model.at_period(period).items():
                torch.testing.assert_close(tensor, as_before[name], msg=name)


@pytest.mark.parametrize(("half", "row"), [(False, 0), (True, 2)])
def test_where_on_the_time_axis_period_0_reads(half: bool, row: int) -> None:
    """The released code reads from the middle on; the fixed form from the first row."""
    scene = moving_scene(arc)
    method = changed_method(scene, half_time_axis=half, time_cells=5)
    model = method.model
    model.shared["planes.0.xt"].grad = None
    model.at_period(0)["means"].sum().backward()
    grad = model.shared["planes.0.xt"].grad
    assert grad is not None
    assert [bool(cells.any()) for cells in grad] == [i == row for i in range(5)]


@pytest.mark.parametrize("color", [False, True])
@pytest.mark.parametrize("opacity", [False, True])
def test_heads_change_what_they_are_for(opacity: bool, color: bool) -> None:
    scene = moving_scene(arc)
    model = changed_method(scene, deform_opacity=opacity, deform_color=color).model
    changed = model.at_period(1)
    same = {name for name, tensor in model.parameters.items() if torch.equal(changed[name], tensor)}
    heads = {name.partition(".")[0] for name in model.shared} & set(HEADS)
    left_out = {name for name, on in (("logit_opacities", opacity), ("sh", color)) if not on}
    assert heads == set(HEADS) - left_out
    colors = set() if color else {"sh_dc", "sh_rest"}
    assert same == colors | (set() if opacity else {"logit_opacities"})


def test_a_robust_box_leaves_out_points_far_away() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (1_000, 3))
    points[7] = (100, -100, 50)
    np.testing.assert_allclose(find_box(points, 0.0), (points.min(0), points.max(0)), rtol=1e-6)
    low, high = find_box(points, 0.01)
    assert max(np.abs([*low, *high])) < 1


def test_the_field_counts_in_the_unit_that_was_asked_for() -> None:
    """In world units it is trained at the extent, and moves Gaussians in the unit, of the world."""
    scene = moving_scene(arc)
    units = {unit: changed_method(scene, length_unit=unit) for unit in ("world", "training")}
    for method, extent, unit in (
        (units["world"], EXTENT / 0.2, 0.2),
        (units["training"], EXTENT, 1.0),
    ):
        assert method.trainer is not None and method.model.field.offset_unit == unit
        rates, given = method.learning_rates(method.trainer.timeline.at(0, 0.0)), config()
        assert rates["planes.0.xy"] == pytest.approx(given.plane_lr_initial * extent, rel=1e-3)
        assert rates["trunk.bias"] == pytest.approx(given.field_lr_initial * extent, rel=1e-3)
        assert rates["means"] == pytest.approx(given.position_lr_initial * EXTENT, rel=1e-3)


def test_white_is_drawn_behind_everything_where_asked(tmp_path: Path) -> None:
    scene = toy_scene()
    method = changed_method(scene, white_background=True)
    method.save(tmp_path)
    method.load(tmp_path, device="cpu")
    pose = scene.views[0].cam_from_world.copy()
    pose[2, 3] = -50.0  # everything far behind
    away = replace(scene.views[0], cam_from_world=pose)
    assert (method.render(away, 0).rgb == 1).all()


def test_what_a_gpu_runs_trains_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain torch form of the field and of its smoothness, here on a CPU in float32.

    Few steps, since Adam makes whole steps of gradients that are nothing but rounding. Those of the
    rotations of round Gaussians are, so these are not round. Images differ by 3e-7.
    """
    scene, found = moving_scene(arc), []
    for compiled in (True, False):
        if not compiled:
            plain = SimpleNamespace(has_kernels=lambda *tensors: False)
            for module in ("field", "field.smoothness"):
                monkeypatch.setattr(f"baselines.deformation_4dgs.{module}.devices", plain)
        method = Deformation4DGS(config(coarse_until=0))
        method.setup(scene, seed=0, device="cpu")
        method.model.parameters["log_scales"].data[:, 0] += 0.5
        losses = [method.step(index, 0.1).loss for index in range(3)]
        found.append((losses, method.render(scene.views[0], 1.5).rgb))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-4)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-5)


def test_the_scaled_twin_of_the_released_configuration_has_its_values() -> None:
    """The unit is another, and nothing else, until lengths are converted to the training frame."""
    paper, scaled, defaults = (
        build_config(SPEC, preset=name) for name in ("paper", "paper-scaled", "paper-defaults")
    )
    assert replace(scaled, length_unit="world") == paper
    assert scaled.in_training_frame(1 / 120) == scaled
    assert paper.in_training_frame(1 / 120).plane_lr_initial == pytest.approx(0.192)
    heads = (defaults.deform_opacity, defaults.deform_color, defaults.zero_start)
    assert heads == (False, False, False) and defaults.length_unit == "training"
    assert (defaults.iterations, defaults.time_cells, defaults.ssim_weight) == (33_000, 25, 0.0)


@pytest.mark.parametrize("preset", SPEC.presets)
def test_caps_of_the_released_code_are_in_the_presets_named_paper_alone(preset: str) -> None:
    made = build_config(SPEC, preset=preset)
    caps = (made.grow_below, made.prune_above, made.white_background, made.half_time_axis)
    assert caps == (
        (360_000, 200_000, True, True) if preset.startswith("paper") else (0, 0, False, False)
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("plane_size", 1),
        ("levels", 0),
        ("box_quantile", 0.5),
        ("time_cells", 1),
        ("ssim_weight", -0.2),
    ],
)
def test_impossible_options_are_named(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        Deformation4DGSConfig(**{name: value})
