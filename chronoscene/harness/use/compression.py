"""Compression of the model of a finished run, and its cost in quality.

How finely the numbers are rounded follows from the photos of the training views. With k_c the mean
squared change of the images per squared step of column c, and N_c its numbers, all steps together
change the images by the sum of k_c s_c^2, and take the sum of -N_c log2(s_c) bits and a constant.
For a given change, the bits are fewest with s_c^2 = lambda N_c / k_c: then a number of each column
has the same part in the change. k_c is measured, one column after the other, and lambda found by
bisection, so that the PSNR of training views falls by no more than the user allows.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from chronoscene.arrays import Array
from chronoscene.compression.columns import Columns
from chronoscene.compression.file import COMPRESSED_FILE, META_FILE, TENSOR_FILE, encode
from chronoscene.compression.positions import Grid, morton
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter, to_bytes
from chronoscene.harness.files.provenance import config_hash, describe_device
from chronoscene.harness.files.records import (
    CHECKPOINT,
    CONFIG_FILE,
    PREDICTIONS,
    RUN_FILE,
    SOURCE_FILE,
    read_config,
    size_of,
    variant_options,
    write_summary,
)
from chronoscene.harness.files.strategies import period_part
from chronoscene.harness.score.scoring import score_run
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.io.documents import read_json_document
from chronoscene.io.log import Log
from chronoscene.io.staging import sha256_of, staged_folder, write_text_atomic
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import POSITIONS, Method
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.metrics.registry import make_scorers
from chronoscene.scene import Frame, Scene
from chronoscene.scene.scene import spread_frames

MIN_ROWS = 256
"""Tensors with fewer rows are not worth a table of symbols."""
PROBE_VIEWS, LOSS_VIEWS = 9, 24
"""Training views on which columns, and the loss, are measured; see `spread_frames`."""
PROBE_WIDTH = 400
"""Pixels in a row of the images on which columns are measured, at most."""
ROUNDS, LEAST = 7, -24.0
"""Rounds of bisection; exponent of two, relative to the first guess, at which it gives up."""

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class _SortedModel:
    """A model of a run, sorted along the Morton curve, and the views that it was trained on."""

    run: TrainedRun
    frames: tuple[Frame, ...]
    store: ImageStore
    small: ImageStore
    """The same images with at most `PROBE_WIDTH` pixels in a row."""
    scratch: Path
    """Folder with the sorted model; its tensors are replaced to render others."""
    tensors: Arrays
    grids: Mapping[str, Grid]

    def images(
        self, tensors: Arrays, frames: tuple[Frame, ...], store: ImageStore
    ) -> list[NDArray[np.float32]]:
        """Render some views with other tensors, in the size of the images of a store."""
        _save(self.scratch, tensors)
        model, run = self.run.load(self.scratch), self.run
        views = [run.view(store.camera(f), f.cam_from_world) for f in frames]
        periods = [run.model_period(f.period) for f in frames]
        return [model.render(v, p).rgb for v, p in zip(views, periods, strict=True)]

    def rounded(self, rules: Mapping[str, Columns]) -> Arrays:
        """Return the tensors as the compressed file gives them back."""
        tensors = dict(self.tensors)
        for name, tensor in self.tensors.items():
            if name in self.grids:
                tensors[name] = self.grids[name].positions(self.grids[name].codes(tensor))
            elif name in rules:
                codes = rules[name].codes(_rows(tensor))
                tensors[name] = rules[name].restore(codes).reshape(tensor.shape)
            elif tensor.dtype == np.float32:
                tensors[name] = tensor.astype(np.float16).astype(np.float32)
        return tensors

    def psnr(self, tensors: Arrays) -> float:
        """Mean PSNR over training views."""
        frames = spread_frames(self.frames, LOSS_VIEWS)
        values = []
        for frame, image in zip(frames, self.images(tensors, frames, self.store), strict=True):
            mask = self.store.load_mask(frame)
            if mask is None or mask.any():
                values.append(psnr(to_bytes(image), self.store.load(frame), mask))
        return float(np.mean(values))


def compress_run(run: TrainedRun, scene: Scene, *, max_loss: float | None, log: Log) -> Path:
    """Write a run with compressed models beside another, with test views rendered and scored.

    Args:
        run: The run to compress, with one model or one per period.
        scene: The scene that it was trained on.
        max_loss: Largest loss of PSNR on training views in dB; None for half floats and LZMA.
        log: Called with the name of each step.

    Returns:
        The folder of the new run.

    Raises:
        ConfigError: If the run has stages or is a compressed one, there is one like this already,
            the method has no anchors or Gaussians, or the ground truth is missing.
        SceneError: If the folder of the new run is in use.
    """
    if run.strategy.in_order:
        raise ConfigError(
            run.folder,
            expected="a run with one model, or one per period",
            found=f"strategy {run.record.strategy}",
            todo="compress a run under another strategy",
        )
    if "compressed" in variant_options(run.record.variant):
        raise ConfigError(
            run.folder,
            expected="a run as it was trained",
            found="a compressed one, whose losses would add up",
            todo="compress the run that it was made from",
        )
    store = run.photos(scene)
    label = "plain" if max_loss is None else f"{max_loss:g}dB"
    variant = ",".join(filter(None, (run.record.variant, f"compressed={label}")))
    out = run.folder.resolve()
    out = out.parents[1] / f"{out.parent.name},compressed={label}" / out.name
    if (out / RUN_FILE).exists():
        raise ConfigError(
            out,
            expected="no run that is compressed like this",
            found="one",
            todo="use it, or delete it to compress the run again",
        )
    truth = ground_truth_folder(out.parents[2], run.record.scene)
    if not truth.is_dir():
        raise ConfigError(
            run.folder,
            expected="a run in the folder that bench wrote, with photos to score it by",
            found=f"no {truth}",
            todo="copy the whole folder of runs there",
        )
    with staged_folder(out) as staged:
        for number in range(run.num_periods) if run.strategy.model_per_period else (None,):
            part = "" if number is None else period_part(number)
            frames = scene.select(split="train", period=number)
            with _opened(run, number or 0, scene, frames) as opened:
                rules = None
                if max_loss is not None:
                    rules = _fit(opened, max_loss, log)
                log("encode")
                data = encode(opened.tensors, opened.grids, rules)
                _write(opened.scratch, staged / CHECKPOINT / part, data)
        (staged / SOURCE_FILE).write_bytes((run.folder / SOURCE_FILE).read_bytes())
        document = read_config(run.folder)
        document["config"]["compressed"] = label
        document["config_hash"] = config_hash(document["config"])
        write_text_atomic(staged / CONFIG_FILE, json.dumps(document, indent=1) + "\n")
        log("score")
        _score(replace(run, folder=staged, _models={}), scene, store, variant, truth)
    write_summary(out.parents[2])
    return out


@contextmanager
def _opened(
    run: TrainedRun, period: int, scene: Scene, frames: tuple[Frame, ...]
) -> Iterator[_SortedModel]:
    model: Method = run.model(period)
    if not hasattr(model, "permute"):
        raise ConfigError(
            run.folder,
            expected="a method with anchors or Gaussians that can be sorted",
            found=run.spec.title,
            todo="compress a run of another method",
        )
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        model.save(scratch)
        stored, meta = load_file(scratch / TENSOR_FILE), _meta(scratch)
        name = next(name for name in POSITIONS if name in stored)
        grid = Grid.of(stored[name], meta.get("voxel_size"))
        model.permute(np.argsort(morton(grid.codes(stored[name])), kind="stable"))
        model.save(scratch)
        tensors = load_file(scratch / TENSOR_FILE)
        small = ImageStore(scene, max_width=min(run.record.max_width, PROBE_WIDTH))
        yield _SortedModel(run, frames, run.photos(scene), small, scratch, tensors, {name: grid})


def _fit(model: _SortedModel, max_loss: float, log: Log) -> dict[str, Columns]:
    """Return the coarsest rounding by the rule above."""
    rules = {
        name: Columns.of(_rows(tensor))
        for name, tensor in model.tensors.items()
        if tensor.dtype == np.float32 and len(tensor) >= MIN_ROWS and name not in model.grids
    }
    if not rules:  # a toy, whose tensors are all small
        return rules
    sensitivity = _sensitivity(model, rules, log)
    counts = {name: len(model.tensors[name]) for name in rules}
    before = model.psnr(model.tensors)

    def at(level: float) -> dict[str, Columns]:
        found = {}
        for name, rule in rules.items():
            with np.errstate(divide="ignore"):
                steps = np.sqrt(level * counts[name] / sensitivity[name])
            # Rounding to steps beyond all values is the same as to the mean.
            steps = np.minimum(steps, 32 * rule.steps)
            found[name] = replace(rule, steps=steps.astype(np.float32))
        return found

    def allowed(exponent: float) -> bool:
        return before - model.psnr(model.rounded(at(start * 2**exponent))) <= max_loss

    log("find the steps")
    # To begin with, the noise that would lower the PSNR by this much, shared among all numbers.
    error = 10 ** (-before / 10)
    numbers = sum(counts[name] * len(rule.steps) for name, rule in rules.items())
    start = error * (10 ** (max_loss / 10) - 1) / numbers
    low, high = -4.0, 4.0
    while not allowed(low):
        low, high = low - 4.0, low
        if low < LEAST:
            raise ConfigError(
                f"--max-loss {max_loss:g}",
                expected="a loss within reach of this model",
                found="a larger loss from half floats and gridded positions alone",
                todo="allow more, or use --plain",
            )
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return at(start * 2**low)


def _sensitivity(model: _SortedModel, rules: Mapping[str, Columns], log: Log) -> dict[str, Array]:
    """Measure k_c of every column, by rounding one after the other."""
    frames = spread_frames(model.frames, PROBE_VIEWS)
    plain = model.images(model.tensors, frames, model.small)
    found = {}
    for name, rule in rules.items():
        rows = _rows(model.tensors[name])
        found[name] = np.zeros(len(rule.steps))
        rounded = rule.codes(rows)
        exact = rule.turn(rows)
        log(f"measure {name}")
        for c, step in enumerate(rule.steps):
            if step == 0:
                continue
            one = exact.copy()
            one[:, c] = rounded[:, c] * step
            tensor = rule.turn_back(one).reshape(model.tensors[name].shape)
            images = model.images(model.tensors | {name: tensor}, frames, model.small)
            change = [float(np.mean((a - b) ** 2)) for a, b in zip(images, plain, strict=True)]
            found[name][c] = np.mean(change) / float(step) ** 2
    return found


def _score(run: TrainedRun, scene: Scene, store: ImageStore, variant: str, truth: Path) -> None:
    """Render the test views of a run whose folder has its models, and write its record.

    The time of rendering is known only on the device of the run, which it stands for in tables.
    """
    writer, seconds = ImageWriter(run.folder / PREDICTIONS), 0.0
    frames = scene.select(split="test")
    threads = set_threads(run.record.threads)  # as the run that it is compared with
    device = describe_device(run.device, threads)
    for frame in frames[:1]:  # kernels compile, or are loaded, at first use
        run.render(store.camera(frame), frame.cam_from_world, frame.period)
    for frame in frames:
        run.model(frame.period)
        before = time.perf_counter()
        image = run.render(store.camera(frame), frame.cam_from_world, frame.period).rgb
        seconds += time.perf_counter() - before
        period = frame.period
        writer.add(frame.name, image, camera_period=period, rendered_period=period)
    writer.close_run(run.record)
    same = device == run.record.device
    absent = dict(run.record.absent)
    if frames and not same:
        absent["render_seconds"] = f"compressed on another device than that of the run: {device}"
    changed = {
        "variant": variant,
        "checkpoint_bytes": size_of(run.folder / CHECKPOINT),
        "config_hash": read_config(run.folder)["config_hash"],
        "render_seconds": seconds / len(frames) if frames and same else None,
        "absent": absent,
    }
    score_run(run.folder, run.record.model_copy(update=changed), truth, make_scorers())


def _rows(tensor: NDArray[Any]) -> NDArray[Any]:
    return tensor.reshape(len(tensor), -1)


def _save(folder: Path, tensors: Arrays) -> None:
    """Replace the tensors of a saved model."""
    save_file(tensors, folder / TENSOR_FILE)
    _describe(folder, folder, TENSOR_FILE)


def _write(model: Path, out: Path, data: bytes) -> None:
    """Write a saved model with the file of its tensors compressed."""
    out.mkdir(parents=True)
    (out / COMPRESSED_FILE).write_bytes(data)
    _describe(model, out, COMPRESSED_FILE)


def _describe(model: Path, out: Path, file: str) -> None:
    """Write the description of a model that has its tensors in another file."""
    meta = _meta(model) | {"tensors_sha256": sha256_of(out / file)}
    write_text_atomic(out / META_FILE, json.dumps(meta, indent=2, sort_keys=True) + "\n")


def _meta(folder: Path) -> dict[str, Any]:
    return dict(read_json_document(folder / META_FILE, error=CheckpointError))
