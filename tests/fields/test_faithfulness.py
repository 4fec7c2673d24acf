"""Abilities and limits of each method, on painted balls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chronoscene.fields.method import FieldMethod
from chronoscene.harness.contract.tiny_training import make_stage
from chronoscene.harness.train.painted_balls import (
    BALLS,
    make_balls,
    make_training_set,
    make_view,
    paint,
)
from chronoscene.methods import TrainingSet, TrainingView, build_config, import_object, load_spec

pytestmark = pytest.mark.slow

STEPS = 600
SMALL = {"samples": 8_192, "levels": 6, "log2_rows": 14, "finest": 128, "hidden": 32, "cells": 32}

Images = Sequence[NDArray[np.uint8]]


def trained(name: str, data: TrainingSet, steps: int = STEPS, **options: Any) -> FieldMethod:
    spec = load_spec(name)
    config = build_config(spec, preset="fast", overrides={**SMALL, "iterations": steps, **options})
    method: FieldMethod = import_object(spec.method)(config)
    method.setup(data, seed=0, device="cpu")
    for i in range(steps):
        method.step(i, i / steps)
    return method


def ring(count: int, periods: int, shift: float = 0.0) -> list[TrainingView]:
    angles = [2 * np.pi * (i + shift) / count for i in range(count)]
    return [make_view(a, p, f"{p}_{i}.png") for p in range(periods) for i, a in enumerate(angles)]


def on(views: Sequence[TrainingView], photos: Images, periods: int) -> TrainingSet:
    return replace(make_training_set(periods), views=tuple(views), load_image=lambda i: photos[i])


def squares(method: FieldMethod, views: Sequence[TrainingView], photos: Images) -> list[Any]:
    """Squared errors of the pixels of each view. [H, W, 3]"""
    shown = (method.render(view, float(view.period)).rgb for view in views)
    return [np.square(rgb - photo / 255.0) for rgb, photo in zip(shown, photos, strict=True)]


def mean_of(errors: Sequence[Any], where: Sequence[Any]) -> float:
    return float(np.concatenate([e[w].ravel() for e, w in zip(errors, where, strict=True)]).mean())


def error_of_change(name: str, *, removed: bool) -> float:
    """Error of a method in what differs at the second date: balls in other colours, or none."""
    centres, radii, colors = make_balls(2)
    kept = np.ones((2, BALLS), bool)
    if removed:
        colors[1], kept[1, ::3] = colors[0], False

    def photo(view: TrainingView, period: int) -> NDArray[np.uint8]:
        return paint(view, *(x[kept[period]] for x in (centres, radii, colors[period])))

    views, tests = ring(10, 2), [view for view in ring(10, 2, 0.5) if view.period == 1]
    method = trained(name, on(views, [photo(view, view.period) for view in views], 2))
    after, before = ([photo(view, period) for view in tests] for period in (1, 0))
    changed = [np.any(a != b, axis=2) for a, b in zip(after, before, strict=True)]
    return mean_of(squares(method, tests, after), changed)


def test_neusc_repaints_surfaces() -> None:
    """A field whose densities know the date is hardly better at it."""
    assert error_of_change("neusc", removed=False) < 1.2 * error_of_change("clnerf", removed=False)


def test_neusc_removes_nothing() -> None:
    """Its densities are those of all dates."""
    assert error_of_change("neusc", removed=True) > 1.5 * error_of_change("clnerf", removed=True)


@pytest.mark.parametrize(
    ("name", "options"), [("nerf-w", {"transient_weight": 3.0}), ("ha-nerf", {})]
)
def test_what_is_in_one_photo_alone_fades(name: str, options: dict[str, Any]) -> None:
    """Coloured rectangles, one in each photo, against the same without the transient part."""
    rng, views = np.random.default_rng(3), ring(20, 1)
    centres, radii, colors = make_balls(1)
    clean = [paint(view, centres, radii, colors[0]) for view in views]
    photos = [photo.copy() for photo in clean]
    for photo in photos:
        height, width = rng.integers(8, 14, 2)
        top, left = rng.integers(4, 28 - height), rng.integers(6, 34 - width)
        photo[top : top + height, left : left + width] = rng.integers(0, 256, 3)
    hidden = [np.any(a != b, axis=2) for a, b in zip(photos, clean, strict=True)]
    errors = [
        mean_of(squares(trained(name, on(views, photos, 1), **each), views, clean), hidden)
        for each in (options, {"transient": "none"})
    ]
    assert errors[0] < 0.92 * errors[1]


def test_replay_keeps_what_later_periods_do_not_show() -> None:
    """Fine-tuning forgets, stored photos help, renders of the model keep it near joint training."""
    stages = [make_stage(period, hide_period=False) for period in range(3)]
    first = [stages[0].load_image(i) for i in range(len(stages[0].views))]

    def decibels(method: FieldMethod) -> float:
        return -10 * float(np.log10(np.mean(squares(method, stages[0].views, first))))

    found = {}
    for replay in ("none", "stored", "rendered"):
        method = trained("clnerf", stages[0], replay=replay, buffer=2)
        found["alone"] = decibels(method)
        for stage in stages[1:]:
            method.extend(stage)
            for i in range(STEPS):
                method.step(i, i / STEPS)
        found[replay] = decibels(method)
    found["joint"] = decibels(trained("clnerf", make_training_set(3), 3 * STEPS))
    assert found["none"] < found["alone"] - 8
    assert found["none"] + 1 < found["stored"] < found["rendered"] - 3
    assert found["joint"] - 3 < found["rendered"] < found["joint"] + 0.5
