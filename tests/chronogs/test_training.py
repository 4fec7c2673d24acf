"""Schedules, repeatability, saving and loading."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rounding import raise_eps
from safetensors.torch import load_file

from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.anchors.decode import unpack_bits
from chronoscene.anchors.density import DensityStatistics
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.train.checks import check_sharing
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import TrainingSet
from chronoscene.scene.similarity import Sim3
from chronoscene.training.checkpoint import save_tensors
from chronoscene.training.optimizers.adam import BETA1, BETA2
from chronoscene.training.schedules import log_linear

Make = Callable[..., ChronoGS]
GROWING = {
    "iterations": 24,
    "voxel_size": 0.02,
    "voxel_unit": "training",
    "statistics_from": 0.1,
    "density_from": 0.2,
    "density_until": 0.9,
    "density_interval": 6,
    "grad_threshold": 1e-5,
    "success_threshold": 0.3,
}


def train(made: ChronoGS, steps: int) -> ChronoGS:
    for index in range(steps):
        made.step(index, index / steps)
    return made


def test_learning_rates_at_start_middle_and_end(method: Make) -> None:
    made = method(length_unit="training")
    rates = made.rates(1.1)
    at = {name: [log_linear(p, *rate) for p in (0.0, 0.5, 1.0)] for name, rate in rates.items()}
    assert at["opacity.w1"] == pytest.approx([2e-3, 2e-4, 2e-5])
    assert at["color.b2"] == pytest.approx([8e-3, (8e-3 * 5e-5) ** 0.5, 5e-5])
    assert at["covariance.w2"] == pytest.approx([4e-3] * 3)
    assert at["offsets"] == pytest.approx([0.011, 0.0011, 0.00011])
    assert at["features"] == at["blocks"] == pytest.approx([0.0075] * 3)
    assert at["log_scales"] == pytest.approx([0.007] * 3)
    assert at["global_features"] == pytest.approx([0.05, 0.005, 0.0005])
    trained = set(made.model.tensors()) - {"anchors", "block_rows"}
    assert set(rates) == trained


@pytest.mark.parametrize("exposure", ["none", "period"])
def test_periods_share_no_block_before_any_became_one(method: Make, exposure: str) -> None:
    made = method(period_dim=5, global_dim=7, exposure=exposure)
    sharing, count = made.sharing(), len(made.model)
    assert sharing is not None and sharing.blocks == (0, 0, count)
    own = 5 * count + 7 + (12 if exposure == "period" else 0)
    assert sharing.period_numbers == (own,) * 3 and sharing.partly_shared_numbers == 0
    check_sharing(sharing, made.size(), "sharing")
    assert method(period_dim=0).sharing() is None


@pytest.mark.parametrize("cooldown", [0.0, 0.25])
def test_learning_rates_follow_the_share_that_is_done(
    method: Make, monkeypatch: pytest.MonkeyPatch, cooldown: float
) -> None:
    made = method(cooldown=cooldown)
    trainer = made.trainer
    assert trainer is not None
    optimizer, table = trainer.optimizer.adam, trainer.optimizer.tables["offsets"]
    taken: dict[str, float] = {}
    updates = optimizer.updates
    monkeypatch.setattr(optimizer, "updates", lambda rates: taken.update(rates) or updates(rates))
    for index in range(40):
        made.step(index, index / 40)
        correction = (1 - BETA1 ** (index + 1)) / (1 - BETA2 ** (index + 1)) ** 0.5
        assert table._speeds[-1] == pytest.approx(taken["offsets"] / correction)
        done = (index + 1) / 40
        factor = 0.1 ** max((done - 0.75) / 0.25, 0.0) if cooldown else 1.0
        for name in ("opacity.w1", "offsets", "global_features"):
            start, end = made.rates(1.1)[name]
            assert taken[name] == pytest.approx(start * (end / start) ** done * factor), index


def rounds(config: ChronoGSConfig, train_set: TrainingSet, total: int) -> list[int]:
    """Steps, counted from 1, after which anchors would grow, without doing the steps' work."""
    made = ChronoGS(config)
    made.setup(train_set, seed=0, device="cpu")
    trainer = made.trainer
    assert trainer is not None
    density = trainer.density
    density.statistics = object()  # type: ignore[assignment]
    density._grow = lambda statistics: None  # type: ignore[method-assign]
    density._prune = lambda statistics: None  # type: ignore[method-assign]
    return [
        index + 1
        for index in range(total)
        if density.round(index, 1, trainer._progress_after(index, 1, index / total))
    ]


