"""``chronoscene doctor``: what works on this machine, and what to install."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import click

from chronoscene import __version__
from chronoscene.cli.output import emit
from chronoscene.errors import BackendError, ChronoSceneError
from chronoscene.io.tables import Table, plain_text
from chronoscene.io.wording import in_words
from chronoscene.kernels.runtime import available_threads, gsplat_release, machine_memory
from chronoscene.metrics.lpips_weights import candidate_files, check_available

CANNOT_RUN = 1  # Exit status if no method can be trained
CPU_TORCH = "pip install torch --index-url https://download.pytorch.org/whl/cpu"


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the table."""

    what: str
    state: str
    """``ok``, ``needed`` if no method can be trained without it, or ``missing``."""
    found: str
    todo: str = ""
    """What to do about it, and what for."""


@click.command("doctor")
def command() -> None:
    """Say what works on this machine.

    What is missing comes with what to install, and what for. The exit status is 1 if no method can
    be trained here, else 0. Nothing is downloaded.
    """
    findings = [check() for check in CHECKS]
    heads = [(head, "") for head in ("part", "state", "found")]
    rows = [(finding.what, finding.state, finding.found) for finding in findings]
    table = Table(heads, rows, labels=len(heads), title="What works on this machine")
    emit(plain_text(table) + "\n", None)
    for finding in findings:
        if finding.todo:
            emit(f"{finding.what}: {finding.todo}\n", None)
    if any(finding.state == "needed" for finding in findings):
        emit("No method can be trained here; commands on datasets may work.\n", None)
        click.get_current_context().exit(CANNOT_RUN)


def _program() -> Finding:
    system = f"{platform.system()} {platform.machine()}"
    found = f"{__version__}, Python {platform.python_version()}, {system}"
    return Finding("chronoscene", "ok", found)


def _torch() -> Finding:
    todo = f"{CPU_TORCH}, or a CUDA build from pytorch.org; all methods need it"
    return _needed("torch", "torch", todo)


def _kernels() -> Finding:
    todo = "pip install numba; the rasterizer and the methods are compiled with it"
    if (finding := _needed("kernels", "numba", todo)).state != "ok":
        return finding
    from chronoscene.kernels.compilation import kernel

    @kernel
    def twice(x: int) -> int:
        return 2 * x

    assert twice(21) == 42
    if folder := twice.stats.cache_path:
        return Finding("kernels", "ok", f"{finding.found}, compiled once and kept in {folder}")
    return Finding(
        "kernels",
        "missing",
        f"{finding.found}, but no folder that may be written to",
        "set NUMBA_CACHE_DIR to such a folder; else every process compiles all kernels anew",
    )


def _colmap() -> Finding:
    todo = "pip install pycolmap; without it no scene can be read"
    return _needed("COLMAP", "chronoscene.io.pycolmap", todo, package="pycolmap")


def _needed(what: str, module: str, todo: str, *, package: str = "") -> Finding:
    """Whether a module without which nothing is trained can be imported."""
    try:
        import_module(module)
        return Finding(what, "ok", f"{package or module} {version(package or module)}")
    except (ImportError, OSError, PackageNotFoundError) as error:
        return Finding(what, "needed", str(error).splitlines()[0], todo)


def _cuda() -> Finding:
    try:
        import torch
    except (ImportError, OSError):
        return Finding("CUDA", "missing", "no torch to ask")
    if not torch.cuda.is_available():
        build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPUs only"
        found = f"no device; this torch is built for {build}"
        return Finding("CUDA", "missing", found, "not needed: methods are trained on the CPU")
    devices = (torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count()))
    return Finding(
        "CUDA", "ok", ", ".join(f"{d.name}, {in_words(d.total_memory)}" for d in devices)
    )


def _gsplat() -> Finding:
    try:
        gsplat_release()
    except BackendError as error:
        found = f"{error.found}, not {error.expected}"
        return Finding("gsplat", "missing", found, f"{error.todo}; --device cuda needs it")
    return Finding("gsplat", "ok", f"gsplat {version('gsplat')}")


def _open3d() -> Finding:
    try:
        from chronoscene.synth.render.renderer import load_open3d

        return Finding("open3d", "ok", f"open3d {load_open3d().__version__}")
    except ImportError as error:  # of what synth needs besides
        return Finding("open3d", "missing", str(error))
    except ChronoSceneError as error:
        todo = f"{error.todo}; chronoscene synth needs it"
        return Finding("open3d", "missing", error.found, todo)


def _lpips() -> Finding:
    try:
        check_available()
    except ChronoSceneError as error:
        return Finding("LPIPS weights", "missing", error.found, error.todo)
    return Finding("LPIPS weights", "ok", ", ".join(map(str, candidate_files())))


def _video() -> Finding:
    if find_spec("av") is None:
        return Finding("video", "missing", "not installed", "pip install av; MP4 files need it")
    return Finding("video", "ok", f"av {version('av')}")


def _processors() -> Finding:
    found = f"{available_threads()} of {os.cpu_count()}"
    return Finding("processors", "ok", found)


def _memory() -> Finding:
    return Finding("memory", "ok", in_words(machine_memory()[0]))


def _disk() -> Finding:
    return Finding("disk", "ok", f"{in_words(shutil.disk_usage(Path.cwd()).free)} free here")


CHECKS: tuple[Callable[[], Finding], ...] = (
    _program,
    _torch,
    _kernels,
    _colmap,
    _cuda,
    _gsplat,
    _open3d,
    _lpips,
    _video,
    _processors,
    _memory,
    _disk,
)
"""In the order of the table."""
