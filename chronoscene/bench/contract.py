"""What every method must do, so that the harness need not know which one it drives.

`CHECKS` has one function for each rule; ``chronoscene check-method`` calls all of them, and so do
our tests for the methods that come with ChronoScene. Methods are trained on painted balls,
`chronoscene.bench.tiny_training`, on a CPU.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from chronoscene.bench import tiny_training
from chronoscene.bench.returned import check_prediction, check_size, check_step, refuse
from chronoscene.errors import CheckpointError, ChronoSceneError
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import (
    Method,
    MethodSpec,
    Prediction,
    StepReport,
    TrainingSet,
    View,
    build_config,
    import_object,
    load_spec,
)

HEAVY = {"torch", "numba", "open3d", "cv2", "matplotlib", "pycolmap"}
"""Modules that listing the methods must not import."""
PAUSE = 63
"""Steps after which a training is interrupted; densification has begun by then."""


class NotApplicableError(Exception):
    """A check that says nothing of this method, and why."""


@dataclass
class Subject:
    """A method that is checked: trained once, and kept with what it saved."""

    name: str
    """What `load_spec` takes."""
    scratch: Path
    """Folder for what checks write."""

    @cached_property
    def spec(self) -> MethodSpec:
        return load_spec(self.name)

    @cached_property
    def data(self) -> TrainingSet:
        return tiny_training.make_training_set(tiny_training.periods_for(self.spec))

    @cached_property
    def _trained(self) -> tuple[Method, list[StepReport]]:
        return tiny_training.train(self.spec, self.data)

    @property
    def method(self) -> Method:
        """After the training; not to be trained further."""
        return self._trained[0]

    @property
    def reports(self) -> list[StepReport]:
        """What its steps returned."""
        return self._trained[1]

    @cached_property
    def model(self) -> Path:
        """Folder of the saved model."""
        return self.save(self.method)

    @cached_property
    def interrupted(self) -> Path:
        """Folder of a training that was saved after `PAUSE` steps."""
        if not self.spec.resumable:
            raise NotApplicableError("the method cannot be resumed")
        method = self.begun()
        go_on(method, 0, PAUSE)
        folder = self.folder()
        method.save_training(folder)
        return folder

    def folder(self) -> Path:
        """A new empty folder."""
        return Path(mkdtemp(dir=self.scratch))

    def fresh(self) -> Method:
        """A method that knows nothing yet."""
        method: Method = import_object(self.spec.method)(tiny_training.small_config(self.spec))
        return method

    def begun(self) -> Method:
        """A method before its first step."""
        method = self.fresh()
        method.setup(self.data, seed=0, device="cpu")
        return method

    def loaded(self) -> Method:
        """A new method that has read the saved model."""
        method = self.fresh()
        method.load(self.model, device="cpu")
        return method

    def resumed(self, folder: Path) -> Method:
        """A new method that has read the training in a folder."""
        method = self.begun()
        method.load_training(folder)
        return method

    def save(self, method: Method) -> Path:
        """Save a model into a new folder."""
        folder = self.folder()
        method.save(folder)
        return folder


def go_on(method: Method, start: int, stop: int = tiny_training.STEPS) -> list[StepReport]:
    """Some steps of the training on painted balls."""
    return [method.step(i, i / tiny_training.STEPS) for i in range(start, stop)]


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def resized(view: View, width: int, height: int) -> View:
    """The same view at another size."""
    scale = np.diag([width / view.width, height / view.height, 1.0])
    return View(scale @ view.K, width, height, view.cam_from_world)


def demand(met: Any, place: str, expected: str, found: object = "something else") -> None:
    """Raise a `MethodError` unless a condition is met."""
    if not met:
        raise refuse(place, expected, found)


def same_files(one: Path, other: Path, place: str, expected: str) -> None:
    """Demand that two folders have the same files, byte for byte."""
    a, b = contents(one), contents(other)
    differ = sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
    demand(not differ, place, expected, f"a difference in {', '.join(differ)}")


Check = Callable[[Subject], None]
CHECKS: list[Check] = []
"""In the order in which they are run. The docstring of each is the rule."""


def check(function: Check) -> Check:
    """Add a function to `CHECKS`."""
    CHECKS.append(function)
    return function


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found."""

    rule: str
    problem: str | None = None
    """Why the method fails; None if it passes, or was not checked."""
    left_out: str | None = None
    """Why the rule says nothing of the method."""


