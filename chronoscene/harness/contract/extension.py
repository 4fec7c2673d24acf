"""Rules for methods that learn one period after the other."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from chronoscene.harness.contract import tiny_training
from chronoscene.harness.contract.subject import (
    PAUSE,
    NotApplicableError,
    Subject,
    demand,
    go_on,
    same_files,
)
from chronoscene.harness.contract.training import below_a_constant_image
from chronoscene.methods import Method, TrainingSet, has_function


def a_further_period_is_learned(subject: Subject) -> None:
    """A method that can be extended learns a further period from the views of that period alone.

    What it saves then is a model of all periods so far, and a training in between can be resumed.
    """
    if not has_function(subject.spec, "extend"):
        raise NotApplicableError("the method has no extend")
    hide = subject.spec.period_input == "none"
    first, second, third = (tiny_training.make_stage(i, hide_period=hide) for i in range(3))
    method, between, folder = subject.begun(first), subject.folder(), subject.folder()
    go_on(method, 0)
    if subject.spec.resumable:
        method.save_training(between)
    method.extend(second)
    go_on(method, 0, PAUSE)
    if subject.spec.resumable:
        method.save_training(folder)
    reports = go_on(method, PAUSE)
    below_a_constant_image(method, second)
    model = subject.save(method)
    if subject.spec.resumable:
        again = subject.begun(first)
        again.load_training(between)
        again.extend(second)
        again.load_training(folder)
        demand(go_on(again, PAUSE) == reports, "steps after extend and load_training", "the same")
        same_files(subject.save(again), model, "training after extend", "equal models")
    before = _images(method, second)
    method.extend(third)
    change = np.abs(_images(method, second) - before).max()
    demand(
        hide or change < 1e-4,
        "extend",
        "no other images of the periods so far",
        f"{change:.3g} off",
    )
    saved, loaded = subject.save(method), subject.fresh()
    periods = json.loads((saved / "model.json").read_text())["num_periods"]
    demand(periods == third.num_periods, "model.json: num_periods", "that of extend", periods)
    loaded.load(saved, device="cpu")
    same = np.array_equal(_images(method, third), _images(loaded, third))
    demand(same, "Prediction.rgb after extend and load", "equal pixels")


def _images(method: Method, train: TrainingSet) -> NDArray[np.float32]:
    """Render a view at all periods so far. [T, H, W, 3]"""
    return np.stack([method.render(train.views[0], float(i)).rgb for i in range(train.num_periods)])


CHECKS = (a_further_period_is_learned,)
