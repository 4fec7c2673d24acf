"""Scenes of a public dataset in a folder on this machine.

The layout on the host is detected: scenes may be folders, at any depth, or be in archives, one for
each scene or one for all of them.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from chronoscene.download.archives import ARCHIVES, archive_stem, open_archive, unpack_scene
from chronoscene.download.catalogue import Dataset
from chronoscene.download.hub import list_files, request_headers
from chronoscene.download.transfer import RemoteFile, check_space, fetch, missing_bytes
from chronoscene.errors import ConfigError, DownloadError, SceneError
from chronoscene.io.documents import read_json_document
from chronoscene.io.log import Log
from chronoscene.io.processes import Report
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import counted, in_words, shown

UNFINISHED = ".download"
"""Folder beside the scenes where files are until a scene is complete."""
RECORD = "download.json"
"""File beside the scenes: where they are from; see `_Record`."""
LISTED = 40  # Names of scenes that a message lists


@dataclass(frozen=True, slots=True)
class _Record:
    """Record of earlier downloads into a folder."""

    scenes: dict[str, str]
    """Name of a scene to the commit that it is from."""
    archives: dict[str, list[str]]
    """Checksum of an archive to the names of all scenes that it has."""


@dataclass(frozen=True, slots=True)
class _Choice:
    """Selection of the files of a dataset that are to be fetched."""

    folders: dict[str, str]
    """Scenes that are folders: name to the path in the repository, with a slash at its end."""
    archives: list[RemoteFile]
    files: list[RemoteFile]
    """All files of both."""
    known: set[str]
    """Names of all scenes and archives of the dataset, as far as they can be known before."""


def download_scenes(
    dataset: Dataset, out: Path, scenes: Collection[str], *, report: Report, log: Log
) -> None:
    """Bring scenes of a dataset on the Hugging Face hub into a folder.

    Scenes that are there already are left alone. A command that was ended goes on where it stopped.

    Args:
        dataset: One with a ``repo``.
        out: Gets a folder for each scene, complete or not at all.
        scenes: Names of scenes, or of archives that hold several; none for all.
        report: Called with the progress of each step.
        log: Called with the size before anything is fetched.

    Raises:
        ConfigError: If there is no scene of this name; lists those that there are.
        DownloadError: If the host does not answer, a file arrives damaged, or no scene is found.
        DiskFullError: If there is no space for the files and for what is unpacked.
    """
    commit, files = list_files(dataset.repo)
    record = _read_record(out)
    choice = _choose(dataset, files, scenes, out, record)
    if not choice.files:
        log(f"{dataset.title}: all of it is in {out}")
        return
    unfinished = out / UNFINISHED
    unfinished.mkdir(parents=True, exist_ok=True)
    missing = sum(missing_bytes(file, unfinished) for file in choice.files)
    packed = sum(file.size for file in choice.archives)
    log(
        f"{dataset.title}: {in_words(missing)} in {counted(len(choice.files), 'file')} to download"
        + (f", {in_words(packed)} in archives to unpack" if packed else "")
    )
    check_space(out, missing + packed)  # photos take as much space in an archive as outside of it
    fetch(choice.files, unfinished, report=report, headers=request_headers())

    listed = {unfinished / file.path for file in files}
    for name, prefix in choice.folders.items():
        _remove_others(unfinished / prefix, listed)
        (unfinished / prefix).rename(out / name)
        record.scenes[name] = commit
    _write_record(out, dataset, record)
    for archive in choice.archives:
        names, unpacked = _unpack(dataset, archive, scenes, out, report)
        record.archives[archive.checksum] = names
        record.scenes.update(dict.fromkeys(unpacked, commit))
        _write_record(out, dataset, record)
        _check_names(dataset, scenes, choice.known.union(names))  # if not, the archive stays
        (unfinished / archive.path).unlink()
    if not any(path.is_file() for path in unfinished.rglob("*")):  # nothing of other scenes
        shutil.rmtree(unfinished, ignore_errors=True)


def find_scenes(dataset: Dataset, paths: Iterable[str], whole: str) -> dict[str, str]:
    """Find the scenes among the paths of files: name to folder, with a slash at its end.

    Args:
        dataset: Says by which file a scene is known. Of folders in each other the outermost counts.
        paths: With slashes.
        whole: Name of the scene if there is no folder around it.
    """
    known_by = re.compile(rf"(.*/)?(?:{dataset.scene_file})")
    found = {match[1] or "" for path in paths if (match := known_by.fullmatch(path))}
    folders: list[str] = []
    for folder in sorted(found):
        if not folders or not folder.startswith(folders[-1]):
            folders.append(folder)
    names = [folder.rstrip("/").rpartition("/")[2] or whole for folder in folders]
    return {
        # Two folders of one name, of two resolutions perhaps, are distinguished by their paths.
        name if names.count(name) == 1 else folder.rstrip("/").replace("/", "_"): folder
        for name, folder in zip(names, folders, strict=True)
    }


def _choose(
    dataset: Dataset,
    files: Sequence[RemoteFile],
    scenes: Collection[str],
    out: Path,
    record: _Record,
) -> _Choice:
    files = [file for file in files if not file.path.endswith(dataset.left_out)]
    folders = find_scenes(dataset, (f.path for f in files), dataset.repo.rpartition("/")[2])
    archives = [file for file in files if archive_stem(file.path)]
    if not folders and not archives:
        raise DownloadError(
            dataset.page,
            expected=f"folders of scenes, or archives ({', '.join(ARCHIVES)})",
            found=shown((f.path for f in files), LISTED) or "no files",
            todo="get the dataset by hand",
        )
    known = {*folders, *(archive_stem(archive.path) for archive in archives)}
    known.update(name for a in archives for name in record.archives.get(a.checksum, ()))
    # What one archive for all scenes holds is known when it is here, or was here before.
    one_for_all = len(archives) == 1 and not folders
    if not (one_for_all and archives[0].checksum not in record.archives):
        _check_names(dataset, scenes, known)
    # Beside folders, archives hold the same once more, or what is no scene.
    archives = [
        archive
        for archive in archives
        if (one_for_all or archive_stem(archive.path) in scenes or not (scenes or folders))
        and not _is_there(archive, scenes, out, record)
    ]
    folders = {
        name: folder
        for name, folder in folders.items()
        if (not scenes or name in scenes) and not (out / name).exists()
    }
    below = tuple(folders.values())
    chosen = [*(file for file in files if file.path.startswith(below)), *archives]
    return _Choice(folders, archives, chosen, known)


def _is_there(archive: RemoteFile, scenes: Collection[str], out: Path, record: _Record) -> bool:
    """Return True if all that is wanted of an archive was unpacked before."""
    names = record.archives.get(archive.checksum)
    if names is None:
        return False
    return all((out / name).exists() for name in _wanted(archive, names, scenes))


def _wanted(archive: RemoteFile, names: Iterable[str], scenes: Collection[str]) -> list[str]:
    """Return the requested scenes of an archive, by their names or by its own."""
    whole = not scenes or archive_stem(archive.path) in scenes
    return [name for name in names if whole or name in scenes]


def _remove_others(folder: Path, listed: Collection[Path]) -> None:
    """Remove what the download of an older version has left in the folder of a scene."""
    for path in folder.rglob("*"):
        if path.is_file() and path not in listed:
            path.unlink()


def _unpack(
    dataset: Dataset, archive: RemoteFile, scenes: Collection[str], out: Path, report: Report
) -> tuple[list[str], list[str]]:
    """Unpack the wanted scenes; return the names of all in the archive, and of these."""
    stem = archive_stem(archive.path)
    with open_archive(out / UNFINISHED / archive.path) as members:
        found = find_scenes(dataset, (member.name for member in members), stem)
        if not found:
            raise DownloadError(
                archive.path,
                expected=f"a scene, known by {dataset.scene_file}",
                found=shown(member.name for member in members) or "no files",
                todo="get the dataset by hand",
            )
        new = [n for n in _wanted(archive, found, scenes) if not (out / n).exists()]
        for name in new:
            unpack_scene(members, found[name], out / name, report)
    return sorted(found), new


def _check_names(dataset: Dataset, scenes: Collection[str], known: Collection[str]) -> None:
    if unknown := sorted(set(scenes) - set(known)):
        raise ConfigError(
            dataset.page,
            expected=f"names of scenes: {shown(sorted(known), LISTED)}",
            found=shown(unknown, LISTED),
            todo="name some of these scenes, or none for all",
        )


def _read_record(out: Path) -> _Record:
    try:
        content = read_json_document(out / RECORD)
        return _Record(dict(content["scenes"]), dict(content["archives"]))
    except (SceneError, ValueError, KeyError, TypeError):
        return _Record({}, {})


def _write_record(out: Path, dataset: Dataset, record: _Record) -> None:
    about = {"dataset": dataset.page, "licence": dataset.licence, **asdict(record)}
    write_text_atomic(out / RECORD, json.dumps(about, indent=1) + "\n")
