"""``chronoscene doctor``: state of this machine, and what to install."""

from __future__ import annotations

import os
import platform
import shutil
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
from chronoscene.kernels import gpu
from chronoscene.kernels.runtime import available_threads, gsplat_release, machine_memory
from chronoscene.metrics.lpips_weights import candidate_files, check_available

CANNOT_RUN = 1  # Exit status if no method can be trained
CPU_TORCH = "pip install torch --index-url https://download.pytorch.org/whl/cpu"

EXTRAS = {
    "compress": "constriction",
    "flip": "flip_evaluator",
    "heic": "pillow_heif",
    "hloc": "h5py",
    "ray": "ray",
    "survey": "rasterio",
    "tune": "optuna",
    "view": "viser",
}
"""Extras that no other row is about, with a package of each."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One row of the table."""

    what: str
    state: str
    """``ok``, ``needed`` if no method can be trained without it, or ``missing``."""
    found: str
    todo: str = ""
    """Command that installs it, and its purpose."""


@click.command("doctor")
def command() -> None:
    """Report what works on this machine.

    For what is missing, it says what to install and why. The exit status is 1 if no method can be
    trained here, else 0. Nothing is downloaded.
    """
    system = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    diagnoses = [
        Diagnosis("chronoscene", "ok", f"{__version__}, {system}"),
        _needed("torch", f"{CPU_TORCH}, or a CUDA build from pytorch.org; all methods need it"),
        _kernels(),
        _needed(
            "COLMAP",
            "pip install pycolmap; without it no scene can be read",
            module="chronoscene.io.pycolmap",
            package="pycolmap",
        ),
        _cuda(),
        _gsplat(),
        _lpips(),
        _video(),
        _extras(),
        Diagnosis("processors", "ok", f"{available_threads()} of {os.cpu_count()}"),
        Diagnosis("memory", "ok", in_words(machine_memory()[0])),
        Diagnosis("disk", "ok", f"{in_words(shutil.disk_usage(Path.cwd()).free)} free here"),
    ]
    rows = [(d.what, d.state, d.found) for d in diagnoses]
    table = Table(["part", "state", "found"], rows, labels=3, title="What works on this machine")
    emit(plain_text(table) + "\n")
    for diagnosis in diagnoses:
        if diagnosis.todo:
            emit(f"{diagnosis.what}: {diagnosis.todo}\n")
    if any(diagnosis.state == "needed" for diagnosis in diagnoses):
        emit("No method can be trained here; commands on datasets may work.\n")
        click.get_current_context().exit(CANNOT_RUN)


def _kernels() -> Diagnosis:
    todo = "pip install numba; the rasterizer and the methods are compiled with it"
    if (diagnosis := _needed("kernels", todo, package="numba")).state != "ok":
        return diagnosis
    from chronoscene.kernels.compilation import kernel

    @kernel
    def twice(x: int) -> int:
        return 2 * x

    assert twice(21) == 42
    if folder := twice.stats.cache_path:
        return Diagnosis("kernels", "ok", f"{diagnosis.found}, compiled once and kept in {folder}")
    return Diagnosis(
        "kernels",
        "missing",
        f"{diagnosis.found}, but no folder that may be written to",
        "set NUMBA_CACHE_DIR to such a folder; else every process compiles all kernels anew",
    )


def _needed(what: str, todo: str, *, module: str = "", package: str = "") -> Diagnosis:
    """Check a module without which nothing is trained; by default all have the same name."""
    package = package or what
    try:
        import_module(module or package)
        return Diagnosis(what, "ok", f"{package} {version(package)}")
    except (ImportError, OSError, PackageNotFoundError) as error:
        return Diagnosis(what, "needed", str(error).splitlines()[0], todo)


def _cuda() -> Diagnosis:
    try:
        import torch
    except (ImportError, OSError):
        return Diagnosis("CUDA", "missing", "no torch to ask")
    if not torch.cuda.is_available():
        build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPUs only"
        found = f"no device; this torch is built for {build}"
        return Diagnosis("CUDA", "missing", found, "not needed: methods are trained on the CPU")
    devices = (torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count()))
    names = ", ".join(f"{d.name}, {in_words(d.total_memory)}" for d in devices)
    if gpu.has_triton():
        return Diagnosis("CUDA", "ok", f"{names}, triton {version('triton')}")
    todo = "pip install triton, without which a GPU takes up to twice the time"
    return Diagnosis("CUDA", "ok", f"{names}, no triton", todo)


def _gsplat() -> Diagnosis:
    try:
        gsplat_release()
    except BackendError as error:
        found = f"{error.found}, not {error.expected}"
        return Diagnosis("gsplat", "missing", found, f"{error.todo}; --device cuda needs it")
    return Diagnosis("gsplat", "ok", f"gsplat {version('gsplat')}")


def _lpips() -> Diagnosis:
    try:
        check_available()
    except ChronoSceneError as error:
        return Diagnosis("LPIPS weights", "missing", error.found, error.todo)
    return Diagnosis("LPIPS weights", "ok", ", ".join(map(str, candidate_files())))


def _video() -> Diagnosis:
    if find_spec("av") is None:
        return Diagnosis("video", "missing", "not installed", "pip install av; MP4 files need it")
    return Diagnosis("video", "ok", f"av {version('av')}")


def _extras() -> Diagnosis:
    missing = [name for name, package in EXTRAS.items() if find_spec(package) is None]
    there = ", ".join(name for name in EXTRAS if name not in missing) or "none"
    if not missing:
        return Diagnosis("extras", "ok", there)
    todo = f"pip install 'chronoscene[{','.join(missing)}]'; single commands and options need them"
    return Diagnosis("extras", "missing", f"{there}; not {', '.join(missing)}", todo)
