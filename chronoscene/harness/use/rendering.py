"""Pictures of a finished run, as a folder of PNG files or as an animation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from chronoscene.arrays import Pixels
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import encode_png, to_bytes
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.animation import SUFFIXES, WEBP_SIDE, write_animation
from chronoscene.io.staging import staged_folder


def check_viewpoints(
    run: TrainedRun, viewpoints: Sequence[Viewpoint], out: Path, appearance_period: float | None
) -> None:
    """Check that pictures can be rendered, before long work.

    Raises:
        ConfigError: If the run has no such period, or cannot combine two, or an animation would
            have pictures of several sizes, or larger ones than its format has.
        CheckpointError: If a model is missing.
    """
    for period in {viewpoint.period for viewpoint in viewpoints}:
        assert period is not None
        run.check_period(period)
        run.model(period)
    if appearance_period is not None:
        run.check_appearance(appearance_period)
    sizes = sorted({viewpoint.camera.size for viewpoint in viewpoints})
    if is_animation(out) and len(sizes) > 1:
        raise ConfigError(
            f"--out {out}",
            expected="cameras of one size",
            found=", ".join(f"{w} x {h}" for w, h in sizes[:4]),
            todo="name a folder, for PNG files",
        )
    if out.suffix.lower() == ".webp" and max(sizes[0]) > WEBP_SIDE:
        raise ConfigError(
            f"--out {out}",
            expected=f"pictures of at most {WEBP_SIDE} pixels a side, as WebP has no larger ones",
            found="{} x {}".format(*sizes[0]),
            todo="choose a smaller size, or .mp4",
        )


def is_animation(out: Path) -> bool:
    """Return True if a path names an animation."""
    return out.suffix.lower() in SUFFIXES


def render_viewpoints(
    run: TrainedRun, viewpoints: Sequence[Viewpoint], *, appearance_period: float | None = None
) -> Iterator[Pixels]:
    """Yield one picture after the other. [H, W, 3]"""
    for viewpoint in viewpoints:
        assert viewpoint.period is not None
        prediction = run.render(
            viewpoint.camera,
            viewpoint.cam_from_world,
            viewpoint.period,
            appearance_period=appearance_period,
        )
        yield to_bytes(prediction.rgb)


def write_pictures(
    out: Path, names: Iterable[str], images: Iterable[Pixels], *, fps: float
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
