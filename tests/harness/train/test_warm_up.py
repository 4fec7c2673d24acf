"""The warm-up runs what the training runs, within limits."""

import pytest

from chronoscene.harness.train.warm_up import WARM_UP_STEPS, warm_up
from chronoscene.methods import import_object, load_spec
from chronoscene.methods.options import build_config


def test_a_method_is_set_up_stepped_and_rendered(monkeypatch, clock):
    calls = []
    cls = import_object("toy_methods:MeanColour")
    step, render = cls.step, cls.render
    monkeypatch.setattr(cls, "step", lambda *a: (calls.append(a[1]), step(*a))[1])
    monkeypatch.setattr(cls, "render", lambda *a: (calls.append("render"), render(*a))[1])
    config = import_object("toy_methods:Config")()
    spec = load_spec("toy_methods:MEAN")
    assert warm_up(spec, config, num_periods=3, device="cpu", now=clock) is None
    assert calls == [*range(WARM_UP_STEPS), "render"]


def test_slow_methods_hurry_to_the_end_of_the_schedule(monkeypatch, clock):
    taken = []
    cls = import_object("toy_methods:MeanColour")
    step = clock.takes(1.25, cls.step)
    monkeypatch.setattr(cls, "step", lambda *a: (taken.append(a[1:]), step(*a))[1])
    config = import_object("toy_methods:Config")()
    spec = load_spec("toy_methods:MEAN")
    assert warm_up(spec, config, num_periods=1, device="cpu", now=clock) is None
    # Two that may compile, three until more than three seconds passed, three through the rest.
    steps, progress = zip(*taken, strict=True)
    assert steps == tuple(range(8))
    assert progress[4:] == pytest.approx([4 / 120, 42.333 / 120, 80.667 / 120, 119 / 120], rel=1e-3)


def test_slow_warm_ups_reach_what_chronogs_does_after_growth(monkeypatch, clock):
    merged = []
    module = "chronoscene.anchors.rounds.merge_alike"
    merge = import_object("chronoscene.anchors.rounds:merge_alike")
    monkeypatch.setattr(module, lambda *a: (merged.append(1), merge(*a))[1])
    cls = import_object("chronogs.method:ChronoGS")
    monkeypatch.setattr(cls, "step", clock.takes(2.0, cls.step))
    spec = load_spec("chronogs")
    config = build_config(spec, preset="fast")
    assert warm_up(spec, config, num_periods=2, device="cpu", now=clock) is None
    assert merged == [1]


def test_what_goes_wrong_is_a_notice():
    config = import_object("toy_methods:Config")()
    notice = warm_up(load_spec("toy_methods:RAISES"), config, num_periods=1, device="cpu")
    assert "RuntimeError" in notice and "training clock" in notice
