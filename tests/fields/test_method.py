"""Small trainings of radiance fields: determinism, resumption, and what each part is for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.continual_nerf.replay import Memory
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.fields.box import box_of, contract
from chronoscene.fields.method import Drawn, FieldMethod
from chronoscene.fields.occupancy import start_occupancy
from chronoscene.fields.rays import PixelPool, view_rays
from chronoscene.harness.contract.tiny_training import make_stage
from chronoscene.harness.score.regions import left_half
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import TrainingSet, build_config, import_object, load_spec

SMALL = {"samples": 4_096, "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16}
STEPS = 12


def begun(name: str, data: TrainingSet, **options: Any) -> FieldMethod:
    spec = load_spec(name)
    config = build_config(spec, preset="fast", overrides={**SMALL, **options})
    method: FieldMethod = import_object(spec.method)(config)
    method.setup(data, seed=0, device="cpu")
    return method


def go_on(method: FieldMethod, start: int, stop: int) -> list[float]:
    return [method.step(i, i / STEPS).loss for i in range(start, stop)]


def saved(method: FieldMethod, folder: Path) -> bytes:
    folder.mkdir()
    method.save(folder)
    return (folder / "model.safetensors").read_bytes()


METHODS = ("clnerf", "cl-nerf", "neusc", "nerf-w", "ha-nerf")


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("cl-nerf", "neusc") else pytest.mark.slow) for n in METHODS],
)
def test_threads_and_an_interruption_change_nothing(name: str, tmp_path: Path) -> None:
    data = make_training_set(1 if name == "nerf-w" else 3)
    set_threads(2)
    one = begun(name, data)
    losses = go_on(one, 0, STEPS // 2)
    one.save_training(tmp_path)
    losses += go_on(one, STEPS // 2, STEPS)
    assert losses[-1] < losses[0]
    set_threads(1)
    other = begun(name, data)
    other.load_training(tmp_path)
    assert go_on(other, STEPS // 2, STEPS) == losses[STEPS // 2 :]
    assert saved(one, tmp_path / "one") == saved(other, tmp_path / "other")
    again = begun(name, data)
    go_on(again, 0, STEPS)
    assert saved(again, tmp_path / "again") == saved(one, tmp_path / "two")
    loaded: FieldMethod = type(one)(one.config)
    loaded.load(tmp_path / "one", device="cpu")
    view = data.views[0]
    assert np.array_equal(loaded.render(view, 0.0).rgb, one.render(view, 0.0).rgb)


def test_no_step_has_more_rays_than_asked_for() -> None:
    method = begun("clnerf", make_training_set(1), most_rays=20)
    drawn, draw = [], method.pool.draw
    method.pool.draw = lambda generator, count: drawn.append(count) or draw(generator, count)  # type: ignore[method-assign]
    go_on(method, 0, 3)
    assert drawn == [20, 20, 20]


def test_a_step_that_is_not_finite_changes_nothing(tmp_path: Path) -> None:
    method = begun("clnerf", make_training_set(1))
    go_on(method, 0, 1)
    before = saved(method, tmp_path / "before")
    method.loss = lambda *_: method.network.params["color.0"].sum() * float("nan")  # type: ignore[method-assign, assignment]
    report = method.step(1, 0.1)
    assert report.skipped == "not finite"
    assert "loss" in report.not_finite
    assert saved(method, tmp_path / "after") == before


def test_a_model_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    method = begun("clnerf", make_training_set(1))
    with torch.no_grad():
        method.network.params["color.0"][0, 0] = float("nan")
    method.save(tmp_path)
    with pytest.raises(CheckpointError, match=r"finite numbers .* others in 'color\.0"):
        type(method)(method.config).load(tmp_path, device="cpu")


def test_masked_photos_alone_make_a_step_empty() -> None:
    data = make_training_set(1)
    masked = replace(data, load_mask=lambda i: np.zeros(data.load_image(i).shape[:2], bool))
    assert begun("clnerf", masked).step(0, 0.0).skipped == "empty"


def test_periods_have_codes_for_geometry_and_appearance() -> None:
    method = begun("clnerf", make_training_set(3))
    params, view = method.network.params, make_training_set(3).views[0]
    go_on(method, 0, 2)

    def images() -> tuple[np.ndarray, ...]:
        a = method.render_split(view, geometry_period=0.0, appearance_period=0.0)
        b = method.render_split(view, geometry_period=0.0, appearance_period=2.0)
        c = method.render_split(view, geometry_period=2.0, appearance_period=0.0)
        assert np.array_equal(a.depth, b.depth)
        return a.rgb, b.rgb, c.rgb

    usual, repainted, moved = images()
    assert not np.array_equal(usual, repainted)
    assert not np.array_equal(usual, moved)
    with torch.no_grad():
        for name in ("geometry", "appearance"):
            params[name][:] = params[name][:1]
    usual, repainted, moved = images()
    np.testing.assert_allclose(usual, repainted, atol=1e-6)
    np.testing.assert_allclose(usual, moved, atol=1e-6)


@pytest.mark.parametrize("start", ["fresh", "warm"])
def test_a_further_period_leaves_the_earlier_ones(start: str, tmp_path: Path) -> None:
    first, second = (make_stage(i, hide_period=False) for i in range(2))
    method = begun("clnerf", first, start=start, buffer=2)
    go_on(method, 0, 2)
    before = method.render(first.views[0], 0.0).rgb
    method.extend(second)
    np.testing.assert_allclose(method.render(first.views[0], 0.0).rgb, before, atol=1e-6)
    assert len(method.pool.views) == len(first.views) + len(second.views)
    assert len(method.memory.photos) == 2  # type: ignore[attr-defined]
    table = method.network.params["table"].detach().clone()
    method.step(0, 0.0)
    # Rows that no sample reads stay, unless the network is another one.
    same = float((method.network.params["table"].detach() == table).float().mean())
    assert (same < 0.01) == (start == "fresh")


def test_what_is_replayed() -> None:
    first, second = (make_stage(i, hide_period=False) for i in range(2))
    counts = {}
    for replay in ("none", "stored", "rendered"):
        method = begun("clnerf", first, replay=replay, buffer=2)
        method.extend(second)
        counts[replay] = len(method.pool.views) - len(second.views)
    assert counts == {"none": 0, "stored": 2, "rendered": len(first.views)}


def test_replayed_rays_weigh_more_and_more_in_meil_nerf() -> None:
    first, second = (make_stage(i, hide_period=False) for i in range(2))
    method = begun("meil-nerf", first, opacity_weight=0.0)
    method.extend(second)
    rays = method.pool.draw(np.random.default_rng(0), 64)
    values = torch.zeros(64, 3)
    drawn = Drawn(values, torch.ones(64), method.background)
    squares = rays.colors.square()
    old = (rays.views < len(first.views))[:, None]
    assert 10 < int(old.sum()) < 54
    for progress, weight in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        expected = torch.where(old, weight * torch.sqrt(squares + 1e-6), squares).mean()
        assert float(method.loss(drawn, rays, progress)) == pytest.approx(float(expected), rel=1e-5)


def test_each_photo_is_kept_with_equal_probability() -> None:
    """After n photos each is in the reservoir of r with the probability r / n."""
    data = make_stage(0, hide_period=False)
    kept = np.zeros(2 * len(data.views))
    for seed in range(400):
        memory = Memory()
        memory.add(data, 4, seed)
        memory.add(data, 4, seed)
        assert len(memory.photos) == 4
        kept[list(memory.photos)] += 1
    share = kept / 400
    # Four standard deviations of a share of 0.4 in 400 draws.
    np.testing.assert_allclose(share, 4 / len(kept), atol=0.1)


def test_rays_meet_their_pixels() -> None:
    view = make_training_set(1).views[2]
    rays = view_rays(view, torch.tensor([0, 3 * view.width + 7]))
    place = (rays.origins[1] + 0.8 * rays.directions[1]).numpy()
    inside = view.cam_from_world[:3, :3] @ place + view.cam_from_world[:3, 3]
    u, v, z = view.K @ inside
    assert (u / z, v / z) == pytest.approx((7.5, 3.5), abs=1e-4)
    assert z == pytest.approx(0.8 * float(rays.depths[1]), rel=1e-5)


def test_contraction_keeps_the_cube_and_reaches_everything() -> None:
    assert contract.py_func(np.float32(0.5), np.float32(-1), np.float32(0)) == pytest.approx(
        (0.625, 0.25, 0.5)
    )
    assert contract.py_func(np.float32(1e6), np.float32(0), np.float32(0)) == pytest.approx(
        (1, 0.5, 0.5), abs=1e-5
    )


def test_occupancy_begins_where_points_are() -> None:
    data = make_training_set(1)
    box, pool = box_of(data), PixelPool(data.views, data.load_image)
    occupancy = start_occupancy(data, box, pool, 1, 32, 0.3)
    cells = ((box.to_cube(torch.from_numpy(data.points)) + 1) * 16).long().clamp(0, 31)
    assert occupancy.grids[0][0][tuple(cells.T)].double().mean() > 0.97
    assert occupancy.grids[0].double().mean() < 1


def test_points_that_are_not_finite_are_as_if_they_were_not_there() -> None:
    data = make_training_set(1)
    more = np.concatenate((data.points, np.full((1, 3), np.nan, np.float32)))
    one, two = begun("clnerf", data), begun("clnerf", replace(data, points=more))
    assert one.box == two.box
    assert torch.equal(one.occupancy.grids[0], two.occupancy.grids[0])
    assert go_on(one, 0, 2) == go_on(two, 0, 2)


def test_a_far_place_is_rendered_behind_the_box() -> None:
    """Behind everything there are samples, so that no ray is without a colour to learn."""
    method = begun("clnerf", make_training_set(1))
    view = make_training_set(1).views[0]
    rays = view_rays(view, torch.arange(4))
    samples = method.march(rays, torch.zeros_like(rays.views), torch.full((4,), 0.5))
    ends = samples.groups.starts[1:] - 1
    assert (samples.distances[ends] > 5).all()
    assert ((samples.places >= 0) & (samples.places < 1)).all()


@pytest.mark.parametrize("shift", [-3.0, 8.0])
def test_what_is_hidden_is_not_evaluated_in_renders(
    shift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = begun("clnerf", make_training_set(1))
    network, density = method.network, method.network.density
    count = 0

    def counted(places: Any, *rest: Any) -> Any:
        nonlocal count
        count += len(places)
        found, features = density(places, *rest)
        return found * float(np.exp(shift)), features

    monkeypatch.setattr(network, "density", counted)
    rays = view_rays(make_training_set(1).views[0], torch.arange(200))
    samples = method.march(rays, torch.zeros_like(rays.views), torch.full((200,), 0.5))
    codes = method.codes(rays)
    trained, far = method.draw(rays, samples, codes)
    assert count == len(samples.lengths)
    with torch.no_grad():
        rendered, near = method.draw(rays, samples, codes)
    assert torch.equal(trained.rgb, rendered.rgb)
    assert torch.equal(trained.opacities, rendered.opacities)
    assert torch.equal(far, near)
    share = count / len(samples.lengths) - 1
    assert share == 1 if shift < 0 else share < 0.5


@pytest.mark.parametrize("option", [{"finest": 2_200_000}, {"base": 1 << 22}, {"frequencies": 200}])
def test_codes_beyond_what_numbers_can_hold_are_refused(option: dict[str, int]) -> None:
    """There would be more grid points than 64 bits can number, or infinite angles."""
    (name,) = option
    with pytest.raises(ConfigError, match=f"{name}: expected a value less than or equal to"):
        build_config(load_spec("nerf"), preset="fast", overrides=option)


def test_rays_that_meet_nothing_show_the_background() -> None:
    method, view = begun("clnerf", make_training_set(1)), make_training_set(1).views[0]
    for grid in method.occupancy.grids:
        grid[:] = 0
    found = method.render(view, 0.0)
    assert found.alpha is not None
    assert not found.alpha.any()
    assert np.array_equal(found.rgb, np.broadcast_to(method.background, found.rgb.shape))


def test_a_photo_of_transient_things_alone_is_not_rendered() -> None:
    """Rendered views of NeRF-W have no transient density, whatever the head says."""
    method = begun("nerf-w", make_training_set(1))
    view = make_training_set(1).views[0]
    before = method.render(view, 0.0).rgb
    with torch.no_grad():
        method.network.params["transient.2"][:] = 5.0
    assert np.array_equal(method.render(view, 0.0).rgb, before)


def test_uncertainty_of_one_leaves_the_squared_error() -> None:
    method = begun("nerf-w", make_training_set(1), least_uncertainty=1.0, transient_weight=0.0)
    values = torch.cat((torch.rand(5, 3), torch.zeros(5, 2)), dim=1)
    drawn = Drawn(values, torch.ones(5), method.background)
    rays = method.pool.draw(np.random.default_rng(0), 5)
    error = (drawn.rgb - rays.colors).square().mean()
    assert float(method.loss(drawn, rays, 0.0)) == pytest.approx(float(error / 2 + 3), rel=1e-6)


@pytest.mark.parametrize("name", ["nerf-w-t", pytest.param("neusc", marks=pytest.mark.slow)])
def test_light_is_fitted_to_known_pixels(name: str) -> None:
    """They get the light of their photo, whatever that of its period is."""
    data = make_training_set(3)
    method = begun(name, data)
    go_on(method, 0, STEPS)
    view, known = data.views[0], left_half(data.views[0].height, data.views[0].width)
    dark = (0.3 * data.load_image(0)).astype(np.uint8)
    errors = [
        np.square(model.render(view, 0.0).rgb - dark / 255.0)[known].mean()
        for model in (method, method.fitted_to(view, 0.0, dark, known))  # type: ignore[attr-defined]
    ]
    assert errors[1] < 0.7 * errors[0]
    assert method.light is None  # type: ignore[attr-defined]