def check_method(name: str, checks: Sequence[Check] = CHECKS) -> Iterator[Finding]:
    """Check a method; yields what each check found, as soon as it is known.

    Raises:
        ConfigError: If there is no such method.
        MethodError: If it is another program, which has no class to check.
    """
    with TemporaryDirectory() as folder:
        subject = Subject(name, Path(folder))
        demand(subject.spec.runner is None, name, "a method with a class", "another program")
        for function in checks:
            rule, *_ = (function.__doc__ or "").split(".\n")
            rule = " ".join(rule.split()).rstrip(".")
            try:
                function(subject)
                yield Finding(rule)
            except NotApplicableError as reason:
                yield Finding(rule, left_out=str(reason))
            except ChronoSceneError as error:
                yield Finding(rule, str(error))
            except Exception as error:  # of the method; the other rules may still say something
                yield Finding(rule, f"{type(error).__name__}: {error}")


# What it is


@check
def spec_is_plain_data(subject: Subject) -> None:
    """The spec is plain data with known values."""
    spec = subject.spec
    text = json.dumps(dataclasses.asdict(spec))
    name = spec.name if ":" in subject.name else subject.name
    demand(json.loads(text)["name"] == spec.name == name, "MethodSpec.name", name, spec.name)
    for field in ("title", "paper", "licence"):
        demand(getattr(spec, field), f"MethodSpec.{field}", "a text", "none")
    inputs = ("none", "label", "continuous")
    demand(
        spec.period_input in inputs, "MethodSpec.period_input", " or ".join(inputs),
        spec.period_input,
    )  # fmt: skip
    outputs = {"rgb", "alpha", "depth"}
    demand(
        {"rgb"} <= set(spec.outputs) <= outputs, "MethodSpec.outputs",
        "rgb, and alpha and depth where it has them", spec.outputs,
    )  # fmt: skip
    demand(
        spec.devices and set(spec.devices) <= {"cpu", "cuda"}, "MethodSpec.devices",
        "cpu, cuda, or both", spec.devices,
    )  # fmt: skip


@check
def spec_imports_nothing_heavy(subject: Subject) -> None:
    """Loading the spec imports nothing heavy: torch belongs into the module of the class."""
    code = (
        "import sys; from chronoscene.methods import load_spec\n"
        f"load_spec({subject.name!r})\n"
        f"print(*sorted({HEAVY!r} & set(sys.modules)))"
    )
    done = _python("-c", code)
    demand(done.returncode == 0, subject.name, "a spec that can be imported", done.stderr.strip())
    demand(not done.stdout.strip(), subject.name, "a light import", done.stdout.strip())


@check
def presets_build_a_frozen_config(subject: Subject) -> None:
    """Presets balanced and fast exist, and each builds a frozen config with iterations."""
    spec = subject.spec
    for preset in ("balanced", "fast"):
        demand(preset in spec.presets, "MethodSpec.presets", f"a preset {preset}", [*spec.presets])
    for preset in spec.presets:
        config = build_config(spec, preset=preset)
        place = f"{type(config).__name__}, preset {preset}"
        number = getattr(config, "iterations", None)
        demand(
            isinstance(number, int) and number > 0, f"{place}: iterations", "a positive integer",
            number,
        )  # fmt: skip
        demand(json.loads(json.dumps(dataclasses.asdict(config))), place, "what JSON can hold")
        try:
            config.iterations = 1
        except dataclasses.FrozenInstanceError:
            continue
        raise refuse(place, "a frozen dataclass", "one that can be changed")


# Training