def test_rounds_of_the_official_schedule(noise_set: Callable[[int], TrainingSet]) -> None:
    found = rounds(ChronoGSConfig(), noise_set(1), 40_000)
    assert (found[0], found[-1], len(found)) == (1_600, 19_900, 184)
    paper = rounds(ChronoGSConfig(first_round="at"), noise_set(1), 40_000)
    assert (paper[0], paper[-1], len(paper)) == (1_500, 19_900, 185)


def test_anchors_grow_and_only_mlps_move_in_that_step(
    noise_set: Callable[[int], TrainingSet],
) -> None:
    made = ChronoGS(ChronoGSConfig(**GROWING))
    made.setup(noise_set(2), seed=0, device="cpu")
    for index in range(11):
        made.step(index, index / 24)
    start = len(made.model)
    before = {n: t.detach().clone() for n, t in made.model.tensors().items()}
    report = made.step(11, 11 / 24)
    after = made.model.tensors()
    assert report.primitives == len(made.model) > start
    torch.testing.assert_close(after["offsets"][:start], before["offsets"], rtol=0, atol=0)
    torch.testing.assert_close(after["features"][:start], before["features"], rtol=0, atol=0)
    old, new = (at["blocks"][at["block_rows"][:start]] for at in (before, after))
    torch.testing.assert_close(new, old, rtol=0, atol=0)
    assert not torch.equal(after["opacity.w1"], before["opacity.w1"])
    assert not after["offsets"][start:].any()
    made.step(12, 12 / 24)
    assert not torch.equal(made.model.offsets[:start], before["offsets"])


