"""Text and JSON files that are not trusted: read completely, or refused with one message."""

from __future__ import annotations

import errno
import json
import re
import stat
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.errors import ChronoSceneError, SceneError


def plain_file(path: Path) -> Path:
    """Return the path of a file that can be read to its end: of pipes and devices, none is known.

    Raises:
        OSError: If it is such a one, or missing.
    """
    kind = path.stat().st_mode
    if stat.S_ISREG(kind) or stat.S_ISDIR(kind):  # opening a folder says what is wrong
        return path
    raise OSError(errno.EINVAL, "a pipe or device, not a file", str(path))


def read_text(path: Path, *, error: type[ChronoSceneError] = SceneError) -> str:
    """Read a small text file written by any common editor (UTF-8 with or without BOM, UTF-16).

    Args:
        path: The file.
        error: Class of the error that is raised.

    Raises:
        ChronoSceneError: If it is missing or not text.
    """
    try:
        return decode_text(plain_file(path).read_bytes())
    except UnicodeDecodeError:
        found, todo = "bytes that are not UTF-8", "save it as UTF-8"
    except FileNotFoundError:
        found, todo = "nothing", "check the path"
    except IsADirectoryError:
        found, todo = "a folder", "name a file"
    except OSError as failure:
        found = failure.strerror or "a file that cannot be read"
        todo = "make it readable, or check the path"
    raise error(path, expected="a text file", found=found, todo=todo)


def decode_text(data: bytes) -> str:
    """Decode UTF-8 or, after its byte order mark, UTF-16 (as some Windows shells write)."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16")
    return data.decode("utf-8-sig")


def filled_lines(text: str) -> list[tuple[int, str]]:
    """Number the filled lines of a table, from 1; spreadsheets leave commas in empty ones."""
    lines = enumerate(text.splitlines(), 1)
    return [(number, line) for number, line in lines if line.replace(",", " ").strip()]


def read_json_document(
    place: Path,
    kind: type = dict,
    *,
    error: type[ChronoSceneError] = SceneError,
    todo: str = "correct the file",
) -> Any:
    """Read a JSON file that holds an object or a list.

    Args:
        place: The file.
        kind: ``dict`` or ``list``.
        error: Class of the error that is raised.
        todo: Advice if the content is damaged.

    Raises:
        ChronoSceneError: If the file is missing or damaged, repeats a key, or holds another kind.
    """
    text = read_text(place, error=error)
    expected = "JSON"
    try:
        data = json.loads(text, object_pairs_hook=_distinct)
        if re.search(r"\\u[dD][89a-fA-F]", text):  # half of a surrogate pair, perhaps alone
            json.dumps(data, ensure_ascii=False).encode()
        if isinstance(data, kind):
            return data
        expected, found = "a list" if kind is list else "an object", type(data).__name__
    except RecursionError:
        found = "lists or objects nested too deeply"
    except ValueError as failure:
        found = str(failure)
    raise error(place, expected=expected, found=found, todo=todo)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object; of two equal keys, one would be lost silently."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:40]!r} twice in an object")
    return found


def json_error(
    place: object, expected: str, found: str, todo: str = "correct the file"
) -> SceneError:
    """Make the error for a wrong value in a JSON file of a scene."""
    return SceneError(place, expected=expected, found=found, todo=todo)


def is_number(value: object) -> bool:
    """Return whether a JSON value is a finite number that a float can hold."""
    return type(value) in (int, float) and -1e300 < value < 1e300  # type: ignore[operator]


def number(place: object, data: Mapping[str, Any], key: str) -> float | None:
    """Return a finite number, or None where the key is absent or null."""
    value = data.get(key)
    if value is None:
        return None
    if is_number(value):
        return float(value)
    raise json_error(place, f"a finite number as {key}", repr(value)[:40])
