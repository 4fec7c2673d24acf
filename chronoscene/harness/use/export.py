"""Gaussians of finished runs in files for other programs, and what these will show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from chronoscene import __version__, splat_files
from chronoscene.arrays import Array
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import safe_part, to_bytes
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.io.wording import counted, printable
from chronoscene.methods import Prediction, View
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame, Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.orbit import find_up
from chronoscene.scene.scene import spread_frames
from chronoscene.scene.similarity import Sim3
from chronoscene.splat_files import spz

LIMIT_DB = 0.3
"""PSNR that plain viewers may lose on training views, for them to be the default."""
JUDGED_VIEWS = 24
"""Training views of the period by which that is judged, at most; see `spread_frames`."""
FAR_AWAY = 2_000.0
"""Coordinate of the median camera, in units of the scene, beyond which an offset is subtracted."""


class ExportLoss(NamedTuple):
    """Means over views of one period, in dB."""

    views: int
    model: float
    """PSNR of the images that the run renders."""
    plain: float
    """PSNR of the Gaussians in a viewer without the antialiasing filter."""
    filtered: float | None
    """PSNR of the Gaussians with the filter; None if the run was trained without it."""


@dataclass(frozen=True)
class Prepared:
    """Gaussians of a period as they go into files."""

    cloud: GaussianCloud
    """In the frame of the scene minus `offset`."""
    offset: Array
    """Position in the scene minus position in the file. [3]"""
    antialiased: bool
    """True if viewers have to use the antialiasing filter."""


@dataclass(frozen=True)
class Export:
    """A file with the Gaussians of a period."""

    data: bytes
    loss: ExportLoss | None
    """On the test views, of the Gaussians as they are read from the file; None if no test photo
    shows the period."""
    comments: tuple[str, ...]
    """Lines on content and losses; they are in the file, where its format has a place for them."""


def prepare(run: TrainedRun, scene: Scene, period: float, viewers: str | None = None) -> Prepared:
    """Take the Gaussians of a period out of a run.

    Args:
        run: A finished run.
        scene: The scene that it was trained on.
        period: Period of the Gaussians.
        viewers: ``plain`` for viewers without the antialiasing filter, ``antialiased`` for those
            with it; None for plain ones if that loses less than `LIMIT_DB` on training views, in
            between periods on those of the nearest period, whose Gaussians are judged.

    Raises:
        ConfigError: If there are no Gaussians, or the run has no filter.
    """
    if viewers == "antialiased" and not run.is_filtered:
        raise ConfigError(
            "--for antialiased",
            expected="a run that was trained with antialiased=true",
            found="one without it",
            todo="leave it out",
        )
    offset = local_offset(scene)
    local_from_world = Sim3(1.0, np.eye(3), -offset)
    cloud = run.gaussians(period, scene=scene, target_from_world=local_from_world)
    if not len(cloud):
        raise ConfigError(
            f"period {period:g}",
            expected="Gaussians",
            found="none",
            todo="train the run for longer, or choose another period",
        )
    if viewers == "antialiased" or not run.is_filtered:
        return Prepared(cloud, offset, antialiased=viewers == "antialiased")
    filtered = Prepared(cloud, offset, antialiased=True)
    if viewers is None and period != int(period):  # no photo shows it
        if prepare(run, scene, float(round(period))).antialiased:
            return filtered
        viewers = "plain"
    return _adapted(run, scene, period, filtered, viewers)


def make_file(
    run: TrainedRun, scene: Scene, period: float, prepared: Prepared, kind: str
) -> Export:
    """Make a file of prepared Gaussians, and measure its loss as read back.

    Args:
        run: The run.
        scene: Its scene.
        period: As for `prepare`.
        prepared: Result of `prepare`.
        kind: Format, of `chronoscene.splat_files.SUFFIXES`.
    """
    up = find_up(scene.frame_poses)
    data = splat_files.encode(kind, prepared.cloud, antialiased=prepared.antialiased, up=up)
    read = splat_files.decode(kind, data)
    in_training = read.transformed(run.training_from_local(prepared.offset))
    loss = measure_loss(run, scene, period, in_training, _frames(scene, "test", period))
    comments = _comments(run, scene, period, prepared, loss, kind)
    return Export(splat_files.with_comments(kind, data, comments), loss, comments)


def period_files(labels: Mapping[str, str], kind: str) -> dict[int, str]:
    """Name the files of all periods by their labels, with their numbers where two share one.

    Args:
        labels: Of the periods, by number.
        kind: As for `make_file`.
    """
    count = Counter(labels.values())
    names = {k: name if count[name] == 1 else f"{name}_{k}" for k, name in labels.items()}
    if len({*names.values()}) < len(names):  # "May_0" is the label of another one
        names = {k: f"{name}_{k}" for k, name in labels.items()}
    suffix = splat_files.SUFFIXES[kind]
    return {int(k): f"{safe_part(name)}{suffix}" for k, name in names.items()}


def local_offset(scene: Scene) -> Array:
    """Return what is subtracted from coordinates that are too large for files, else 0. [3]

    It is the same for all periods: the median camera centre, in whole units.
    """
    median = np.round(np.median(camera_centre(scene.frame_poses), axis=0))
    return median if np.abs(median).max() > FAR_AWAY else np.zeros(3)


def measure_loss(
    run: TrainedRun, scene: Scene, period: float, gaussians: GaussianCloud, frames: Sequence[Frame]
) -> ExportLoss | None:
    """Compare Gaussians with the model on photos of the period.

    Args:
        run: The run that was exported.
        scene: The scene that it was trained on.
        period: Period of the Gaussians.
        gaussians: In the training frame.
        frames: Views with the photos.

    Returns:
        None where no photo shows anything.
    """
    model, filtered = run.model(period), run.is_filtered

    def images(view: View) -> Iterator[Prediction]:
        yield model.render(view, run.model_period(period))
        yield model.render_gaussians(gaussians, view)
        if filtered:
            yield model.render_gaussians(gaussians, view, plain=True)

    values = _psnr(run, scene, frames, images)
    if not len(values):
        return None
    own, *exported = values.mean(axis=0).tolist()
    return ExportLoss(len(values), own, exported[-1], exported[0] if filtered else None)


def _psnr(
    run: TrainedRun,
    scene: Scene,
    frames: Sequence[Frame],
    images: Callable[[View], Iterator[Prediction]],
) -> Array:
    """Return the PSNR of several images of each view against its photo, if any of it counts."""
    store = run.photos(scene)
    values = []
    for frame, view in zip(frames, run.frame_views(scene, frames), strict=True):
        photo, mask = store.load(frame), store.load_mask(frame)
        if mask is None or mask.any():
            values.append([psnr(to_bytes(image.rgb), photo, mask) for image in images(view)])
    return np.array(values)


def _frames(scene: Scene, split: Literal["train", "test"], period: float) -> tuple[Frame, ...]:
    """Return the frames of a period; none in between periods."""
    return tuple(scene.select(split=split, period=int(period))) if period == int(period) else ()


def _adapted(
    run: TrainedRun, scene: Scene, period: float, filtered: Prepared, viewers: str | None
) -> Prepared:
    """Return Gaussians for viewers without the filter; those with it if these lose too much."""
    training_from_local = run.training_from_local(filtered.offset)
    before, model = filtered.cloud.transformed(training_from_local), run.model(period)
    frames = _frames(scene, "train", period)
    # Views of all periods serve in between periods.
    known = frames or [f for f in scene.select(split="train") if f.period < run.num_periods]
    after = model.adapt_to_plain(before, run.frame_views(scene, known))
    plain = Prepared(after.transformed(training_from_local.inverse()), filtered.offset, False)
    if viewers == "plain":
        return plain

    def images(view: View) -> Iterator[Prediction]:
        yield model.render_gaussians(before, view)
        yield model.render_gaussians(after, view, plain=True)

    values = _psnr(run, scene, spread_frames(frames, JUDGED_VIEWS), images)
    if not len(values):
        return plain
    with_filter, without = values.mean(axis=0)
    return plain if with_filter - without < LIMIT_DB else filtered


def _comments(
    run: TrainedRun,
    scene: Scene,
    period: float,
    prepared: Prepared,
    loss: ExportLoss | None,
    format: str,
) -> tuple[str, ...]:
    """Return what a file says of itself, in lines of ASCII as PLY has them."""
    label = run.record.period_labels.get(f"{period:g}", "")
    of_period = f"period {period:g} {label if label != f'{period:g}' else ''}".strip()
    kind = "with" if prepared.antialiased else "without"
    lines = [
        f"ChronoScene {__version__}: {run.record.method}, scene {scene.name}, {of_period}",
        f"For viewers {kind} the antialiasing filter of Mip-Splatting",
        _describe_loss(loss, prepared.antialiased),
    ]
    if getattr(run.config, "exposure", "none") != "none":
        lines.append("The exposure is in the colours; a viewer lacks it where background shows")
    if prepared.offset.any():
        lines.append(_describe_offset(scene, prepared.offset))
    if format == "spz" and (far := spz.count_far(prepared.cloud)):
        lines.append(f"{counted(far, 'Gaussian')} far from all others moved to the limits of SPZ")
    return tuple(printable(line).encode("ascii", "replace").decode() for line in lines)


def _describe_loss(loss: ExportLoss | None, antialiased: bool) -> str:
    if loss is None:
        return "PSNR lost: not measured, as no test photo shows this period"
    text = f"PSNR on {counted(loss.views, 'test view')}: model {loss.model:.2f} dB, file "
    if loss.filtered is None:
        return f"{text}{loss.plain:.2f} dB: {_lost(loss.model, loss.plain)} dB lost"
    text += f"{loss.plain:.2f} dB without the filter, {loss.filtered:.2f} dB with it: "
    if antialiased:
        return f"{text}{_lost(loss.model, loss.filtered)} dB lost with it"
    return f"{text}{_lost(loss.model, loss.plain)} dB lost without it"


def _lost(model: float, file: float) -> str:
    return f"{round(model - file, 2) + 0.0:.2f}"  # never -0.00


def _describe_offset(scene: Scene, offset: Array) -> str:
    text = "Add {:.0f} {:.0f} {:.0f} to coordinates of this file for those".format(*offset)
    if scene.world.crs is None:
        return f"{text} of the scene"
    total = offset + np.asarray(scene.world.offset)
    return text + " of the scene, {} {} {} for {}".format(*total, scene.world.crs)