@check
def training_lowers_the_loss(subject: Subject) -> None:
    """Training returns finite losses, and lowers them."""
    for i, report in enumerate(subject.reports):
        check_step(report, f"step {i}")
    losses = np.array([report.loss for report in subject.reports])
    demand(np.isfinite(losses).all(), "StepReport.loss", "finite numbers", losses)
    first, last = losses[:5].mean(), losses[-15:].mean()
    demand(last < 0.8 * first, "StepReport.loss", f"less than {0.8 * first:.4g} at the end", last)


@check
def the_unit_of_the_scene_does_not_matter(subject: Subject) -> None:
    """Millimetres instead of metres change nothing; presets named paper may do as papers did."""
    for preset in subject.spec.presets:
        if preset.startswith("paper"):
            continue
        images = []
        for scale in (0.25, 0.25e-3):
            frame = dataclasses.replace(subject.data.training_from_world, scale=scale)
            data = dataclasses.replace(subject.data, training_from_world=frame)
            config = build_config(subject.spec, preset=preset, overrides={"iterations": 3})
            method = import_object(subject.spec.method)(config)
            tiny_training.seed_everything(0)
            method.setup(data, seed=0, device="cpu")
            for index in range(3):
                method.step(index, index / 3)
            images.append(method.render(data.views[0], 0.0).rgb)
        demand(
            np.array_equal(*images), f"preset {preset}",
            "equal images whatever TrainingSet.training_from_world.scale is",
        )  # fmt: skip


@check
def views_are_learned_at_their_periods(subject: Subject) -> None:
    """The error on training views is well below that of the best constant image of each."""
    for i in (0, len(subject.data.views) - 1):
        view, photo = subject.data.views[i], subject.data.load_image(i) / 255.0
        image = subject.method.render(view, float(view.period)).rgb
        constant = ((photo - photo.mean(axis=(0, 1))) ** 2).mean()
        error = ((image - photo) ** 2).mean()
        demand(
            error < 0.75 * constant, f"view {i}, period {view.period}",
            f"a squared error below {0.75 * constant:.4g}", f"{error:.4g}",
        )  # fmt: skip


@check
def equal_seeds_give_equal_bytes(subject: Subject) -> None:
    """An equal seed gives equal bytes in another process, which writes nothing else.

    Also with renderings in between, and another hash seed.
    """
    root = subject.folder()
    out, cwd, tmp = (root / name for name in ("out", "cwd", "tmp"))
    for folder in (out, cwd, tmp):
        folder.mkdir()
    done = _python(
        "-m", "chronoscene.bench.tiny_training", subject.name, str(out), cwd=cwd,
        PYTHONHASHSEED="77", TMPDIR=str(tmp),
    )  # fmt: skip
    demand(done.returncode == 0, "training in another process", "success", done.stderr.strip())
    same_files(out, subject.model, "training with equal seeds", "equal models")
    left = [*cwd.iterdir(), *tmp.iterdir()]
    demand(not left, "training", "no files but those of save", left)


@check
def threads_change_nothing(subject: Subject) -> None:
    """One and two threads give equal bytes."""
    available = set_threads(None)
    if available < 2:
        raise NotApplicableError("needs two processors")
    # The model of the subject was trained with all threads there are.
    _ = subject.model
    for threads in {1, 2} - {available}:
        method, reports = tiny_training.train(subject.spec, subject.data, threads=threads)
        place = f"training with {threads} of {available} threads"
        demand(reports == subject.reports, place, "equal losses")
        same_files(subject.save(method), subject.model, place, "equal models")


@check
def another_seed_gives_another_model(subject: Subject) -> None:
    """Another seed gives another model."""
    models = []
    for seed in (1, 0):
        method, _ = tiny_training.train(subject.spec, subject.data, seed=seed, steps=10)
        models.append(contents(subject.save(method))["model.safetensors"])
    demand(models[0] != models[1], "setup(seed=...)", "another model with another seed", "the same")


@check
def test_photos_change_nothing(subject: Subject) -> None:
    """Photos of test views are not looked at: with others in their place, the model is the same."""
    models = []
    root = subject.folder()
    for noise in (False, True):
        data = tiny_training.training_set_on_disk(subject.spec, root, noisy_tests=noise)
        method, _ = tiny_training.train(subject.spec, data, steps=40)
        models.append(subject.save(method))
    same_files(models[0], models[1], "training", "a model that does not depend on test photos")


