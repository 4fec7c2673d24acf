"""NeuSC as its card defines it: geometry without time, steps, light after content."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import torch

from baselines.nerf.time import step_code
from chronoscene.errors import ConfigError
from chronoscene.fields.method import FieldMethod
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import build_config, import_object, load_spec

SMALL = {"samples": 2_048, "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16}


@pytest.fixture(scope="module")
def neusc() -> Any:
    spec = load_spec("neusc")
    method: FieldMethod = import_object(spec.method)(
        build_config(spec, preset="fast", overrides=SMALL)
    )
    method.setup(make_training_set(3), seed=0, device="cpu")
    for i in range(3):
        method.step(i, i / 3)
    return method


FLAGS = ("time", "appearance", "transient")
"""Options that make the methods of the family, in any combination that their configs allow."""


def combinations() -> Iterator[Any]:
    """All combinations: those of one method by default."""
    for name in ("nerf-w-t", "neusc", "ha-nerf-t"):
        types = get_type_hints(import_object(load_spec(name).config))
        for values in product(*(get_args(types[flag]) for flag in FLAGS)):
            marks = () if name == "neusc" else pytest.mark.slow
            yield pytest.param(name, values, id="-".join((name, *values)), marks=marks)


@pytest.mark.parametrize(("name", "values"), tuple(combinations()))
def test_flags_go_together(name: str, values: tuple[str, ...], tmp_path: Path) -> None:
    spec = load_spec(name)
    flags = dict(zip(FLAGS, values, strict=True))
    config = build_config(spec, preset="fast", overrides=SMALL | flags)
    method: FieldMethod = import_object(spec.method)(config)
    data = make_training_set(3)
    method.setup(data, seed=0, device="cpu")
    for i in range(2):
        assert method.step(i, i / 2).skipped is None
    method.save(tmp_path)
    loaded: FieldMethod = type(method)(config)
    loaded.load(tmp_path, device="cpu")
    images = [m.render(data.views[0], 1.0).rgb for m in (method, loaded)]
    assert np.array_equal(*images)


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("nerf-w", {"opacity_weight": 0.01}, "nerf-w --set opacity_weight: .* transient=none"),
        ("neusc", {"opacity_weight": 0.01}, "neusc --set opacity_weight: .* transient=none"),
        ("nerf", {"opacity_weight": 0.01, "transient": "mask"}, "nerf --set opacity_weight: "),
        ("nerf-w-t", {"time_steps": 8}, "nerf-w-t --set time_steps: expected time=steps, without"),
        ("neusc", {"time_frequencies": 2}, "neusc --set time_frequencies: .* time=frequencies"),
        ("neusc", {"content_weight": 0.5, "time": "none"}, "content_weight: expected time=steps"),
        ("neusc", {"appearance_size": 8, "appearance": "none"}, "expected a code of the light"),
        ("nerf-w", {"mask_weight": 0.1}, "mask_weight: expected transient=mask"),
        ("neusc", {"transient_size": 8}, "transient_size: expected transient=density"),
        ("neusc", {"transient_weight": 8}, "transient_weight: expected transient=density"),
        ("nerf", {"least_uncertainty": 0.2}, "least_uncertainty: expected transient=density"),
        ("ha-nerf", {"channels": 8, "appearance": "none"}, "channels: expected appearance=encoder"),
        ("nerf", {"frequencies": 4}, "frequencies: expected encoding=frequencies, without which"),
        ("nerf", {"encoding": "frequencies", "levels": 4}, "levels: expected encoding=grid"),
        ("nerf", {"time": "frequencies"}, "nerf --set time: expected 'none', found 'frequ"),
        ("nerf-w", {"time": "frequencies"}, "nerf-w --set time: expected 'none', found 'frequ"),
    ],
)
def test_options_without_effect_are_refused(name: str, given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_config(load_spec(name), preset="fast", overrides=given)
    for name, options in (
        ("nerf", {"opacity_weight": 0.01}),
        ("nerf", {"encoding": "frequencies", "frequencies": 4}),
        ("nerf-t", {"time_frequencies": 2}),
        ("neusc", {"time_steps": 8, "content_weight": 0.5, "mask_weight": 0.1}),
        ("nerf-w", {"transient_size": 8, "transient_weight": 0.1, "least_uncertainty": 0.2}),
        ("ha-nerf", {"appearance_size": 8, "channels": 8, "photo_size": 16, "code_weight": 0.1}),
    ):
        assert build_config(load_spec(name), preset="fast", overrides=options) is not None


def test_steps_are_hard_and_have_a_slope() -> None:
    centres = torch.tensor([0.2, 0.5], requires_grad=True)
    widths = torch.tensor([0.3, -0.1], requires_grad=True)
    code = step_code(torch.tensor([0.1, 0.2, 0.49, 0.5, 1.0]), centres, widths)
    assert code.tolist() == [[0, 0], [1, 0], [1, 0], [1, 1], [1, 1]]
    code.sum().backward()  # type: ignore[no-untyped-call]
    assert (centres.grad != 0).all()
    # d/du of the smooth step at t: -exp(-|t - u| / b) / (2 b).
    away = np.abs(np.array([0.1, 0.2, 0.49, 0.5, 1.0]) - 0.5) / 0.1
    assert float(centres.grad[1]) == pytest.approx(-(np.exp(-away) / 0.2).sum(), rel=1e-5)  # type: ignore[index]


def test_geometry_is_the_same_at_all_times(neusc: Any) -> None:
    view = make_training_set(3).views[0]
    images = [neusc.render(view, float(period)) for period in range(3)]
    assert np.array_equal(images[0].depth, images[2].depth)
    assert np.array_equal(images[0].alpha, images[2].alpha)
    assert not np.array_equal(images[0].rgb, images[2].rgb)


def test_a_step_between_two_periods_alters_the_later_ones_alone(neusc: Any) -> None:
    centres = neusc.network.params["step_centres"]
    before = neusc.time_code(neusc.times(torch.arange(3))).detach().clone()
    with torch.no_grad():
        old = centres[0].clone()
        centres[0] = 0.7 if before[2, 0] and old < 0.7 else 0.3
        after = neusc.time_code(neusc.times(torch.arange(3)))
        centres[0] = old
    assert torch.equal(after[:, 1:], before[:, 1:])
    assert after[0, 0] == 0
    assert after[2, 0] == 1


def test_content_switches_between_periods(neusc: Any) -> None:
    """The time code of a fractional period is that of one side; there are no shares."""
    code = neusc.time_code(neusc.times(torch.linspace(0, 2, 21))).detach()
    assert set(code.unique().tolist()) <= {0.0, 1.0}


def test_light_is_applied_after_the_content(neusc: Any) -> None:
    """Another light changes what is seen, and neither the content nor the density."""
    network, groups_of = neusc.network, import_object("chronoscene.fields.mlp:make_groups")
    places, groups = torch.rand(6, 3), groups_of(torch.tensor([0, 6]))
    _, features = network.density(places, groups, torch.zeros(1, 0))
    color = neusc.view_codes(0.0, 0.0).color
    other = color.clone()
    other[:, neusc.config.time_steps :] += 1
    direction = torch.tensor([[0.0, 0.0, 1.0]])
    one, two = (network.values(features, places, groups, direction, c) for c in (color, other))
    assert torch.equal(one[:, 3:], two[:, 3:])
    assert not torch.equal(one[:, :3], two[:, :3])


def test_the_light_of_a_view_is_the_mean_of_its_period(neusc: Any) -> None:
    lights = neusc.network.params["light_codes"]
    own = [i for i, view in enumerate(neusc.pool.views) if view.period == 1]
    found = neusc.view_codes(0.0, 1.0).color[0, neusc.config.time_steps :]
    torch.testing.assert_close(found, lights[own].mean(0))


@pytest.mark.parametrize("name", ["neusc", "nerf-w-t", "ha-nerf-t"])
def test_a_period_without_photos_has_the_mean_light_of_all(name: str, tmp_path: Path) -> None:
    spec, every = load_spec(name), make_training_set(3)
    kept = [i for i, view in enumerate(every.views) if view.period != 1]
    views = tuple(every.views[i] for i in kept)
    data = replace(every, views=views, load_image=lambda i: every.load_image(kept[i]))
    method = import_object(spec.method)(build_config(spec, preset="fast", overrides=SMALL))
    method.setup(data, seed=0, device="cpu")
    light = method.view_codes(1.0, 1.0).color[0, -method.config.appearance_size :]
    with torch.no_grad():
        every_light = method.lights(torch.arange(len(views)))
    torch.testing.assert_close(light, every_light.mean(0))
    method.save(tmp_path)
    loaded = type(method)(method.config)
    loaded.load(tmp_path, device="cpu")
    images = [m.render(views[0], 1.0).rgb for m in (method, loaded)]
    assert np.isfinite(images[0]).all() and np.array_equal(*images)


def test_sizes_are_those_of_the_card() -> None:
    spec = load_spec("neusc")
    paper = build_config(spec, preset="paper")
    assert (paper.layers, paper.hidden, paper.time_steps, paper.appearance_size) == (8, 256, 16, 48)  # type: ignore[attr-defined]
    assert paper.content_weight == 0.25  # type: ignore[attr-defined]
    clnerf = build_config(load_spec("clnerf"), preset="paper")
    assert (clnerf.levels, clnerf.log2_rows, clnerf.base) == (16, 19, 16)  # type: ignore[attr-defined]
    assert (clnerf.geometry_size, clnerf.appearance_size, clnerf.buffer) == (16, 48, 10)  # type: ignore[attr-defined]
    assert (clnerf.start, clnerf.replay) == ("fresh", "rendered")  # type: ignore[attr-defined]
