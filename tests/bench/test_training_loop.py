"""The loop: progress, probes off the clock, failures that say what happened."""

import random
import time

import numpy as np
import pytest
import torch

from chronoscene.bench.protocol import make_parts
from chronoscene.bench.stopping import StopRule
from chronoscene.bench.training_loop import (
    PROBE_SHARES,
    TrainingError,
    probe_frames,
    render_bytes,
    seed_everything,
    stop_if_orphaned,
    train,
)
from chronoscene.images.store import ImageStore
from chronoscene.methods import import_object, load_spec
from chronoscene.metrics.psnr_ssim import psnr


@pytest.fixture
def part(make_scene):
    scene = make_scene()
    return make_parts(scene, ImageStore(scene), "joint")[0]


def toy(name="MeanColour", **options):
    config = import_object("toy_methods:Config")(**options)
    return import_object(f"toy_methods:{name}")(config)


def run(method, part, stop, observer=lambda *step: None):
    truth = {f.name: part.store.load(f) for f in part.test}
    return train(method, part, stop, truth, seed=0, device="cpu", observer=observer)


def test_iterations_and_progress(part):
    seen = []
    method = toy()
    original = method.step
    method.step = lambda index, progress: (
        seen.append((index, progress)),
        original(index, progress),
    )[1]
    trained = run(method, part, StopRule(40, None))
    assert trained.iterations == 40
    assert seen == [(i, i / 40) for i in range(40)]
    assert 0 < trained.setup_seconds < trained.seconds


def test_the_toy_learns_the_colours(part):
    method = toy(rate=0.5)
    run(method, part, StopRule(60, None))
    np.testing.assert_allclose(255 * method.colors, [(200, 60, 40), (30, 90, 210)], atol=1.5)


def test_probes_come_at_fixed_shares(part):
    trained = run(toy(), part, StopRule(200, None))
    assert [p.iteration for p in trained.curve] == [round(200 * share) for share in PROBE_SHARES]
    assert all(p.model == "all" and p.primitives == 2 and p.parameters == 6 for p in trained.curve)
    seconds = [p.seconds for p in trained.curve]
    assert seconds == sorted(seconds) and seconds[-1] == trained.seconds


def test_short_trainings_are_probed_at_most_once_a_step(part):
    assert [p.iteration for p in run(toy(), part, StopRule(3, None)).curve] == [1, 2, 3]


def test_probe_values_are_psnr_of_one_view_per_period(part):
    method = toy()
    trained = run(method, part, StopRule(30, None))
    frames = probe_frames(part)
    assert [f.name for f in frames] == ["a/2.png", "b/2.png"]
    values = [psnr(render_bytes(method, part, f), part.store.load(f)) for f in frames]
    assert trained.curve[-1].psnr == pytest.approx(np.mean(values), abs=1e-12)


def test_budgets_stop_by_the_clock(part):
    started = time.perf_counter()
    trained = run(toy(sleep=0.01), part, StopRule(None, 0.3))
    assert 0.3 <= trained.seconds < 0.4
    assert 10 <= trained.iterations <= 31
    assert time.perf_counter() - started >= trained.seconds


def test_progress_follows_the_clock(part):
    progress = []
    method = toy(sleep=0.01)
    original = method.step
    method.step = lambda i, p: (progress.append(p), original(i, p))[1]
    run(method, part, StopRule(None, 0.2))
    assert progress == sorted(progress) and progress[-1] > 0.8 and max(progress) < 1


def test_probes_observers_and_rendering_are_off_the_clock(part):
    method = toy()
    original = method.render
    method.render = lambda view, period: (time.sleep(0.05), original(view, period))[1]
    trained = run(method, part, StopRule(10, None), observer=lambda *step: time.sleep(0.02))
    assert trained.seconds < 0.05


def test_whichever_limit_is_first(part):
    assert run(toy(), part, StopRule(5, 60.0)).iterations == 5
    assert run(toy(sleep=0.02), part, StopRule(10**6, 0.1)).iterations < 10


def test_a_loss_that_is_not_finite_ends_the_training(part):
    message = "model all, iteration 6: expected a finite loss, found nan"
    with pytest.raises(TrainingError, match=message):
        run(toy("NotFinite"), part, StopRule(20, None))


def test_images_that_are_not_finite_are_refused(part):
    with pytest.raises(TrainingError, match="values that are not finite"):
        run(toy("BadImage"), part, StopRule(20, None))


def test_images_of_another_size_are_refused(part):
    method = toy()
    method.setup(part.train, seed=0, device="cpu")
    wide = import_object("toy_methods:Prediction")(np.zeros((16, 25, 3), np.float32))
    method.render = lambda view, period: wide
    with pytest.raises(TrainingError, match=r"shape \[16, 24, 3\], found shape \[16, 25, 3\]"):
        render_bytes(method, part, part.test[0])


def test_seeds_reach_every_global_generator():
    def draw():
        return random.random(), np.random.random(), float(torch.rand(()))

    seed_everything(5)
    first = draw()
    seed_everything(5)
    assert draw() == first
    seed_everything(6)
    assert all(a != b for a, b in zip(draw(), first, strict=True))


def test_the_observer_sees_each_step(part):
    seen = []
    run(toy(), part, StopRule(20, None), observer=lambda *step: seen.append(step))
    assert [step[0] for step in seen] == list(range(1, 21))
    assert all(step[3] is not None for step in seen)


def test_workers_without_their_bench_end():
    stop_if_orphaned(None)
    with pytest.raises(SystemExit, match="has ended"):
        stop_if_orphaned(-1)


def test_the_toys_are_specs():
    assert load_spec("toy_methods:MEAN").period_input == "label"
