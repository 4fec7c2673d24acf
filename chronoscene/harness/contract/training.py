"""Rules for training: it learns, is deterministic, and keeps to its training set."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from chronoscene.harness.contract import tiny_training
from chronoscene.harness.contract.subject import (
    NotApplicableError,
    Subject,
    contents,
    demand,
    same_files,
)
from chronoscene.harness.train import painted_balls
from chronoscene.harness.train.checks import check_prediction, check_step
from chronoscene.harness.train.loop import seed_everything
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import Method, TrainingSet, build_config, make_method

MANY_POINTS = 60_000
"""Enough for torch to split a sum over them among threads, which rounds half of such sums
otherwise."""


def training_lowers_the_loss(subject: Subject) -> None:
    """Training returns finite losses, and lowers them."""
    for i, report in enumerate(subject.reports):
        check_step(report, f"step {i}")
    losses = np.array([report.loss for report in subject.reports])
    demand(np.isfinite(losses).all(), "StepReport.loss", "finite numbers", losses)
    # Whole fours, so that a term of every fourth step counts alike in both.
    first, last = losses[:4].mean(), losses[-16:].mean()
    demand(last < 0.8 * first, "StepReport.loss", f"less than {0.8 * first:.4g} at the end", last)


def the_unit_of_the_scene_does_not_matter(subject: Subject) -> None:
    """Millimetres instead of metres change nothing.

    Presets named paper may do as papers did, paper-scaled may not.
    """
    for preset in subject.spec.presets:
        if preset.startswith("paper") and preset != "paper-scaled":
            continue
        images = []
        for scale in (0.25, 0.25e-3):
            frame = dataclasses.replace(subject.data.training_from_world, scale=scale)
            data = dataclasses.replace(subject.data, training_from_world=frame)
            config = build_config(subject.spec, preset=preset, overrides={"iterations": 3})
            method = make_method(subject.spec, config)
            seed_everything(0)
            method.setup(data, seed=0, device="cpu")
            for index in range(3):
                method.step(index, index / 3)
            images.append(method.render(data.views[0], 0.0).rgb)
        demand(
            np.array_equal(images[0], images[1]), f"preset {preset}",
            "equal images whatever TrainingSet.training_from_world.scale is",
        )  # fmt: skip


def views_are_learned_at_their_periods(subject: Subject) -> None:
    """The error on training views is well below that of the best constant image of each."""
    below_a_constant_image(subject.method, subject.data)


def below_a_constant_image(method: Method, data: TrainingSet) -> None:
    """Demand that the first and the last view of a training are learned."""
    for i in (0, len(data.views) - 1):
        view, photo = data.views[i], data.load_image(i) / 255.0
        image = method.render(view, float(view.period)).rgb
        constant = ((photo - photo.mean(axis=(0, 1))) ** 2).mean()
        error = ((image - photo) ** 2).mean()
        demand(
            error < 0.75 * constant, f"view {i}, period {view.period}",
            f"a squared error below {0.75 * constant:.4g}", f"{error:.4g}",
        )  # fmt: skip


def equal_seeds_give_equal_bytes(subject: Subject) -> None:
    """An equal seed gives equal bytes in another process, which writes nothing else.

    Also with renderings in between, and another hash seed.
    """
    root = subject.elsewhere
    same_files(
        root / "out" / subject.spec.name, subject.model, "training with equal seeds", "equal models"
    )
    left = [*(root / "cwd").iterdir(), *(root / "tmp").iterdir()]
    demand(not left, "training", "no files but those of save", left)


def threads_change_nothing(subject: Subject) -> None:
    """One and two threads give equal bytes."""
    available = at_least_two_threads()
    for threads in sorted({2, available}):
        method, reports = tiny_training.train(subject.spec, subject.data, threads=threads)
        place = f"training with {threads} threads instead of 1"
        demand(reports == subject.reports, place, "equal losses")
        same_files(subject.save(method), subject.model, place, "equal models")


def threads_change_nothing_for_many_points(subject: Subject) -> None:
    """One and two threads give equal bytes with tens of thousands of points, too.

    Torch splits a sum among threads only from some ten thousand numbers on.
    """
    at_least_two_threads()
    data, results = with_many_points(subject.data), []
    for threads in (1, 2):
        method, reports = tiny_training.train(subject.spec, data, threads=threads, steps=6)
        results.append((reports, subject.save(method)))
    (reports, model), (others, other) = results
    place = f"training with {MANY_POINTS:,} points and 2 threads instead of 1"
    demand(others == reports, place, f"losses of {reports}", others)
    same_files(other, model, place, "equal models")


def at_least_two_threads() -> int:
    """Return the number of threads there are, if a rule about them can be checked."""
    available = set_threads(None)
    if available < 2:
        raise NotApplicableError("needs two processors")
    return available


def with_many_points(data: TrainingSet) -> TrainingSet:
    """Return the set with each of its points many times, spread over the scene."""
    copies = -(-MANY_POINTS // len(data.points))
    spread = np.random.default_rng(0).normal(0, 0.1, (copies, *data.points.shape))
    points = (data.points + spread).reshape(-1, 3)[:MANY_POINTS].astype(np.float32)
    source = np.arange(MANY_POINTS) % len(data.points)
    return dataclasses.replace(
        data, points=points, colors=data.colors[source], point_periods=data.point_periods[source]
    )


def another_seed_gives_another_model(subject: Subject) -> None:
    """Another seed gives another model."""
    models = []
    for seed in (1, 0):
        method, _ = tiny_training.train(subject.spec, subject.data, seed=seed, steps=10)
        models.append(contents(subject.save(method))["model.safetensors"])
    demand(models[0] != models[1], "setup(seed=...)", "another model with another seed", "the same")


def test_photos_change_nothing(subject: Subject) -> None:
    """Photos of test views are not looked at: with others in their place, the model is the same."""
    models = []
    root = subject.folder()
    for noise in (False, True):
        data = tiny_training.training_set_on_disk(subject.spec, root, noisy_tests=noise)
        method, _ = tiny_training.train(subject.spec, data, steps=40)
        models.append(subject.save(method))
    same_files(models[0], models[1], "training", "a model that does not depend on test photos")


def the_training_set_is_left_alone(subject: Subject) -> None:
    """Training does not write into the training set."""
    _ = subject.method
    fresh = painted_balls.make_training_set(subject.data.num_periods)
    for field in ("points", "colors", "point_periods", "background"):
        same = np.array_equal(getattr(subject.data, field), getattr(fresh, field))
        demand(same, f"TrainingSet.{field}", "what it was before the training")
    for i, (a, b) in enumerate(zip(subject.data.views, fresh.views, strict=True)):
        for field in ("cam_from_world", "K"):
            same = np.array_equal(getattr(a, field), getattr(b, field))
            demand(same, f"TrainingSet.views[{i}].{field}", "what it was before the training")
        same = np.array_equal(subject.data.load_image(i), fresh.load_image(i))
        demand(same, f"TrainingSet.load_image({i})", "what it was before the training")


def one_period_is_enough(subject: Subject) -> None:
    """A scene with a single period is trained and rendered."""
    data = painted_balls.make_training_set(1)
    method, reports = tiny_training.train(subject.spec, data, steps=5)
    demand(all(np.isfinite(r.loss) for r in reports), "StepReport.loss", "finite numbers")
    check_prediction(method.render(data.views[0], 0.0), data.views[0], "one period")


def masked_pixels_change_nothing(subject: Subject) -> None:
    """Pixels that TrainingSet.load_mask ignores change nothing, and empty views are skipped."""
    models, reports = [], []
    views, total, wanted = len(subject.data.views), tiny_training.STEPS, 0
    if not subject.spec.mixes_views:
        # Passes of which about as many steps have a photo as in the training without masks, which
        # errors are held against.
        wanted = total // (views - 1)
        total = wanted * views
    for seed in (0, 1):
        data = hidden(subject.data, seed)
        method, steps = tiny_training.train(subject.spec, data, steps=total)
        models.append(subject.save(method))
        reports.append(steps)
    same_files(models[0], models[1], "masks", "a model that does not depend on ignored pixels")
    demand(reports[0] == reports[1], "masks", "losses that do not depend on ignored pixels")
    empty = sum(report.skipped == "empty" for report in reports[0])
    demand(
        empty == wanted, "StepReport.skipped", "'empty' once in each pass over the views, as one "
        "is ignored altogether; never if steps mix views", f"{empty} times",
    )  # fmt: skip
    errors = [
        np.mean([_squared_error(m, data, subject.data, i) for i in range(len(data.views) - 1)])
        for m in (subject.method, method)
    ]
    demand(
        errors[1] < 1.15 * errors[0], "masks", "about the error of a training without them",
        f"{errors[1]:.4g} instead of {errors[0]:.4g}",
    )  # fmt: skip


def hidden(data: TrainingSet, seed: int) -> TrainingSet:
    """Return the set with a rectangle of noise in every photo, which masks ignore; they also ignore
    the whole last photo."""
    mask = np.ones((painted_balls.HEIGHT, painted_balls.WIDTH), bool)
    mask[8:20, 5:18] = False
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (len(data.views), *mask.shape, 3), np.uint8)
    masks = [mask] * (len(data.views) - 1) + [np.zeros_like(mask)]
    return dataclasses.replace(
        data,
        load_image=lambda i: np.where(masks[i][..., None], data.load_image(i), noise[i]),
        load_mask=lambda i: masks[i],
    )


def _squared_error(method: Method, masked: TrainingSet, clean: TrainingSet, index: int) -> Any:
    """Mean squared error of a training view, within its mask."""
    view = clean.views[index]
    image = method.render(view, float(view.period)).rgb
    difference = image - clean.load_image(index) / 255.0
    return (difference[masked.load_mask(index)] ** 2).mean()


CHECKS = (
    training_lowers_the_loss,
    the_unit_of_the_scene_does_not_matter,
    views_are_learned_at_their_periods,
    equal_seeds_give_equal_bytes,
    threads_change_nothing,
    threads_change_nothing_for_many_points,
    another_seed_gives_another_model,
    test_photos_change_nothing,
    the_training_set_is_left_alone,
    one_period_is_enough,
    masked_pixels_change_nothing,
)
