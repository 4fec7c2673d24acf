"""Names of images: safe ones, and the meaning of misspelt ones."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from chronoscene.errors import SceneError
from chronoscene.formats.chronoscene import check_name
from chronoscene.scene.splits import composed

PUNCTUATION = "\"'`,;"  # What tables put around and after a name


def is_safe(name: str) -> bool:
    """Return True if an image name stays below ``images/``."""
    try:
        check_name(Path(), name)
    except SceneError:
        return False
    return True


def spelling(name: str) -> str:
    """Return a key without case, spelling of accented letters in Unicode, and backslashes."""
    return composed(name).casefold().replace("\\", "/")


class Spellings:
    """Finds the one name that another one probably means."""

    def __init__(self, names: Iterable[str]) -> None:
        self._by_key: tuple[dict[str, set[str]], ...] = ({}, {}, {})
        for name in names:
            for table, key in zip(self._by_key, _keys(name), strict=True):
                table.setdefault(key, set()).add(name)

    def find(self, text: str) -> str | None:
        """Return the name with the same full name, else file name, else without extension.

        None if the first of these that matches any name matches several.
        """
        for table, key in zip(self._by_key, _keys(text.strip(PUNCTUATION)), strict=True):
            if found := table.get(key):
                return next(iter(found)) if len(found) == 1 else None
        return None


def _keys(name: str) -> tuple[str, str, str]:
    full = spelling(name)
    return full, PurePosixPath(full).name, PurePosixPath(full).stem
