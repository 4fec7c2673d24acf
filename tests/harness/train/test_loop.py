"""The loop: progress, probes off the clock, failures that say what happened."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
import torch

from chronoscene.harness.plan.parts import make_parts
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train.checks import MethodError
from chronoscene.harness.train.loop import (
    NOT_FINITE_LIMIT,
    PROBE_SHARES,
    DivergedError,
    Stopwatch,
    TrainingError,
    probe_frames,
    render_bytes,
    seed_everything,
    train,
)
from chronoscene.images.store import ImageStore
from chronoscene.methods import StepReport, import_object, load_spec
from chronoscene.metrics.psnr_ssim import psnr


def toy(name="MeanColour", **options):
    config = import_object("toy_methods:Config")(**options)
    return import_object(f"toy_methods:{name}")(config)


def run(method, part, stop, observer=lambda *step: None, **changes):
    for index in range(len(part.train.views)):
        part.train.load_image(index)  # so that no test depends on how long that takes
    truth = {f.name: (part.store.load(f), part.store.load_mask(f)) for f in part.test}
    return train(method, part, stop, truth, seed=0, device="cpu", observer=observer, **changes)


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


def test_probes_score_what_counts_of_a_view(part):
    """Half of one view, nothing of the other: which the harness then leaves out."""
    mask = np.zeros((16, 24), bool)
    mask[:8] = True
    frame = probe_frames(part)[0]
    method, photo = toy(), part.store.load(frame)
    truth = {frame.name: (photo, mask)}
    stop = StopRule(40, None)
    trained = train(method, part, stop, truth, seed=0, device="cpu", observer=lambda *step: None)
    expected = psnr(render_bytes(method, part, frame), photo, mask)
    assert trained.curve[-1].psnr == pytest.approx(expected, abs=1e-12)


def test_budgets_stop_by_the_clock(part, clock):
    method = toy()
    method.setup = clock.takes(2.0, method.setup)
    method.step = clock.takes(0.25, method.step)
    trained = run(method, part, StopRule(None, 4.9), now=clock)
    assert (trained.setup_seconds, trained.seconds, trained.iterations) == (2.0, 5.0, 12)


def test_models_that_share_a_budget_keep_it_within_a_step_each(make_scene, clock):
    scene = make_scene()
    parts = make_parts(scene, ImageStore(scene), "separate")
    seconds = []
    for part, stop in zip(parts, StopRule(None, 20.0).split(len(parts)), strict=True):
        method = toy()
        method.setup = clock.takes(1.0, method.setup)
        method.step = clock.takes(0.4, method.step)
        method.render = clock.takes(50.0, method.render)  # probes
        seconds.append(run(method, part, stop, now=clock).seconds)
    assert seconds == pytest.approx([10.2, 10.2])
    assert sum(seconds) <= 1.05 * 20.0 and clock.seconds > 700


def test_a_set_up_that_takes_the_budget_gives_no_result(part, clock):
    method = toy()
    method.setup = clock.takes(5.0, method.setup)
    message = r"time for training after the set-up, found 5 s of set-up in 4 s; .* longer --budget"
    with pytest.raises(TrainingError, match=message):
        run(method, part, StopRule(None, 4.0), now=clock)


def test_progress_follows_the_clock(part, clock):
    progress = []
    method = toy()
    step = clock.takes(0.25, method.step)
    method.step = lambda i, p: (progress.append(p), step(i, p))[1]
    run(method, part, StopRule(None, 2.0), now=clock)
    assert progress == [i / 8 for i in range(8)]


def test_probes_observers_and_rendering_are_off_the_clock(part, clock):
    method = toy()
    method.step = clock.takes(0.25, method.step)
    method.render = clock.takes(50.0, method.render)
    observer = clock.takes(20.0, lambda *step: None)
    trained = run(method, part, StopRule(10, None), observer, now=clock)
    assert trained.seconds == 2.5 and clock.seconds > 700


def test_waiting_for_photos_is_off_the_clock_and_counted(part, clock):
    method = toy()
    method.setup = clock.waits(3.0, part.store, clock.takes(2.0, method.setup))
    method.step = clock.waits(3.0, part.store, clock.takes(0.25, method.step))
    trained = run(method, part, StopRule(10, None), now=clock)
    assert (trained.setup_seconds, trained.seconds, trained.waited_seconds) == (2.0, 4.5, 33.0)


@pytest.mark.parametrize(
    ("computed", "seconds"), [(0.5, 2.5), (4.0, 42.25)], ids=["stopped", "computing"]
)
def test_a_pause_of_the_process_is_off_the_clock_and_counted(part, clock, computed, seconds):
    method, work = toy(), type(clock)()
    usual = work.takes(0.25, clock.takes(0.25, method.step))
    long = work.takes(computed, clock.takes(40.0, method.step))
    method.step = lambda index, progress: (long if index == 6 else usual)(index, progress)
    trained = run(method, part, StopRule(10, None), now=clock, computed=work)
    assert (trained.seconds, trained.waited_seconds) == (seconds, 42.25 - seconds)


def test_the_clock_is_that_of_the_machine(part):
    trained = run(toy(sleep=0.01), part, StopRule(None, 0.05))
    assert trained.seconds >= 0.05 and 1 <= trained.iterations <= 5


def test_whichever_limit_is_first(part, clock):
    method = toy()
    method.step = clock.takes(0.25, method.step)
    assert run(method, part, StopRule(5, 60.0), now=clock).iterations == 5
    assert run(method, part, StopRule(10**6, 1.0), now=clock).iterations == 4


def reporting(skipped_at, loss=math.nan, skipped="not finite", primitives=1):
    """A method that reports some of its steps as skipped."""
    method = toy()
    step = method.step

    def reported(index, progress):
        names = ("means",) if skipped == "not finite" else ()
        report = StepReport(loss, primitives, skipped, names)
        return report if index in skipped_at else step(index, progress)

    method.step = reported
    return method


def test_steps_that_taught_nothing_are_counted(part):
    trained = run(reporting({3, 4, 9}), part, StopRule(20, None))
    assert (trained.iterations, trained.empty_steps, trained.skipped_steps) == (20, 0, 3)
    trained = run(reporting(range(1, 20), 0.1, "empty"), part, StopRule(20, None))
    assert (trained.iterations, trained.empty_steps, trained.skipped_steps) == (20, 19, 0)


def of_three_views(skipped_from, skipped):
    """A method of three views to a step, which teach nothing from an iteration on."""
    method = toy()
    step = method.step

    def reported(index, progress):
        if index >= skipped_from:
            return StepReport(math.nan if skipped == "not finite" else 0.1, 1, skipped, views=3)
        return replace(step(index, progress), views=3)

    method.step = reported
    return method


def test_iterations_count_views(part):
    seen = []
    method = of_three_views(24, "empty")
    trained = run(method, part, StopRule(30, None), observer=lambda i, *rest: seen.append(i))
    assert seen == list(range(3, 31, 3))
    assert (trained.iterations, trained.empty_steps, trained.skipped_steps) == (30, 6, 0)
    with pytest.raises(DivergedError, match=r"iteration 57: .* found 51 steps in a row"):
        run(of_three_views(6, "not finite"), part, StopRule(400, None))
    with pytest.raises(TrainingError, match="found none in 60 steps; check that the sparse"):
        run(of_three_views(0, "empty"), part, StopRule(60, None))


def test_only_a_run_of_steps_that_are_not_finite_ends_the_training(part):
    often = [i for i in range(400) if i % NOT_FINITE_LIMIT]
    trained = run(reporting(often), part, StopRule(400, None))
    assert trained.skipped_steps == len(often)
    message = "iteration 57: expected a finite loss and finite gradients, found 50 steps in a row "
    message += "without, the last one in 'means'; "
    with pytest.raises(DivergedError, match=f"{message}.* model of iteration 7 is kept"):
        run(reporting(range(7, 400)), part, StopRule(400, None))


def test_a_method_that_goes_on_with_a_loss_that_is_not_finite_keeps_no_model(part):
    with pytest.raises(TrainingError, match=r"iteration 57: .*; lower the learning") as caught:
        run(reporting(range(7, 400), skipped=None), part, StopRule(400, None))
    assert not isinstance(caught.value, DivergedError)


def test_a_model_that_no_view_shows_any_more_ends_the_training(part):
    """But not one of scenes in which there is nothing to learn, nor one that some views show."""
    first = toy()
    losses = []
    run(first, part, StopRule(1, None), observer=lambda i, s, report, p: losses.append(report.loss))
    worse, better = losses[0] + 0.1, losses[0] - 0.1
    count = max(NOT_FINITE_LIMIT, 2 * len(part.train.views))
    message = f"iteration {count + 7}: expected a training view that shows .* found {count} steps"
    with pytest.raises(TrainingError, match=message):
        run(reporting(range(7, 400), worse, "empty"), part, StopRule(400, None))
    assert run(reporting(range(7, 400), better, "empty"), part, StopRule(400, None)).iterations
    often = [i for i in range(1, 400) if i % count]
    assert run(reporting(often, worse, "empty"), part, StopRule(400, None)).empty_steps


@pytest.mark.parametrize("steps", [20, 400])
def test_a_model_that_no_view_ever_showed_is_no_result(part, steps):
    count = min(steps, NOT_FINITE_LIMIT)
    with pytest.raises(TrainingError, match=f"found none in {count} steps; check that the sparse"):
        run(reporting(range(400), 0.1, "empty"), part, StopRule(steps, None))


def test_a_model_with_nothing_in_it_is_no_result(part):
    message = r"iteration 8: expected a model with something in it, found nothing left; check that"
    with pytest.raises(TrainingError, match=message):
        run(reporting({7}, 0.1, None, primitives=0), part, StopRule(20, None))


@pytest.mark.parametrize("level", [0, 255])
def test_a_model_that_is_blank_in_the_end_is_no_result(part, level):
    """But not where the photos are blank, too, nor where a view shows something."""
    method, stop = toy(rate=0.0), StopRule(20, None)
    setup = method.setup

    def blank(train, **options):
        setup(train, **options)
        method.colors[:] = level / 255

    method.setup = blank
    message = "iteration 20: expected a test view that shows .* found nothing but black or white"
    with pytest.raises(TrainingError, match=message):
        run(method, part, stop)
    photo = np.full_like(part.store.load(part.test[0]), level)
    truth = {frame.name: (photo, None) for frame in part.test}
    options = {"seed": 0, "device": "cpu", "observer": lambda *step: None}
    assert train(method, part, stop, truth, **options).iterations == 20
    method.setup = setup
    assert run(method, part, stop).iterations == 20


def test_images_that_are_not_finite_are_refused(part):
    with pytest.raises(MethodError, match=r"Prediction\.rgb: .* values that are not finite"):
        run(toy("BadImage"), part, StopRule(20, None))


def test_images_of_another_size_are_refused(part):
    method = toy()
    method.setup(part.train, seed=0, device="cpu")
    wide = import_object("toy_methods:Prediction")(np.zeros((16, 25, 3), np.float32))
    method.render = lambda view, period: wide
    found = r"shape \[16, 24, 3\], found float32 of shape \[16, 25, 3\]"
    with pytest.raises(MethodError, match=r"view a/2\.png: Prediction\.rgb: .* " + found):
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


def test_the_toys_are_specs():
    assert load_spec("toy_methods:MEAN").period_input == "label"


def test_the_stopwatch_counts_inside_only(clock):
    watch = Stopwatch(clock)
    with watch:
        clock.seconds += 2
    clock.seconds += 5
    with watch:
        clock.seconds += 3
    assert watch.seconds == 5
