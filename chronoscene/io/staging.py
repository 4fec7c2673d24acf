"""Output files and folders appear complete or not at all, and never inside a dataset."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from itertools import chain
from pathlib import Path, PureWindowsPath

from chronoscene.errors import ConfigError, DiskFullError, SceneError
from chronoscene.io.documents import plain_file

BOOT = Path("/proc/sys/kernel/random/boot_id")  # Linux: another one after each start of the machine
STREAMS = ("/dev", "/dev/fd", "/proc/self/fd")  # Folders of the system; nobody plants links there
_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}  # Windows has no quotas of this kind


def disk_full(error: OSError, place: object) -> DiskFullError | None:
    """Make the error that names a place without space left on its disk; None for others."""
    if error.errno not in _FULL:
        return None
    return DiskFullError(
        place,
        expected="space for what is written there",
        found=error.strerror or str(error),
        todo="free space on this disk, or choose a place on another one",
    )


def sha256_of(path: Path) -> str:
    """Hash the content of a file (SHA-256, in hexadecimal)."""
    with plain_file(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def leads_out(name: str) -> bool:
    """Return True if a name with slashes leads out of the folder it is joined to, or is empty."""
    parts = set(name.split("/"))
    drive = (":" in name or "\\" in name) and PureWindowsPath(name).drive
    return bool(not parts - {"", "."} or ".." in parts or name.startswith("/") or drive)


@contextmanager
def needing_space(place: Path) -> Iterator[None]:
    """Name the place if the block finds its disk full; of several around a block, the outermost.

    Raises:
        DiskFullError: Instead of an OSError that says so.
    """
    try:
        yield
    except DiskFullError as error:
        raise DiskFullError(**{**error.fields, "place": str(place)}) from error
    except OSError as error:
        if (full := disk_full(error, place)) is None:
            raise
        raise full from error


def partial_name(name: str) -> str:
    """Return the temporary name of a file or folder, with machine and process that write it."""
    return f".{name}.{_machine()}.{_boot()}.{os.getpid()}.partial"


def remove_abandoned(folder: Path, name: str) -> None:
    """Remove unfinished files of this process, and of ended processes of this machine.

    Other machines may still write to the same storage: their files stay.

    Args:
        folder: Where it is.
        name: Pattern of the final names.
    """
    import psutil

    for path in folder.glob(f".{name}.{_machine()}.*.partial"):
        boot, pid = path.name.split(".")[-3:-1]
        lives = boot == _boot() and int(pid) != os.getpid() and psutil.pid_exists(int(pid))
        if not lives and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif not lives:
            path.unlink(missing_ok=True)


@cache
def _machine() -> str:
    """Return the name of this machine, without dots; of a long one, the beginning and a hash."""
    name = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())
    digest = hashlib.sha256(name.encode()).hexdigest()
    return name if len(name) <= 32 else f"{name[:23]}-{digest[:8]}"


@cache
def _boot() -> str:
    """Identify this start of the machine: processes of earlier ones have ended."""
    with suppress(OSError):
        return BOOT.read_text(encoding="ascii")[:8]
    return "0"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name beside a file, renamed to it if the block succeeds, else deleted.

    Args:
        path: The file to write; its folder must exist. Another file of this name is replaced. A
            device or pipe (``/dev/stdout``) stays and gets the content.

    Raises:
        DiskFullError: If there is no space for it.
    """
    if is_stream(path):
        with tempfile.TemporaryDirectory() as folder:
            content = Path(folder) / "content"
            yield content
            with content.open("rb") as source, needing_space(path), path.open("ab") as stream:
                shutil.copyfileobj(source, stream)
        return
    partial = path.with_name(partial_name(path.name))
    try:
        with needing_space(path):
            yield partial
            partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def is_stream(path: Path) -> bool:
    """Tell devices and pipes from files. Links count only where the system keeps its streams."""
    if str(path.absolute().parent) in STREAMS:
        return path.exists()
    return path.exists() and not (path.is_symlink() or path.is_file() or path.is_dir())


def write_text_atomic(path: Path, text: str) -> None:
    r"""Write a text file in UTF-8 with ``\n`` at the ends of lines; see `replacing`."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def staged_folder(out: Path) -> Iterator[Path]:
    """Give a temporary folder beside ``out``, renamed to it if the block succeeds, else deleted.

    Folders above it are made, and a failure leaves none of these behind.

    Raises:
        SceneError: If ``out`` is a file or has content, or the disk refuses.
        DiskFullError: If there is no space for it.
    """
    missing: list[Path] = []
    try:
        check_not_current(out)
        out = out.resolve()
        missing = [folder for folder in out.parents if not folder.exists()]
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise SceneError(
                out,
                expected="a new or empty folder",
                found="one that is not empty" if out.is_dir() else "a file",
                todo="choose another folder",
            )
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            needing_space(out),
            tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary,
        ):
            staged = Path(temporary) / "scene"
            staged.mkdir()
            yield staged
            if out.exists():
                out.rmdir()
            staged.rename(out)
    except OSError as error:
        raise SceneError(
            error.filename or out,
            expected="a place that can be written to",
            found=error.strerror or str(error),
            todo="choose another folder",
        ) from error
    finally:
        with suppress(OSError):  # what has content stays
            for folder in missing:
                folder.rmdir()


def check_not_current(out: Path) -> None:
    """Refuse to replace the current folder: a shell would stay in the one that is removed.

    Raises:
        SceneError: If the path is the current folder.
    """
    if out.resolve() == Path.cwd():
        raise SceneError(
            out,
            expected="a folder other than the current one",
            found="the current folder",
            todo="run the command from its parent folder, or name a new folder",
        )


@contextmanager
def alone_in(folder: Path, option: str) -> Iterator[None]:
    """Keep other commands that do the same out of a folder while the block runs.

    The system frees the lock of a process that is killed.

    Args:
        folder: It must exist, and gets a file ``.lock``.
        option: Option or argument by which the user gave the folder.

    Raises:
        ConfigError: If another command works in it.
    """
    from filelock import FileLock, Timeout

    try:
        lock = FileLock(folder / ".lock").acquire(blocking=False)
    except Timeout as error:
        raise ConfigError(
            f"{option} {folder}",
            expected="a folder in which no other command works",
            found="one that is at work",
            todo="wait for it, or choose another folder",
        ) from error
    with lock:
        yield


def check_outside(place: Path, scenes: Iterable[Path], *, option: str = "") -> None:
    """Refuse to write into the folder of a scene, or into folders that are linked below it.

    Args:
        place: Where something is to be written.
        scenes: Folders of scenes, or of photos.
        option: Option by which the user gave the place.

    Raises:
        ConfigError: If the place is in one of the folders, or in the target of a link below one.
    """
    resolved = place.resolve()
    for scene in scenes:
        for folder in chain([scene], _linked_folders(scene)):
            if resolved.is_relative_to(folder.resolve()):
                raise ConfigError(
                    f"{option} {place}".strip(),
                    expected="a place outside the scene",
                    found=f"one in {folder}",
                    todo="choose another place: nothing is written into a dataset",
                )


def _linked_folders(top: Path) -> Iterator[Path]:
    """Find the links to folders below a folder, at any depth, but not those to folders above it.

    They are not looked into.
    """
    around = top.resolve()
    for above, folders, _ in os.walk(top):
        links = (p for name in sorted(folders) if (p := Path(above) / name).is_symlink())
        yield from (path for path in links if not around.is_relative_to(path.resolve()))
