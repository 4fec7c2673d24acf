"""JSON files and numbers that are not trusted; shared by the formats."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.errors import SceneError
from chronoscene.scene.splits import read_text


def read_json(place: Path, kind: type) -> Any:
    """Read a JSON file that holds a list or an object.

    Raises:
        SceneError: If the file is missing, holds something else, or a text that is no Unicode.
    """
    text = read_text(place)
    try:
        data = json.loads(text, object_pairs_hook=_distinct)
        if re.search(r"\\u[dD][89a-fA-F]", text):  # half of a pair of codes, perhaps alone
            json.dumps(data, ensure_ascii=False).encode()
    except RecursionError as error:
        raise json_error(place, "JSON", "lists or objects nested too deeply") from error
    except ValueError as error:
        raise json_error(place, "JSON", str(error)) from error
    if not isinstance(data, kind):
        expected = "a list" if kind is list else "an object"
        raise json_error(place, expected, type(data).__name__)
    return data


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object; of two equal keys, one would be lost without a word."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:40]!r} twice in an object")
    return found


def json_error(
    place: object, expected: str, found: str, todo: str = "see DATASET.md"
) -> SceneError:
    """Something wrong in a JSON file."""
    return SceneError(place, expected=expected, found=found, todo=todo)


def is_number(value: object) -> bool:
    """Whether a JSON value is a finite number, and no integer beyond what a float can hold."""
    return type(value) in (int, float) and -1e300 < value < 1e300  # type: ignore[operator]


def number(place: object, data: Mapping[str, Any], key: str) -> float | None:
    """A finite number, or None where the key is absent or null."""
    value = data.get(key)
    if value is None:
        return None
    if is_number(value):
        return float(value)
    raise json_error(place, f"a finite number as {key}", repr(value)[:40])
