"""The warm-up runs what the training runs, within limits."""

from chronoscene.harness.train.warm_up import WARM_UP_STEPS, warm_up
from chronoscene.methods import import_object, load_spec


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


def test_slow_methods_are_cut_short(monkeypatch, clock):
    steps = []
    cls = import_object("toy_methods:MeanColour")
    step = clock.takes(1.25, cls.step)
    monkeypatch.setattr(cls, "step", lambda *a: (steps.append(1), step(*a))[1])
    config = import_object("toy_methods:Config")()
    spec = load_spec("toy_methods:MEAN")
    assert warm_up(spec, config, num_periods=1, device="cpu", now=clock) is None
    assert len(steps) == 5  # two that may compile, then three until more than three seconds passed


def test_what_goes_wrong_is_a_notice():
    config = import_object("toy_methods:Config")()
    notice = warm_up(load_spec("toy_methods:RAISES"), config, num_periods=1, device="cpu")
    assert "RuntimeError" in notice and "training clock" in notice
