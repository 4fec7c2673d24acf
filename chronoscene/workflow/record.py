"""Record of the steps in ``steps.json``: what was made, of what, and how long it took."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from chronoscene.harness.files.records import read_document
from chronoscene.images.masks import MASKS
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import counted
from chronoscene.registration.photos.captures import photos_in, photos_of

RECORD_FILE = "steps.json"

Options = Mapping[str, str | int | None]
State = Literal["done", "skipped", "failed"]


class StepRecord(BaseModel):
    """Outcome of a step."""

    model_config = ConfigDict(extra="forbid")

    state: State
    key: str
    """Fingerprint of all that the result depends on."""
    seconds: float
    """Duration of the last attempt."""
    reason: str = ""
    """Explanation of a step that was skipped or failed."""
    results: list[str] = []
    """Files by which the result is known, relative to the folder of all steps."""


class Record(BaseModel):
    """Content of ``steps.json``."""

    model_config = ConfigDict(extra="forbid")

    photos: dict[str, tuple[int, int]]
    """Size in bytes and time of the last change (ns) of photos, masks and the table of periods, by
    their paths from the folder of the photos. Photos that were merely copied again cost a call of
    `registration`, which looks into them."""
    options: dict[str, str | int | None]
    """Options of the command by name."""
    steps: dict[str, StepRecord] = {}

    def write(self, out: Path) -> None:
        """Write it into the folder of all steps."""
        write_text_atomic(out / RECORD_FILE, self.model_dump_json(indent=1) + "\n")


def read_record(out: Path) -> Record | None:
    """Read the record of a folder; None if it has none."""
    if not (out / RECORD_FILE).is_file():
        return None
    return read_document(out / RECORD_FILE, Record, expected="a record of steps")


def new_record(folder: Path, table: Path | None, options: Options) -> Record:
    """Make a record of what there is, without steps."""
    masks = folder.absolute().parent / MASKS
    files = [*photos_of(folder, table), *photos_in(masks), *([] if table is None else [table])]
    status = {os.path.relpath(path, folder): path.stat() for path in files}
    photos = {name: (found.st_size, found.st_mtime_ns) for name, found in status.items()}
    return Record(photos=photos, options=dict(options))


def describe_changes(old: Record, new: Record) -> dict[str, str]:
    """Describe what differs, by ``photos`` or the name of the option; empty if nothing does."""
    there, gone = new.photos, old.photos
    counts = {
        "added": len(there.keys() - gone.keys()),
        "removed": len(gone.keys() - there.keys()),
        "changed": sum(gone.get(name, status) != status for name, status in there.items()),
    }
    words = [f"{counted(number, 'file')} {verb}" for verb, number in counts.items() if number]
    found = {"photos": ", ".join(words)} if words else {}
    for name, value in new.options.items():
        if (before := old.options.get(name)) != value:
            option = f"--{name.replace('_', '-')}"
            found[name] = f"{option} {value or 'left out'} instead of {before or 'left out'}"
    return found
