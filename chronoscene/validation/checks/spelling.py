"""Names that differ from those of images by what people and programs change without noticing."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath

PUNCTUATION = "\"'`,;"
"""What tables have around and behind a name."""


def spelling(name: str) -> str:
    """A key that ignores case, the two Unicode spellings of accented letters, and backslashes."""
    return unicodedata.normalize("NFC", name).casefold().replace("\\", "/")


class Spellings:
    """Finds the one name that another one probably means."""

    def __init__(self, names: Iterable[str]) -> None:
        self._by_key: tuple[dict[str, set[str]], ...] = ({}, {}, {})
        for name in names:
            for table, key in zip(self._by_key, _keys(name), strict=True):
                table.setdefault(key, set()).add(name)

    def find(self, text: str) -> str | None:
        """The name with the same full name, file name, or file name without extension.

        The first of these that fits any name decides; None where it fits several.
        """
        for table, key in zip(self._by_key, _keys(text.strip(PUNCTUATION)), strict=True):
            if found := table.get(key):
                return next(iter(found)) if len(found) == 1 else None
        return None


def _keys(name: str) -> tuple[str, str, str]:
    full = spelling(name)
    return full, PurePosixPath(full).name, PurePosixPath(full).stem
