"""Training photos of a run: the memory and disk that they take, and how they are loaded.

Photos that do not all fit into the memory that they may take are decoded once and kept on disk,
from where they are read ahead of the training.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import PHOTOS
from chronoscene.harness.plan.settings import RunSettings
from chronoscene.images.disk_cache import DiskCache, files_of
from chronoscene.images.store import ImageStore, decoded_bytes, evaluation_size
from chronoscene.io.wording import counted, in_words
from chronoscene.kernels.runtime import available_threads, machine_memory, views_for_threads
from chronoscene.methods import MethodConfig, MethodSpec, has_function, make_method
from chronoscene.scene import Scene

_DECODING = 20
"""Bytes per pixel of a file while it is decoded: 10 for plain colours, 15 with a mask file, 20 for
16 bits and for transparency (measured, Pillow 13)."""

_AT_HAND = 3  # Photos that memory must hold: one in use, two ahead

_LIBRARIES = 500 * 10**6  # Bytes of a training's process before it has a model
_STEP = 250
"""Bytes per pixel of a photo that a training step takes for images and their gradients (3DGS with
few Gaussians, measured)."""
_FURTHER_VIEW = 140
"""Bytes per pixel of each further view of a step that is rendered at the same time (ChronoGS, 2,000
x 1,500 pixels, measured)."""
_MODEL = 10**9
"""Bytes of a model in training. Values, gradients and two moments of half a million Gaussians with
59 numbers each take 0.47 GB, and as much again is for what is made of them."""


@dataclass(frozen=True, slots=True)
class PhotoNeeds:
    """Memory and disk space of the training photos of a scene, in bytes unless noted."""

    scene: str
    count: int
    size: tuple[int, int]
    """Width and height of the largest file, in pixels."""
    total: int
    """All photos at the evaluation size."""
    largest: int
    """One photo at the evaluation size."""
    pixels: int
    """Number of pixels of that photo."""
    decoding: int
    """A file while it is decoded, at most."""
    decoders: int
    """Number of photos decoded at a time."""
    allowed: int
    """In memory, those that are being decoded included."""
    on_disk: int
    """0 if all fit into memory."""
    tests: int
    """Images of all test views."""

    @property
    def in_memory(self) -> int:
        """Memory that they take within the limit."""
        return min(self.allowed, self.total + self.decoders * self.decoding)

    def training(self, views: int) -> int:
        """Return the memory besides the photos, without the model.

        Args:
            views: Number of views that are rendered at the same time.
        """
        return _LIBRARIES + (_STEP + (views - 1) * _FURTHER_VIEW) * self.pixels

    def of_run(self, views: int) -> int:
        """Return the memory of a run with a model of half a million Gaussians."""
        return self.in_memory + self.training(views) + _MODEL


def photo_needs(scene: Scene, settings: RunSettings) -> PhotoNeeds:
    """Return what the photos of a run take."""
    width, frames = settings.max_width, scene.select(split="train")
    photos = [decoded_bytes(scene, frame, width) for frame in frames]
    total, largest = sum(photos), max(photos)
    size = max((frame.camera.size for frame in frames), key=math.prod)
    pixels = max(math.prod(evaluation_size(*frame.camera.size, width)) for frame in frames)
    # With two copies of the result: as it is decoded, and as it goes into memory.
    decoding = _DECODING * math.prod(size) + 2 * largest
    # Files that are being decoded take half of the memory, or there is one at a time.
    threads = settings.threads or available_threads()
    decoders = max(1, min(max(2, threads // 2), settings.photo_memory // (2 * decoding)))
    fits = total + decoders * decoding <= settings.photo_memory
    return PhotoNeeds(
        scene=scene.name,
        count=len(photos),
        size=size,
        total=total,
        largest=largest,
        pixels=pixels,
        decoding=decoding,
        decoders=decoders,
        allowed=settings.photo_memory,
        on_disk=0 if fits else min(total, settings.photo_disk),
        tests=sum(decoded_bytes(scene, frame, width) for frame in scene.select(split="test")),
    )


def open_store(scene: Scene, settings: RunSettings) -> ImageStore:
    """Open the photos of a run, within its limits; files must not change from then on."""
    needs = photo_needs(scene, settings)
    disk = DiskCache(settings.runs / PHOTOS, settings.photo_disk) if needs.on_disk else None
    return ImageStore(
        scene,
        max_width=settings.max_width,
        memory_limit=needs.allowed - needs.decoders * needs.decoding,
        decoders=needs.decoders,
        disk=disk,
        fixed=True,
    )


def views_at_a_time(config: MethodConfig, threads: int | None) -> int:
    """Return how many views of a training step are rendered at the same time on CPUs."""
    threads = threads or available_threads()
    views = getattr(config, "views_per_step", 1)
    return min(threads, views_for_threads(threads) if views == "auto" else views)


def check_room(
    needs: PhotoNeeds, folder: Path, runs: int, *, views: int = 1, here: bool = True
) -> str:
    """Check that memory and disk have room for the photos of a scene.

    Args:
        needs: Needs of its runs.
        folder: Folder of all runs.
        runs: Number of runs to do.
        views: Largest number of views that a run renders at the same time.
        here: True if the runs are done on this machine, whose memory is then checked.

    Returns:
        A line for the user that says what the photos take.

    Raises:
        ConfigError: If there is not enough room; the message names a setting that would fit.
    """
    training = needs.training(views)
    _check_memory(needs, training, machine_memory()[1] if here else None)
    _check_disk(folder, needs, (1 + runs) * needs.tests)
    photos = f"{counted(needs.count, 'training photo')}, {_gb(needs.total)} when decoded"
    kept = f", {_gb(needs.on_disk)} on disk" if needs.on_disk else ""
    return (
        f"{needs.scene}: {photos}: {_gb(needs.in_memory)} in memory{kept}; a training takes "
        f"{_gb(training)} and its model besides"
    )


def device_need(scene: Scene, needs: PhotoNeeds, spec: MethodSpec, config: MethodConfig) -> str:
    """Describe what a training takes of the memory of a GPU; empty if the method does not say.

    Args:
        scene: The scene that it is trained on.
        needs: Needs of its photos.
        spec: The method.
        config: Its options.
    """
    if not has_function(spec, "device_memory"):
        return ""
    periods = len(scene.periods) if spec.period_input != "none" else 1
    method, points = make_method(spec, config), len(scene.points.xyz)
    count, parts = method.device_memory(points, periods, needs.pixels)
    listed = ", ".join(f"{name} {_gb(size)}" for name, size in parts.items())
    return (
        f"{needs.scene}: {spec.name} takes about {_gb(sum(parts.values()))} of the GPU with "
        f"{count:,} primitives in view: {listed}; an estimate, without what CUDA takes. "
        f"Photos stay there, too, up to a quarter of its free memory (here {_gb(needs.total)})"
    )


def _check_memory(needs: PhotoNeeds, training: int, free: int | None) -> None:
    least = needs.decoding + _AT_HAND * needs.largest
    if needs.allowed < least:
        width, height = needs.size
        enough = math.ceil(least / 1e7) / 100
        raise ConfigError(
            f"{needs.scene}: memory for photos",
            expected=f"at least {_gb(least)} to decode photos of {width} x {height} pixels",
            found=_gb(needs.allowed),
            todo=f"scale the photos down, or use --photo-memory {enough}",
        )
    wanted = needs.in_memory + training
    if free is not None and free < wanted:
        smaller = math.floor((free - training) / 1e7) / 100
        raise ConfigError(
            needs.scene,
            expected=f"{_gb(wanted)} of memory, {_gb(needs.in_memory)} of it for photos",
            found=f"{_gb(free)} free",
            todo=f"end other programs, or use --photo-memory {smaller}"
            if smaller * 1e9 >= least
            else "end other programs, or use a machine with more memory",
        )


def _check_disk(runs: Path, needs: PhotoNeeds, images: int) -> None:
    """Check that decoded photos, and test images of this many bytes, have room."""
    folder = runs
    kept = sum(stat.st_size for stat in files_of(folder / PHOTOS).values())
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free + kept
    if free < needs.on_disk + images:
        smaller = max(0.0, math.floor((free - images) / 1e7) / 100)
        raise ConfigError(
            f"--out {runs}",
            expected=f"room for {_gb(needs.on_disk)} of decoded photos and at most {_gb(images)} "
            "of test images",
            found=f"{_gb(free)} free",
            todo="choose a place on another disk, or make room there"
            + (f", or use bench --photo-disk {smaller}" if needs.on_disk else ""),
        )


def _gb(size: int) -> str:
    """Format a size in GB; less than 0.01 GB in MB or kB."""
    return f"{size / 1e9:.2f} GB" if size >= 10**7 else in_words(size)