def test_a_round_is_not_lost_to_an_empty_step(
    noise_set: Callable[[int], TrainingSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = _set_up(ChronoGSConfig(**GROWING), noise_set(2))
    for index in range(11):
        made.step(index, index / 24)
    start, weights = len(made.model), made.model.heads["opacity"].w1.detach().clone()
    monkeypatch.setattr(
        made.trainer.model, "visible", lambda view: torch.zeros(0, dtype=torch.int64)
    )
    report = made.step(11, 11 / 24)
    assert report.skipped == "empty" and report.primitives > start
    assert torch.equal(made.model.heads["opacity"].w1, weights)


def test_faint_anchors_go_but_never_all(noise_set: Callable[[int], TrainingSet]) -> None:
    made = _set_up(ChronoGSConfig(**GROWING), noise_set(2))
    made.step(0, 0.0)
    trainer, before = made.trainer, made.model.anchors.clone()
    assert trainer is not None
    statistics = DensityStatistics(len(before), 10)
    statistics.visits[:] = 100.0
    statistics.opacity_sum[::2] = 50.0
    with torch.no_grad():
        made.model.log_scales[0] = 3.0
    trainer.density._prune(statistics)
    torch.testing.assert_close(made.model.anchors, before[::2], rtol=0, atol=0)
    for name in ("offsets", "features", "log_scales"):
        table, tensor = trainer.optimizer.tables[name], getattr(trainer.model, name)
        assert table.value.data_ptr() == tensor.data_ptr()
        assert len(getattr(made.model, name)) == len(before[::2]) == len(statistics.visits)
    assert made.model.log_scales[0].tolist() == pytest.approx(
        [3.0] * 3
        + [0.05 + np.log(0.5)] * 3  # 0.05 in the world, of which one unit is half a one here
    )
    statistics.visits[:] = 100.0
    statistics.opacity_sum[:] = 0.0
    trainer.density._prune(statistics)
    assert len(made.model) == len(before[::2])


def _set_up(config: ChronoGSConfig, train_set: TrainingSet) -> ChronoGS:
    made = ChronoGS(config)
    made.setup(train_set, seed=3, device="cpu")
    return made


def _bytes_after_training(
    folder: Path, train_set: TrainingSet, threads: int, seed: int = 3
) -> bytes:
    folder.mkdir()
    set_threads(threads)
    made = ChronoGS(ChronoGSConfig(**GROWING))
    made.setup(train_set, seed=seed, device="cpu")
    train(made, 24).save(folder)
    return (folder / "model.safetensors").read_bytes()


def test_a_seed_gives_the_same_bytes_for_any_number_of_threads(
    noise_set: Callable[[int], TrainingSet], tmp_path: Path
) -> None:
    torch.manual_seed(0)
    one = _bytes_after_training(tmp_path / "one", noise_set(2), threads=1)
    torch.manual_seed(1)  # the global state must not matter
    np.random.seed(1)
    assert one == _bytes_after_training(tmp_path / "two", noise_set(2), threads=2)
    other = _bytes_after_training(tmp_path / "other", noise_set(2), threads=1, seed=4)
    assert one != other


def test_a_loaded_model_gives_the_same_pixels(
    noise_set: Callable[[int], TrainingSet], tmp_path: Path
) -> None:
    made = train(_set_up(ChronoGSConfig(**GROWING), noise_set(2)), 24)
    made.save(tmp_path)
    loaded = ChronoGS(ChronoGSConfig(base_dim=3))  # the stored layout counts
    loaded.load(tmp_path, device="cpu")
    for view in noise_set(2).views[:2]:
        for period in (0, 0.3, 1):
            ours, theirs = made.render(view, period), loaded.render(view, period)
            for name in ("rgb", "alpha", "depth"):
                np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert loaded.size() == made.size()
    again = tmp_path / "again"
    again.mkdir()
    loaded.save(again)
    assert (again / "model.safetensors").read_bytes() == (
        tmp_path / "model.safetensors"
    ).read_bytes()


def in_world_units(scene: TrainingSet, factor: float) -> TrainingSet:
    """A normalised set as the released code trains on it: not normalised."""
    return replace(
        scene,
        views=tuple(
            replace(v, cam_from_world=moved(v.cam_from_world, factor)) for v in scene.views
        ),
        points=scene.points * np.float32(factor),
        camera_extent=scene.camera_extent * factor,
        training_from_world=Sim3.identity(),
    )


def moved(pose: np.ndarray, factor: float) -> np.ndarray:
    return pose * np.array([1.0, 1.0, 1.0, factor])


@pytest.mark.parametrize("factor", [0.25, 8.0])
def test_the_defaults_train_as_the_released_code_does_in_world_units(
    noise_set: Callable[[int], TrainingSet], factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Near plane, offset rate, volume weight and scale bound: wrong in one, and models differ."""
    raise_eps(monkeypatch, 1e-5)  # some gradients are hardly larger than rounding
    options = GROWING | {
        "voxel_unit": "world",
        "voxel_size": 0.08 * factor,
        "near_plane": 1.9 * factor,  # cuts the nearest points off
        "scale_weight": 300.0 / factor**3,
        "max_log_scale": float(np.log(0.06 * factor)),
    }
    scene = replace(noise_set(2), training_from_world=Sim3(1 / factor, np.eye(3), np.zeros(3)))
    ours = train(_set_up(ChronoGSConfig(**options), scene), 24)
    released = train(_set_up(ChronoGSConfig(**options), in_world_units(scene, factor)), 24)
    mine, theirs = ours.model.tensors(), released.model.tensors()
    assert mine.keys() == theirs.keys()
    shift = {"anchors": (factor, 0.0), "log_scales": (1.0, np.log(factor))}
    for name, tensor in mine.items():
        scale, offset = shift.get(name, (1.0, 0.0))
        difference = tensor * scale + offset - theirs[name]
        assert difference.abs().max() < 1e-5 * max(1.0, scale), name
    bound = ours.model.log_scales[:, 3:].max().item()
    assert bound == pytest.approx(np.log(0.06), abs=0.02)  # reached, up to the steps since


def test_in_units_of_the_training_frame_the_scene_does_not_matter(
    noise_set: Callable[[int], TrainingSet],
) -> None:
    config = ChronoGSConfig(**GROWING, length_unit="training")
    large = replace(noise_set(2), training_from_world=Sim3(1e-3, np.eye(3), np.zeros(3)))
    one, two = (train(_set_up(config, scene), 24) for scene in (noise_set(2), large))
    for name, tensor in one.model.tensors().items():
        assert torch.equal(tensor, two.model.tensors()[name]), name


def test_a_near_plane_is_trained_stored_and_rendered_with(
    noise_set: Callable[[int], TrainingSet], tmp_path: Path
) -> None:
    options = GROWING | {"length_unit": "training"}
    near = train(_set_up(ChronoGSConfig(**options, near_plane=2.0), noise_set(2)), 24)
    near.save(tmp_path)
    loaded = ChronoGS(ChronoGSConfig())
    loaded.load(tmp_path, device="cpu")
    view = noise_set(2).views[0]
    ours, theirs = near.render(view, 0), loaded.render(view, 0)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert ours.depth[ours.alpha > 0].min() >= 2.0
    usual = train(_set_up(ChronoGSConfig(**options), noise_set(2)), 24).render(view, 0)
    assert usual.depth[usual.alpha > 0].min() < 2.0


def test_a_model_of_another_layout_is_refused(method: Make, tmp_path: Path) -> None:
    made = method()
    made.save(tmp_path)
    meta = json.loads((tmp_path / "model.json").read_text())
    del meta["layout"]["fusion"]
    (tmp_path / "model.json").write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match=r"model.json: layout: expected the keys .*fusion"):
        made.load(tmp_path, device="cpu")


def test_a_view_that_sees_nothing_teaches_nothing(
    noise_set: Callable[[int], TrainingSet], method: Make
) -> None:
    made = method()
    with torch.no_grad():
        made.model.anchors[:, 2] += 100.0  # behind every camera
    before = {n: t.detach().clone() for n, t in made.model.tensors().items()}
    assert made.step(0, 0.0).skipped == "empty"
    for name, tensor in made.model.tensors().items():
        torch.testing.assert_close(tensor, before[name], rtol=0, atol=0)
    prediction = made.render(noise_set(3).views[0], 1)
    np.testing.assert_allclose(prediction.rgb[0, 0], [0.1, 0.2, 0.3], atol=1e-7)


def test_what_carries_nothing_is_dropped_once_growth_is_over(
    method: Make, noise_set: Callable[[int], TrainingSet], tmp_path: Path
) -> None:
    made = method(2, unused_share=0.2, density_until=0.5)
    before = len(made.model)
    for index in range(40):
        made.step(index, index / 40)
        assert (made.model.used_offsets is None) == (index < 19)
    assert len(made.model) < before
    made.save(tmp_path)
    stored = load_file(tmp_path / "model.safetensors")
    count = int(unpack_bits(made.model.used_offsets, made.model.layout.offsets).sum())
    assert len(stored["offsets"]) == count < 10 * len(made.model)
    loaded = ChronoGS(made.config)
    loaded.load(tmp_path, device="cpu")
    view = noise_set(2).views[0]
    assert np.array_equal(loaded.render(view, 1.0).rgb, made.render(view, 1.0).rgb)
    stored["used_offsets"][0] ^= 1  # one offset more or less than there are
    save_tensors(tmp_path, stored, made.meta)
    with pytest.raises(CheckpointError, match="fit together, found RuntimeError: shape mismatch"):
        loaded.load(tmp_path, device="cpu")


def test_more_offsets_than_bits() -> None:
    with pytest.raises(ConfigError, match="offsets_per_anchor: expected at most 31 with"):
        ChronoGSConfig(unused_share=0.1, offsets_per_anchor=32)
