"""Scenes out of zip and tar archives. No member gets out of its folder, and none is a link."""

from __future__ import annotations

import lzma
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from chronoscene.download.transfer import check_space
from chronoscene.errors import DownloadError
from chronoscene.io.processes import Report
from chronoscene.io.staging import leads_out, staged_folder
from chronoscene.io.wording import quote

ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz")
METADATA = "__MACOSX/"  # Folder that macOS adds to zip archives, with a shadow of each file
_BROKEN = (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, RuntimeError)
"""Errors of the libraries for damage, and for unknown ways of packing."""


@dataclass(frozen=True, slots=True)
class Member:
    """A file in an archive."""

    name: str
    """With slashes."""
    size: int
    """Bytes when it is unpacked."""
    open: Callable[[], IO[bytes]]


def archive_stem(path: str) -> str:
    """Return the name of an archive without folder and ending; empty if it is none."""
    name = path.rpartition("/")[2]
    return next((name.removesuffix(end) for end in ARCHIVES if name.endswith(end)), "")


@contextmanager
def open_archive(path: Path) -> Iterator[list[Member]]:
    """Open an archive and list its files, in their order there, without metadata of macOS.

    Raises:
        DownloadError: If it is damaged or of another kind, or has members that a dataset has no use
            for: links, devices, and paths that lead out of the folder.
    """
    try:
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as packed:
                infos = [info for info in packed.infolist() if not info.is_dir()]
                found = [_zip_member(path, packed, info) for info in infos]
                yield [member for member in found if not member.name.startswith(METADATA)]
        else:
            with tarfile.open(path) as unpacked:
                members = [info for info in unpacked.getmembers() if not info.isdir()]
                yield [_tar_member(path, unpacked, info) for info in members]
    except _BROKEN as error:
        raise DownloadError(
            path,
            expected="an archive that can be unpacked",
            found=str(error) or type(error).__name__,
            todo="unpack it by hand, or report it to the authors of the dataset",
        ) from error


def unpack_scene(members: Sequence[Member], prefix: str, out: Path, report: Report) -> None:
    """Write the members below a folder of the archive to a new folder, completely or not at all.

    Args:
        members: As `open_archive` gives them.
        prefix: The folder, with a slash at its end; empty for the whole archive.
        out: Must be new or empty.
        report: Called with files that were written.

    Raises:
        DiskFullError: If they do not fit on the disk.
    """
    chosen = [member for member in members if member.name.startswith(prefix)]
    check_space(out.parent, sum(member.size for member in chosen))
    with staged_folder(out) as staged:
        for done, member in enumerate(chosen, start=1):
            target = staged / member.name.removeprefix(prefix)
            target.parent.mkdir(parents=True, exist_ok=True)
            with member.open() as source, target.open("wb") as written:
                shutil.copyfileobj(source, written, 1 << 20)
            report(f"files of {out.name}", done, len(chosen))


def _zip_member(path: Path, packed: zipfile.ZipFile, info: zipfile.ZipInfo) -> Member:
    kind = stat.S_IFMT(info.external_attr >> 16)  # 0 where no Unix program packed it
    name = _safe_name(path, info.filename, plain=kind in (0, stat.S_IFREG))
    return Member(name, info.file_size, partial(packed.open, info))


def _tar_member(path: Path, unpacked: tarfile.TarFile, info: tarfile.TarInfo) -> Member:
    name = _safe_name(path, info.name, plain=info.isreg())

    def open_member() -> IO[bytes]:
        content = unpacked.extractfile(info)
        assert content is not None  # a regular file
        return content

    return Member(name, info.size, open_member)


def _safe_name(path: Path, name: str, *, plain: bool) -> str:
    name = name.replace("\\", "/").removeprefix("./")
    if leads_out(name) or not plain:
        fault = "leads out of it" if plain else "is a link or a device"
        raise DownloadError(
            path,
            expected="files in folders of the archive",
            found=f"{quote(name)}, which {fault}",
            todo="do not use this archive, and report it to the authors of the dataset",
        )
    return name
