"""Rules for methods that learn one period after the other."""

from __future__ import annotations

import json

import numpy as np

from chronoscene.bench import tiny_training
from chronoscene.bench.contract.subject import (
    PAUSE,
    NotApplicableError,
    Subject,
    demand,
    go_on,
    same_files,
)
from chronoscene.bench.contract.training import below_a_constant_image
from chronoscene.bench.returned import check_prediction
from chronoscene.methods import Method, TrainingSet


def a_further_period_is_learned(subject: Subject) -> None:
    """A method that can be extended learns a further period from the views of that period alone.

    What it saves then is a model of both periods, and a training in between can be resumed.
    """
    first, second = _sets(subject)
    method, between, folder = _begun(subject, first), subject.folder(), subject.folder()
    go_on(method, 0)
    if subject.spec.resumable:
        method.save_training(between)
    method.extend(second)
    go_on(method, 0, PAUSE)
    if subject.spec.resumable:
        method.save_training(folder)
    reports = go_on(method, PAUSE)
    below_a_constant_image(method, second)
    check_prediction(method.render(first.views[0], 0.0), first.views[0], "the earlier period")
    model = subject.save(method)
    periods = json.loads((model / "model.json").read_text())["num_periods"]
    demand(periods == second.num_periods, "model.json: num_periods", "that of extend", periods)
    loaded, last = subject.fresh(), float(second.num_periods - 1)
    loaded.load(model, device="cpu")
    one, other = (m.render(second.views[0], last).rgb for m in (method, loaded))
    demand(np.array_equal(one, other), "Prediction.rgb after extend and load", "equal pixels")
    if subject.spec.resumable:
        again = _begun(subject, first)
        again.load_training(between)
        again.extend(second)
        again.load_training(folder)
        demand(go_on(again, PAUSE) == reports, "steps after extend and load_training", "the same")
        same_files(subject.save(again), model, "training after extend", "equal models")


def _begun(subject: Subject, train: TrainingSet) -> Method:
    """A method before its first step, if it can be extended."""
    method = subject.fresh()
    if not hasattr(method, "extend"):
        raise NotApplicableError("the method has no extend")
    method.setup(train, seed=0, device="cpu")
    return method


def _sets(subject: Subject) -> list[TrainingSet]:
    """One period, and then the other."""
    hide = subject.spec.period_input == "none"
    return [tiny_training.make_stage(period, hide_period=hide) for period in range(2)]


CHECKS = (a_further_period_is_learned,)
