"""CL-NeRF: what is known stays, adaptors say what has changed, and replay gives way to them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from chronoscene.errors import ConfigError
from chronoscene.fields.method import Drawn
from chronoscene.fields.mlp import make_groups
from chronoscene.harness.contract.tiny_training import make_stage
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import build_config, import_object, load_spec

SMALL = {"samples": 2_048, "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16}
FIRST, SECOND, THIRD = (make_stage(i, hide_period=False) for i in range(3))


def begun(**options: Any) -> Any:
    spec = load_spec("cl-nerf")
    method = import_object(spec.method)(
        build_config(spec, preset="fast", overrides=SMALL | options)
    )
    method.setup(FIRST, seed=0, device="cpu")
    return method


def extended(steps: int = 2, **options: Any) -> Any:
    method = begun(**options)
    method.step(0, 0.0)
    method.extend(SECOND)
    for i in range(steps):
        method.step(i, i / 10)
    return method


def field_at(method: Any, period: float) -> tuple[torch.Tensor, ...]:
    """Densities and colours at some places."""
    places = torch.rand(64, 3, generator=torch.Generator().manual_seed(0)) * 0.9
    groups, codes = make_groups(torch.tensor([0, 64])), method.view_codes(period, period)
    with torch.no_grad():
        densities, features = method.network.density(places, groups, codes.geometry)
        direction = torch.tensor([[0.0, 0.0, 1.0]])
        return densities, method.network.values(features, places, groups, direction, codes.color)


def test_what_is_known_of_earlier_periods_keeps_its_bits() -> None:
    method = extended(0)
    before = [field_at(method, 0.0)[i].clone() for i in (0, 1)]
    later = field_at(method, 1.0)[0].clone()
    for i in range(3):
        method.step(i, i / 3)
    assert all(torch.equal(a, b) for a, b in zip(before, field_at(method, 0.0), strict=True))
    assert not torch.equal(field_at(method, 1.0)[0], later)


def test_the_adaptors_of_a_period_are_those_up_to_it() -> None:
    method = extended()
    method.extend(THIRD)
    gates = method.gates(torch.tensor([0.0, 0.25, 1.0, 1.5, 2.0]))
    assert gates.tolist() == [[0, 0], [0.25, 0], [1, 0], [1, 0.5], [1, 1]]
    names = {name for name in method.network.params if name.startswith("table")}
    assert names == {"table", "table_1", "table_2"}
    assert [method.network._learns(name) for name in ("table_1", "mask_2", "color")] == [0, 1, 0]


def test_the_change_of_a_ray_is_of_its_own_period() -> None:
    """Rays of several periods in one step, as under joint, each give what they give alone."""
    method = begun()
    method.setup(make_training_set(3), seed=0, device="cpu")
    places = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * 0.9
    gates = method.gates(torch.arange(3.0))
    network, rays = method.network, make_groups(torch.tensor([0, 20, 40, 60]))
    together = network.density(places, rays, gates)[1][:, -1]
    for i in range(3):
        part, ray = places[20 * i : 20 * (i + 1)], make_groups(torch.tensor([0, 20]))
        alone = network.density(part, ray, gates[i : i + 1])[1][:, -1]
        assert torch.allclose(together[20 * i : 20 * (i + 1)], alone, atol=1e-6)
        assert bool((alone > 0).all()) == (i > 0)


def test_earlier_views_are_shown_as_views_of_the_new_period() -> None:
    method = begun()
    method.step(0, 0.0)
    known = np.rint(255 * method.render(FIRST.views[0], 0.0).rgb)
    method.extend(SECOND)
    assert method.replayed == len(FIRST.views)
    assert set(method.pool.periods.tolist()) == {1}
    width = FIRST.views[0].width
    shown = method.pool._colors[: known.shape[0] * width].reshape(known.shape)
    assert np.array_equal(shown, known)
    assert extended(0, replay="none").replayed == 0


@pytest.mark.parametrize(("change", "kept"), [(0.0, 1.0), (0.25, 0.75), (1.0, 0.0)])
def test_replay_gives_way_where_something_has_changed(change: float, kept: float) -> None:
    method = extended(0, opacity_weight=0.0, change_weight=0.0)
    rays = method.pool.draw(np.random.default_rng(0), 64)
    values = torch.cat((torch.zeros(64, 3), torch.full((64, 1), change)), dim=1)
    drawn = Drawn(values, torch.ones(64), method.background)
    old = (rays.views < method.replayed)[:, None]
    assert 10 < int(old.sum()) < 54
    squares = rays.colors.square()
    expected = float(torch.where(old, kept * squares, squares).mean())
    assert float(method.loss(drawn, rays, 0.0)) == pytest.approx(expected, rel=1e-5)


def test_colours_of_another_period_leave_the_depth() -> None:
    method, view = extended(), FIRST.views[0]
    usual = method.render(view, 0.0)
    repainted = method.render_split(view, geometry_period=0.0, appearance_period=1.0)
    assert np.array_equal(usual.depth, repainted.depth)
    assert not np.array_equal(usual.rgb, repainted.rgb)


def test_a_new_network_for_a_period_is_refused() -> None:
    with pytest.raises(ConfigError, match="start"):
        begun(start="fresh")


def test_options_without_effect_are_refused() -> None:
    """Adaptors have grids, also where the field has none."""
    spec, plain = load_spec("cl-nerf"), {"encoding": "frequencies"}
    for name, options, expected in (
        ("cl-nerf", plain | {"log2_rows": 12}, "log2_rows: expected encoding=grid"),
        ("clnerf", {"replay": "none", "replay_loss": "charbonnier"}, "expected a replay, without"),
    ):
        with pytest.raises(ConfigError, match=expected):
            build_config(load_spec(name), preset="fast", overrides=options)
    config = build_config(
        spec, preset="fast", overrides=plain | {"levels": 4, "learning_rate": 0.1}
    )
    assert config.levels == 4  # type: ignore[attr-defined]


def test_a_table_that_no_memory_holds_is_refused() -> None:
    with pytest.raises(ConfigError, match="log2_rows: expected a value less than or equal to 24"):
        begun(log2_rows=40)
