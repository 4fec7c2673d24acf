"""Provenance of results: fingerprints of scene and configuration, code and machine."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import chronoscene
from chronoscene.errors import ImageError
from chronoscene.io.staging import sha256_of
from chronoscene.methods import installed_methods
from chronoscene.scene import Scene


def scene_hash(scene: Scene) -> str:
    """Hash frames, cameras, poses, periods, split, points, tracks, images and masks (SHA-256).

    Poses are rounded to nine digits: what pycolmap returns may differ in the last one.
    """
    return _hash(scene, sha256_of)


def scene_stamp(scene: Scene) -> str:
    """Hash as `scene_hash`, with size and time of change of each file instead of its content."""
    return _hash(scene, _stamp_of)


def _stamp_of(path: Path) -> str:
    status = path.stat()
    return f"{status.st_size} {status.st_mtime_ns}"


def _hash(scene: Scene, describe: Callable[[Path], str]) -> str:
    """Hash a scene, with what `describe` finds of each image and mask."""
    digest = hashlib.sha256()
    for frame in scene.frames:
        camera = frame.camera
        line = [frame.name, frame.period, frame.split, camera.model, camera.width, camera.height]
        files = filter(None, (scene.image_path(frame), scene.masks.get(frame.name)))
        found = [_described(path, describe) for path in files]
        digest.update(json.dumps([*line, *camera.params, *found]).encode())
        digest.update((np.round(frame.cam_from_world, 9) + 0.0).tobytes())
    points = scene.points
    for array in (points.xyz, points.rgb, points.track_start, points.track_frame):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _described(path: Path, describe: Callable[[Path], str]) -> str:
    try:
        return describe(path)
    except OSError as error:
        raise ImageError(
            path,
            expected="an image",
            found=error.strerror or "a file that cannot be read",
            todo="copy the image there, or remove it from the model",
        ) from error


def config_hash(config: dict[str, Any]) -> str:
    """Hash a config in canonical JSON (SHA-256)."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def code_version() -> str:
    """Return the commit of this code, with ``-dirty`` if files differ from it, else the version."""
    package = Path(chronoscene.__file__).resolve().parent
    # A virtual environment may lie inside someone else's repository: ask for our own file.
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return f"version {chronoscene.__version__}"
    commit = _git(package, "rev-parse", "HEAD")
    dirty = _git(package, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if dirty else f"{commit}"


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=30
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def method_version(name: str) -> str:
    """Return the version of a method's package; ``unpackaged`` for ``module:SPEC``."""
    entry = installed_methods().get(name)
    if entry is None or entry.dist is None:
        return "unpackaged"
    return f"{entry.dist.name} {entry.dist.version}"


def library_versions() -> dict[str, str]:
    """Return the versions of the libraries that numbers may depend on."""
    names = ("numpy", "numba", "torch", "gsplat", "opencv-contrib-python-headless", "pillow")
    installed = {name: found for name in names if (found := _installed_version(name)) is not None}
    return {"python": platform.python_version(), **installed}


@cache
def _installed_version(name: str) -> str | None:
    """Return the version of a package; it is in a file that takes milliseconds to parse."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def describe_device(kind: str, threads: int) -> str:
    """Describe the device: kind, processor or GPU, threads."""
    if kind == "cuda":
        import torch

        return f"cuda ({torch.cuda.get_device_name()})"
    return f"cpu ({processor_name()}, {threads} thread{'s' if threads != 1 else ''})"


def processor_name() -> str:
    """Return the model of the processor, as the system names it."""
    return _proc("cpuinfo", "model name") or platform.processor() or platform.machine()


def _proc(file: str, name: str) -> str:
    """Read a value from a file in ``/proc`` of Linux; empty if it is not there."""
    with suppress(OSError):
        for line in Path(f"/proc/{file}").read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == name:
                return value.strip()
    return ""


def peak_memory_bytes() -> int | None:
    """Return the largest resident memory of this process so far; None if it is unknown.

    Linux carries ``ru_maxrss`` over from the parent across ``exec``, so a small worker of a big
    parent would report the parent; VmHWM belongs to this program alone.
    """
    if peak := _proc("self/status", "VmHWM"):
        return int(peak.split()[0]) * 1024
    try:
        import resource
    except ImportError:  # Windows
        return None
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else largest * 1024
