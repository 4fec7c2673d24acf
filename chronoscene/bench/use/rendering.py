"""Pictures of a finished run, as a folder of PNG files or as one file that plays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.files.predictions import encode_png, to_bytes
from chronoscene.bench.use.cameras import Shot
from chronoscene.bench.use.trained_run import TrainedRun
from chronoscene.errors import ConfigError
from chronoscene.images.animation import SUFFIXES, write_animation
from chronoscene.io.staging import staged_folder


def check_shots(
    run: TrainedRun, shots: Sequence[Shot], out: Path, appearance_period: float | None
) -> None:
    """Find out before long work that it cannot be done.

    Raises:
        ConfigError: If no model claims a period, or the colours of another, or a file that plays
            is to have pictures of several sizes.
        CheckpointError: If a model is missing.
    """
    for period in {shot.period for shot in shots}:
        assert period is not None
        run.check_period(period)
        run.model(period)
    if appearance_period is not None:
        run.check_appearance(appearance_period)
    sizes = sorted({shot.camera.size for shot in shots})
    if is_animation(out) and len(sizes) > 1:
        raise ConfigError(
            f"--out {out}",
            expected="cameras of one size",
            found=", ".join(f"{w} x {h}" for w, h in sizes[:4]),
            todo="name a folder, for PNG files",
        )


def is_animation(out: Path) -> bool:
    """Whether a path names a file that plays."""
    return out.suffix.lower() in SUFFIXES


def render_shots(
    run: TrainedRun, shots: Sequence[Shot], *, appearance_period: float | None = None
) -> Iterator[NDArray[np.uint8]]:
    """One picture after the other. [H, W, 3]"""
    for shot in shots:
        assert shot.period is not None
        prediction = run.render(
            shot.camera, shot.cam_from_world, shot.period, appearance_period=appearance_period
        )
        yield to_bytes(prediction.rgb)


def write_pictures(
    out: Path, names: Iterable[str], images: Iterable[NDArray[np.uint8]], *, fps: float
) -> None:
    """Write pictures to a file of `animation.SUFFIXES`, or to a new folder under their names.

    Raises:
        SceneError: If the folder is in use.
        DiskFullError: If there is no space.
    """
    if is_animation(out):
        write_animation(out, images, fps)
        return
    with staged_folder(out) as staged:
        for name, image in zip(names, images, strict=True):
            (staged / name).parent.mkdir(parents=True, exist_ok=True)
            (staged / name).write_bytes(encode_png(image))
