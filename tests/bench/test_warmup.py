"""The warm-up uses a method like a run does, and never stops one."""

import numpy as np
import pytest

from chronoscene.bench.protocol import EXTENT_MARGIN
from chronoscene.bench.warmup import STEPS, made_up_set, warm_up
from chronoscene.methods import import_object, load_spec
from chronoscene.scene.geometry import camera_centre


def test_a_method_is_set_up_stepped_and_rendered(monkeypatch):
    calls = []
    cls = import_object("toy_methods:MeanColour")
    step, render = cls.step, cls.render
    monkeypatch.setattr(cls, "step", lambda *a: (calls.append(a[1]), step(*a))[1])
    monkeypatch.setattr(cls, "render", lambda *a: (calls.append("render"), render(*a))[1])
    config = import_object("toy_methods:Config")()
    assert warm_up(load_spec("toy_methods:MEAN"), config, num_periods=3, device="cpu") is None
    assert calls == [*range(STEPS), "render"]


def test_slow_methods_are_cut_short(monkeypatch):
    monkeypatch.setattr("chronoscene.bench.warmup.SECONDS", 0.05)
    steps = []
    cls = import_object("toy_methods:MeanColour")
    step = cls.step
    monkeypatch.setattr(cls, "step", lambda *a: (steps.append(1), step(*a))[1])
    config = import_object("toy_methods:Config")(sleep=0.03)
    assert warm_up(load_spec("toy_methods:MEAN"), config, num_periods=1, device="cpu") is None
    assert 3 <= len(steps) <= 6


def test_what_goes_wrong_is_a_notice():
    config = import_object("toy_methods:Config")()
    notice = warm_up(load_spec("toy_methods:RAISES"), config, num_periods=1, device="cpu")
    assert "RuntimeError" in notice and "training clock" in notice


@pytest.mark.parametrize("periods", [1, 2, 50])
def test_the_made_up_set_is_a_training_set(periods):
    train = made_up_set(periods)
    assert [v.period for v in train.views] == [i // 3 for i in range(3 * periods)]
    centres = camera_centre(np.stack([v.cam_from_world for v in train.views]))
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert train.camera_extent == pytest.approx(EXTENT_MARGIN * radius)
    for i, view in enumerate(train.views):
        assert train.load_image(i).shape == (view.height, view.width, 3)
        inside = train.points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
        assert inside[:, 2].min() > 0.5
