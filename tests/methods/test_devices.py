"""What a GPU runs, for every method that says it can: on a GPU, and the same code on a CPU.

On a CPU, `devices.has_kernels` is told to say no: then everything but the rasterizer is what a GPU
runs. It is compared with the compiled code.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rounding import raise_eps

from chronoscene.errors import CheckpointError
from chronoscene.fields.config import FieldConfig
from chronoscene.harness.contract import tiny_training
from chronoscene.harness.contract.subject import PAUSE
from chronoscene.harness.train import painted_balls
from chronoscene.methods import (
    Method,
    MethodSpec,
    StepReport,
    TrainingSet,
    import_object,
    load_spec,
    method_names,
)
from chronoscene.training import devices, sparse_depth

from .small_fields import SMALL_FIELD

STEPS = 3
FIELD_PAUSE = 24
"""Steps of a field until it is saved; it has no densification to wait for."""
AFTER_PAUSE = 12
EPS = 1e-4
"""Of Adam, where trainings are compared."""
LOSS_TOLERANCE = {"cpu": 1e-6, "cuda": 1e-4}
"""Relative, of the losses. Measured on a CPU: 1.2e-7. On an H200 all of these hold."""
IMAGE_TOLERANCE = {"cpu": 2e-6, "cuda": 1e-3}
"""Of images after `STEPS`. Measured on a CPU: 2e-7."""
RENDER_TOLERANCE = {"cpu": 3e-6, "cuda": 1e-4}
"""Of images of one model. Measured on a CPU: 6e-7."""
QUESTIONS = 3
"""To tensors in a step: what is in view, what of it is switched on; and how the step went. Of
fields: how many samples there are, how many are seen; and how the step went."""
MORE_QUESTIONS = {"ha-nerf": 1, "ha-nerf-t": 1}
"""The photos that have been drawn have to be encoded."""


@pytest.fixture(autouse=True, scope="module")
def depth_in_every_step() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sparse_depth, "INTERVAL", 1)
        yield


def is_quick(name: str) -> bool:
    """One field is enough by default: plain torch is slow, and `tests/fields/test_plain_torch.py`
    compares each with its kernels. Two methods have the code of ``3dgs`` and of
    ``scaffold-gs-period``."""
    if load_spec(name).mixes_views:
        return name == "nerf-w-t"
    return name not in ("3dgs-period", "scaffold-gs")


@dataclass
class Compiled:
    """A method as the compiled code trains it."""

    spec: MethodSpec
    data: TrainingSet
    trainings: dict[str, Training] = field(default_factory=dict)
    """By device."""

    @property
    def pause(self) -> int:
        """Steps after which a training is saved on its way."""
        return FIELD_PAUSE if self.spec.mixes_views else PAUSE

    def method(self, device: str = "cpu") -> Method:
        """At the start of a training with as many options as all methods have."""
        config = tiny_training.small_config(self.spec)
        options: dict[str, Any] = {
            "exposure": "image", "random_background": True, "depth_weight": 0.1
        }  # fmt: skip
        if isinstance(config, FieldConfig):
            options |= SMALL_FIELD | {"samples": 1024}
        known = {k: v for k, v in options.items() if hasattr(config, k)}
        method: Method = import_object(self.spec.method)(dataclasses.replace(config, **known))
        method.setup(self.data, seed=0, device=device)
        return method

    def image(self, method: Method) -> np.ndarray:
        return method.render(self.data.views[0], 0.0).rgb


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[] if is_quick(name) else pytest.mark.slow)
        for name in method_names()
        if "cuda" in load_spec(name).devices
    ],
)
def compiled(request: pytest.FixtureRequest) -> Compiled:
    spec = load_spec(request.param)
    data = painted_balls.make_training_set(tiny_training.periods_for(spec))
    mask = np.ones((painted_balls.HEIGHT, painted_balls.WIDTH), bool)
    mask[8:20, 5:18] = False
    return Compiled(spec, dataclasses.replace(data, load_mask=lambda i: mask))


@pytest.fixture(scope="module")
def first_steps(compiled: Compiled) -> tuple[list[float], np.ndarray]:
    """Losses, and an image after them."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        raise_eps(monkeypatch, EPS)
        method = compiled.method()
        losses = [method.step(i, i / tiny_training.STEPS).loss for i in range(STEPS)]
    return losses, compiled.image(method)


GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    ],
)


@pytest.fixture
def two_threads(compiled: Compiled) -> None:
    """Sums of torch have other bits on one processor: a Gaussian of 4dgs ends so close to the
    opacity below which none is drawn that only one of both ways draws it. Beside other tests,
    two threads take longer than one."""
    torch.set_num_threads(2 if compiled.spec.name == "4dgs" else 1)


@pytest.fixture(params=["cpu", GPU])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A GPU, or a CPU that runs what a GPU would."""
    if request.param == "cpu":
        without_kernels(monkeypatch)
    else:
        draw_on_the_host(monkeypatch)
    return request.param


@dataclass
class Training:
    """A training on a device, saved on its way."""

    method: Method
    reports: list[StepReport]
    saved: Path
    """Folder of the training after `Compiled.pause` steps."""

    def resumed(self, compiled: Compiled, device: str) -> Method:
        """Return a new method with the saved training."""
        if not compiled.spec.resumable:
            pytest.skip("the method cannot be resumed")
        method = compiled.method(device)
        method.load_training(self.saved)
        return method


@pytest.fixture
def training(compiled: Compiled, device: str, tmp_path_factory: pytest.TempPathFactory) -> Training:
    """Trained once for all tests of a method on a device."""
    if device not in compiled.trainings:
        method, saved = compiled.method(device), tmp_path_factory.mktemp("saved")
        reports = []
        for i in range(compiled.pause + AFTER_PAUSE):
            if i == compiled.pause and compiled.spec.resumable:
                method.save_training(saved)
            reports.append(method.step(i, i / tiny_training.STEPS))
        compiled.trainings[device] = Training(method, reports, saved)
    return compiled.trainings[device]


def draw_on_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a GPU the random numbers of a CPU, by which fields choose their rays."""

    def from_host(draw: Callable[..., torch.Tensor], *args: Any) -> torch.Tensor:
        *rest, like = args
        return draw(*rest, torch.empty(0)).to(like.device)

    for name in ("uniform", "integers", "normal"):
        monkeypatch.setattr(devices, name, partial(from_host, getattr(devices, name)))


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)


