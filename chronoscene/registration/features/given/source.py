"""Sources of given features and matches, and the photos that names in them mean."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

from chronoscene.checks import load_entry
from chronoscene.errors import ConfigError
from chronoscene.io.documents import plain_file
from chronoscene.io.staging import sha256_of
from chronoscene.registration.features.given.colmap_database import ColmapDatabase
from chronoscene.registration.features.given.hloc import HlocFile
from chronoscene.registration.features.given.image_features import wrong
from chronoscene.scene.splits import composed

Kind = Literal["hloc", "COLMAP", "plug-in"]

GROUPS = {"--features": "chronoscene.extractors", "--matches": "chronoscene.matchers"}
"""Groups of entry points; see docs/guides/registration.md."""

_MAGIC: dict[bytes, Kind] = {b"\x89HDF\r\n\x1a\n": "hloc", b"SQLite format 3\0": "COLMAP"}


@dataclass(frozen=True, slots=True)
class Source:
    """A file, or an installed extractor or matcher."""

    kind: Kind
    place: str
    """Path of the file, or name of the entry point."""
    version: str
    """SHA-256 of the file, or version of the package."""

    @property
    def text(self) -> str:
        """Name for people."""
        if self.kind == "plug-in":
            return f"{self.place} ({self.version})"
        return f"{Path(self.place).name} ({self.kind}, SHA-256 {self.version[:12]})"


def find_sources(features: str | None, matches: str | None) -> dict[str, Any] | None:
    """Features and matches to use, as plain data for tasks and records; None for neither.

    Raises:
        ConfigError: If there is no such file or plug-in, or matches come without features.
    """
    if features is None:
        if matches is not None:
            raise ConfigError("--matches", expected="the features that they refer to",
                              found="none", todo="give --features, too")  # fmt: skip
        return None
    first = _find("--features", features)
    second = None if matches is None else _find("--matches", matches)
    return {"features": asdict(first), "matches": None if second is None else asdict(second)}


def describe(given: dict[str, Any]) -> str:
    """Name the sources for the certificate."""
    text = f"features of {Source(**given['features']).text}"
    if given["matches"] is not None:
        text += f", matches of {Source(**given['matches']).text}"
    return text


def _find(option: str, text: str) -> Source:
    path = Path(text)
    if path.exists():
        with plain_file(path).open("rb") as file:
            head = file.read(16)
        for magic, kind in _MAGIC.items():
            if head.startswith(magic):
                return Source(kind, str(path.resolve()), sha256_of(path))
        todo = "give features.h5 or matches.h5 of hloc, or a database of COLMAP"
        raise ConfigError(option, expected="a file of HDF5 or SQLite", found=text, todo=todo)
    for entry in entry_points(group=GROUPS[option]):
        if entry.name == text:
            package = entry.dist
            version = "" if package is None else f"{package.name} {package.version}"
            return Source("plug-in", text, version)
    known = sorted(entry.name for entry in entry_points(group=GROUPS[option]))
    expected = f"a file, or an installed plug-in ({', '.join(known) or 'there is none'})"
    todo = f"correct it; plug-ins are entry points of the group {GROUPS[option]}"
    raise ConfigError(option, expected=expected, found=repr(text), todo=todo)


def open_file(source: Source) -> HlocFile | ColmapDatabase:
    """Open the file of a source."""
    return (HlocFile if source.kind == "hloc" else ColmapDatabase)(Path(source.place))


def load_plugin(option: str, source: Source) -> Any:
    """Load the object of an entry point."""
    entries = entry_points(group=GROUPS[option])
    if all(entry.name != source.place for entry in entries):
        raise wrong(source.place, "an installed plug-in", "none of this name", "install it again")
    return load_entry(entries, source.place, option)


def match_names(place: str, photos: Sequence[str], stored: Iterable[str]) -> dict[str, str]:
    """Name in a file of each photo that it has, by the name of the photo.

    One may be the end of the other, where that is unique: hloc and COLMAP know photos below the
    folder that they were given.

    Raises:
        RegistrationError: If a name fits several photos, or none fits.
    """
    by_end: dict[str, list[str]] = {}
    for photo in photos:
        parts = composed(photo).split("/")
        for i in range(len(parts)):
            by_end.setdefault("/".join(parts[i:]), []).append(photo)
    found: dict[str, str] = {}
    for name in stored:
        plain = re.sub(r"\s", "_", composed(name))
        parts = plain.split("/")
        ends = ("/".join(parts[i:]) for i in range(len(parts)))
        fits = next((f for end in ends if (f := by_end.get(end) or by_end.get(f"{end}.png"))), [])
        if len(fits) > 1:
            todo = "extract features with the folders of the dates in the names of the photos"
            raise wrong(place, "names that fit one photo each",
                        f"{name!r}, which fits {fits[0]} and {fits[1]}", todo)  # fmt: skip
        if fits and found.setdefault(fits[0], name) != name:
            raise wrong(place, f"one entry for {fits[0]}", f"{found[fits[0]]!r} and {name!r}",
                        "remove one of them")  # fmt: skip
    if not found:
        raise wrong(place, f"features of photos such as {photos[0]}", "none of them",
                    "correct the names, or the path of the file")  # fmt: skip
    return found