@check
def the_training_set_is_left_alone(subject: Subject) -> None:
    """Training does not write into the training set."""
    _ = subject.method
    fresh = tiny_training.make_training_set(subject.data.num_periods)
    for field in ("points", "colors", "point_periods", "background"):
        same = np.array_equal(getattr(subject.data, field), getattr(fresh, field))
        demand(same, f"TrainingSet.{field}", "what it was before the training")
    for i, (a, b) in enumerate(zip(subject.data.views, fresh.views, strict=True)):
        for field in ("cam_from_world", "K"):
            same = np.array_equal(getattr(a, field), getattr(b, field))
            demand(same, f"TrainingSet.views[{i}].{field}", "what it was before the training")
        same = np.array_equal(subject.data.load_image(i), fresh.load_image(i))
        demand(same, f"TrainingSet.load_image({i})", "what it was before the training")


@check
def one_period_is_enough(subject: Subject) -> None:
    """A scene with a single period is trained and rendered."""
    data = tiny_training.make_training_set(1)
    method, reports = tiny_training.train(subject.spec, data, steps=5)
    demand(all(np.isfinite(r.loss) for r in reports), "StepReport.loss", "finite numbers")
    check_prediction(method.render(data.views[0], 0.0), data.views[0], "one period")


@check
def masked_pixels_change_nothing(subject: Subject) -> None:
    """What TrainingSet.load_mask ignores does not change the model, and empty views are skipped."""
    models, reports = [], []
    for seed in (0, 1):
        data = hidden(subject.data, seed)
        method, told = tiny_training.train(subject.spec, data)
        models.append(subject.save(method))
        reports.append(told)
    same_files(models[0], models[1], "masks", "a model that does not depend on ignored pixels")
    demand(reports[0] == reports[1], "masks", "losses that do not depend on ignored pixels")
    empty = sum(report.skipped == "empty" for report in reports[0])
    demand(
        empty == tiny_training.STEPS // len(subject.data.views), "StepReport.skipped",
        "'empty' once in each pass over the views: one is ignored altogether", f"{empty} times",
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
    """The set with a rectangle of noise in every photo, which the masks ignore as they ignore one
    photo altogether."""
    mask = np.ones((tiny_training.HEIGHT, tiny_training.WIDTH), bool)
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
    """Of a training view, where its mask lets it count."""
    view = clean.views[index]
    image = method.render(view, float(view.period)).rgb
    difference = image - clean.load_image(index) / 255.0
    return (difference[masked.load_mask(index)] ** 2).mean()


# Saving, loading, resuming


@check
def a_model_is_two_files(subject: Subject) -> None:
    """A saved model is model.safetensors and model.json, which names method, periods and frame."""
    files = contents(subject.model)
    wanted = {"model.safetensors", "model.json"}
    demand(set(files) == wanted, "save", "the files model.safetensors and model.json", [*files])
    document = json.loads(files["model.json"])
    frame = subject.data.training_from_world.to_matrix()
    for key, value in (
        ("method", subject.spec.name),
        ("num_periods", subject.data.num_periods),
        ("training_from_world", frame.tolist()),
    ):
        found = document.get(key)
        demand(np.array_equal(found, value), f"model.json: {key}", str(value), found)
    arrays = _tensors(subject.model).values()
    demand(
        arrays and all(np.isfinite(a).all() for a in arrays if a.dtype.kind == "f"),
        "model.safetensors", "finite tensors",
    )  # fmt: skip


@check
def loading_unpickles_nothing(subject: Subject) -> None:
    """Loading unpickles nothing."""
    import torch

    def forbidden(*args: Any, **kwargs: Any) -> None:
        raise refuse("load", "no use of pickle or torch.load", "a call of it")

    _ = subject.model
    with (
        patch.object(torch, "load", forbidden),
        patch.object(pickle, "load", forbidden),
        patch.object(pickle, "loads", forbidden),
    ):
        subject.loaded()


@check
def saving_again_gives_equal_bytes(subject: Subject) -> None:
    """Saving again gives the same bytes."""
    same_files(subject.save(subject.method), subject.model, "save", "equal bytes the second time")


@check
def a_loaded_model_is_the_same(subject: Subject) -> None:
    """A loaded model renders equal pixels, has the same size and saves equal bytes."""
    loaded = subject.loaded()
    for view in subject.data.views[::4]:
        for period in range(subject.data.num_periods):
            a = subject.method.render(view, float(period))
            b = loaded.render(view, float(period))
            for field in ("rgb", "alpha", "depth"):
                same = np.array_equal(getattr(a, field), getattr(b, field))
                demand(same, f"Prediction.{field} after load", "equal pixels", "others")
    sizes = subject.method.size(), loaded.size()
    demand(sizes[0] == sizes[1], "size after load", str(sizes[0]), sizes[1])
    same_files(subject.save(loaded), subject.model, "save after load", "equal bytes")


@check
def a_resumed_training_ends_the_same(subject: Subject) -> None:
    """A training that is saved and loaded goes on to the bytes of an undisturbed one."""
    method, again = subject.resumed(subject.interrupted), subject.folder()
    method.save_training(again)
    same_files(again, subject.interrupted, "save_training after load_training", "equal bytes")
    reports = go_on(method, PAUSE)
    demand(reports == subject.reports[PAUSE:], "steps after load_training", "equal losses")
    same_files(subject.save(method), subject.model, "training after load_training", "equal models")


@check
def a_damaged_training_is_refused(subject: Subject) -> None:
    """A damaged training is refused with a CheckpointError that names the file."""
    for name in sorted(contents(subject.interrupted)):
        folder = subject.folder()
        for file, content in contents(subject.interrupted).items():
            (folder / file).write_bytes(content[:-9] if name == file else content)
        _refuses(partial(subject.resumed, folder), "load_training", name)


@check
def a_damaged_model_is_refused(subject: Subject) -> None:
    """A model that is missing, cut off or edited is refused with a CheckpointError."""
    data = (subject.model / "model.safetensors").read_bytes()
    edited = data[:-1] + bytes([data[-1] ^ 1])
    for changed in (None, data[: len(data) // 2], edited, b""):
        folder = subject.folder()
        for file, content in contents(subject.model).items():
            (folder / file).write_bytes(content)
        path = folder / "model.safetensors"
        path.unlink() if changed is None else path.write_bytes(changed)
        _refuses(partial(subject.fresh().load, folder, device="cpu"), "load", path.name)


def _refuses(call: Callable[[], object], place: str, file: str) -> None:
    expected = f"a CheckpointError that names a damaged {file}"
    try:
        call()
    except CheckpointError as error:
        demand(file in str(error), place, expected, error)
    except Exception as error:
        raise refuse(place, expected, f"{type(error).__name__}: {error}") from error
    else:
        raise refuse(place, expected, "no error")


# Rendering


@check
def any_size_renders(subject: Subject) -> None:
    """Images of any size are rendered, with values 0 to 1."""
    for size in ((1, 1), (17, 9), (40, 30), (101, 77)):
        view = resized(subject.data.views[0], *size)
        prediction = subject.loaded().render(view, 0.0)
        place = f"{size[0]} x {size[1]} pixels"
        check_prediction(prediction, view, place)
        rgb = prediction.rgb
        demand(
            rgb.min() >= 0 and rgb.max() <= 1, f"{place}: Prediction.rgb", "values 0 to 1",
            f"{rgb.min():.4g} to {rgb.max():.4g}",
        )  # fmt: skip


@check
def a_larger_image_shows_the_same(subject: Subject) -> None:
    """Twice the size, averaged, gives nearly the same image: K is obeyed."""
    view = subject.data.views[1]
    small = subject.method.render(view, 0.0).rgb
    large = subject.method.render(resized(view, 2 * view.width, 2 * view.height), 0.0).rgb
    averaged = large.reshape(view.height, 2, view.width, 2, 3).mean(axis=(1, 3))
    difference = np.abs(averaged - small).mean()
    demand(difference < 0.05, "Prediction.rgb at twice the size", "the same image", difference)


@check
def declared_outputs_are_there(subject: Subject) -> None:
    """Alpha and depth are there where the spec names them, and mean what they should."""
    view = subject.data.views[0]
    prediction = subject.method.render(view, 0.0)
    check_prediction(prediction, view, "render")
    for field in ("alpha", "depth"):
        value = getattr(prediction, field)
        if field in subject.spec.outputs:
            place = f"Prediction.{field}"
            demand(value is not None, place, "an array, as MethodSpec.outputs names it", "None")
            demand(value.min() >= 0, place, "nothing below 0", value.min())
    if prediction.alpha is not None:
        most = prediction.alpha.max()
        demand(0.5 < most <= 1, "Prediction.alpha", "0 to 1, and more than 0.5 somewhere", most)
    if prediction.depth is not None:
        _check_depth(prediction, view)


def _check_depth(prediction: Prediction, view: View) -> None:
    assert prediction.depth is not None
    # The balls lie within 0.7 of the origin, and the camera at distance 1 from it.
    middle = prediction.depth[view.height // 2, view.width // 2]
    demand(0.2 < middle < 1.8, "Prediction.depth", "z in units of the training frame", middle)
    if prediction.alpha is not None:
        behind = prediction.depth[prediction.alpha == 0]
        demand((behind == 0).all(), "Prediction.depth", "0 where alpha is 0")


@check
def a_view_of_nothing_is_background(subject: Subject) -> None:
    """A view of nothing shows the background."""
    view = subject.data.views[0]
    away = view.cam_from_world.copy()
    away[:3, 3] += [0.0, 0.0, -50.0]  # everything far behind
    rgb = subject.method.render(View(view.K, view.width, view.height, away), 0.0).rgb
    far = float(np.abs(rgb - subject.data.background).max())
    demand(far <= 1e-6, "Prediction.rgb of a view of nothing", "the background", f"{far:.3g} off")


@check
def periods_matter(subject: Subject) -> None:
    """Periods that differ are rendered differently, where the method takes a period."""
    if subject.spec.period_input == "none":
        raise NotApplicableError("the method takes no period")
    images = [_image(subject, float(period)) for period in range(3)]
    for a, b in ((0, 1), (1, 2)):
        change = np.abs(images[a] - images[b]).mean()
        demand(change > 1e-4, f"render at periods {a} and {b}", "different images", change)


@check
def fractional_periods_lie_between(subject: Subject) -> None:
    """Fractional periods lie between the whole ones, where the spec says continuous."""
    if subject.spec.period_input != "continuous":
        raise NotApplicableError("the method takes whole periods only")
    first, half, second = (_image(subject, period) for period in (0.0, 0.5, 1.0))
    demand(np.isfinite(half).all() and half.min() >= 0 and half.max() <= 1, "period 0.5", "0 to 1")
    for other, period in ((first, 0), (second, 1)):
        change = np.abs(half - other).mean()
        demand(change > 1e-5, "render at period 0.5", f"another image than at {period}", change)
    change = np.abs(_image(subject, 1e-4) - first).mean()
    demand(change < 0.01, "render at period 0.0001", "nearly the image of period 0", change)


def _image(subject: Subject, period: float) -> NDArray[np.float32]:
    return subject.method.render(subject.data.views[0], period).rgb


@check
def size_counts_what_is_stored(subject: Subject) -> None:
    """The size is that of the last step and of the stored tensors."""
    size = subject.method.size()
    check_size(size, "size")
    last = subject.reports[-1].primitives
    demand(size.primitives == last > 0, "MethodSize.primitives", f"{last}", size.primitives)
    stored = sum(array.size for array in _tensors(subject.model).values())
    demand(size.parameters == stored, "MethodSize.parameters", f"{stored}", size.parameters)


def _tensors(folder: Path) -> dict[str, NDArray[Any]]:
    with safe_open(folder / "model.safetensors", framework="numpy") as tensors:
        return {key: tensors.get_tensor(key) for key in tensors.keys()}  # noqa: SIM118


def _python(
    *arguments: str, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Another interpreter that finds the same modules."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment},
        capture_output=True,
        text=True,
    )