def test_first_steps_are_those_of_the_compiled_code(
    compiled: Compiled,
    first_steps: tuple[list[float], np.ndarray],
    device: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    losses, image = first_steps
    raise_eps(monkeypatch, EPS)
    method = compiled.method(device)
    found = [method.step(i, i / tiny_training.STEPS).loss for i in range(STEPS)]
    np.testing.assert_allclose(found, losses, rtol=LOSS_TOLERANCE[device])
    # By one code on a CPU: Gaussians of equal depth are drawn in an order that rounding decides.
    monkeypatch.undo()
    np.testing.assert_allclose(compiled.image(method), image, atol=IMAGE_TOLERANCE[device])


@pytest.mark.usefixtures("two_threads")
def test_training_lowers_the_loss_and_the_checkpoint_moves_between_devices(
    compiled: Compiled,
    training: Training,
    device: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Trained on the device, saved; loaded on a CPU with its kernels, saved; loaded again."""
    method, losses = training.method, [report.loss for report in training.reports]
    assert np.isfinite(losses).all() and np.mean(losses[-15:]) < 0.9 * np.mean(losses[:5])
    folders = [tmp_path / name for name in ("there", "here")]
    for folder in folders:
        folder.mkdir()
    method.save(folders[0])
    image = compiled.image(method)
    monkeypatch.undo()
    here = import_object(compiled.spec.method)(method.config)
    here.load(folders[0], device="cpu")
    np.testing.assert_allclose(compiled.image(here), image, atol=RENDER_TOLERANCE[device])
    here.save(folders[1])
    for name in ("model.json", "model.safetensors"):
        assert (folders[1] / name).read_bytes() == (folders[0] / name).read_bytes()
    if device == "cpu":
        without_kernels(monkeypatch)
    back = import_object(compiled.spec.method)(method.config)
    back.load(folders[1], device=device)
    np.testing.assert_allclose(compiled.image(back), image, atol=RENDER_TOLERANCE[device])


def test_a_training_goes_on_where_it_was_saved(
    compiled: Compiled, training: Training, device: str
) -> None:
    pause, resumed = compiled.pause, training.resumed(compiled, device)
    report = resumed.step(pause, pause / tiny_training.STEPS)
    assert report.primitives == training.reports[pause].primitives
    assert report.loss == pytest.approx(training.reports[pause].loss, rel=LOSS_TOLERANCE[device])


def test_a_training_of_another_device_goes_on_or_is_refused(
    compiled: Compiled, device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled.spec.resumable:
        pytest.skip("the method cannot be resumed")
    method = compiled.method(device)
    for i in range(5):
        method.step(i, i / tiny_training.STEPS)
    method.save_training(tmp_path)
    report = method.step(5, 5 / tiny_training.STEPS)
    monkeypatch.undo()
    here = compiled.method()
    try:
        here.load_training(tmp_path)
    except CheckpointError as error:
        assert "on the device, that began it" in str(error)
    else:
        found = here.step(5, 5 / tiny_training.STEPS).loss
        assert found == pytest.approx(report.loss, rel=LOSS_TOLERANCE[device])


def test_a_view_of_nothing_is_an_empty_step(compiled: Compiled, device: str) -> None:
    if compiled.spec.learns_background:
        pytest.skip("what is far away is something, too")
    away = np.diag([1.0, 1.0, 1.0, 1.0])
    away[2, 3] = -50.0  # everything far behind
    views = [dataclasses.replace(view, cam_from_world=away) for view in compiled.data.views]
    data = dataclasses.replace(compiled.data, views=tuple(views))
    method = Compiled(compiled.spec, data).method(device)
    before = compiled.image(method)
    reports = [method.step(i, i / tiny_training.STEPS) for i in range(STEPS)]
    assert [report.skipped for report in reports] == ["empty"] * STEPS
    np.testing.assert_array_equal(compiled.image(method), before)


@pytest.mark.parametrize("device", ["cpu"], indirect=True)
def test_a_step_asks_a_gpu_little_and_gets_no_table(
    compiled: Compiled, training: Training, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As asked on a CPU, except by what is of the CPU alone."""
    method = training.resumed(compiled, device)
    found = count_questions(monkeypatch)
    for i in (compiled.pause, compiled.pause + 1):
        found.clear()
        method.step(i, i / tiny_training.STEPS)
        allowed = QUESTIONS + MORE_QUESTIONS.get(compiled.spec.name, 0)
        assert sum(found.values()) <= allowed, found
        assert not found.keys() & {"numpy", "cpu", "tensor", "new_tensor"}, found


def count_questions(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count, from now on, by name what makes the host wait for a GPU."""
    found: Counter[str] = Counter()

    def watch(owner, name: str) -> None:
        function = getattr(owner, name)

        def watched(*args, **kwargs):
            masks = [a for a in args[1:] if isinstance(a, torch.Tensor) and a.dtype == torch.bool]
            caller = sys._getframe(1).f_code.co_filename
            of_cpu = "/rasterizer/cpu/" in caller or caller == devices.__file__
            if not of_cpu and (name != "__getitem__" or masks):
                found[name] += 1
            return function(*args, **kwargs)

        monkeypatch.setattr(owner, name, watched)

    for name in ("numpy", "cpu", "tolist", "item", "nonzero", "unique", "new_tensor"):
        watch(torch.Tensor, name)
    for name in ("__bool__", "__int__", "__float__", "__index__", "__getitem__"):
        watch(torch.Tensor, name)
    watch(torch, "tensor")
    return found
