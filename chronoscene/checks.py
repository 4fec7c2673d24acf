"""Checks on arguments that cross a package boundary."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import Any

from chronoscene.errors import ChronoSceneError, ConfigError, ShapeError


def check_shape(name: str, array: Any, shape: Sequence[int | None]) -> None:
    """Raise unless ``array.shape`` matches ``shape``; ``None`` matches any length.

    Raises:
        ShapeError: If the number of axes or a given length differs.
    """
    actual = tuple(array.shape)
    if len(actual) != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, actual, strict=True)
    ):
        wanted = "[" + ", ".join("*" if n is None else str(n) for n in shape) + "]"
        raise ShapeError(
            name, expected=f"shape {wanted}", found=str(list(actual)), todo="reshape the argument"
        )


def check_choice(
    place: str, value: str, known: Iterable[str], *, error: type[ChronoSceneError] = ConfigError
) -> str:
    """Return ``value`` if it is one of ``known``, else raise naming the known ones."""
    names = sorted(known)
    if value in names:
        return value
    hint = nearest(value, names, otherwise="choose one of them")
    raise error(place, expected=f"one of {', '.join(names)}", found=repr(value), todo=hint)


def nearest(value: str, known: Sequence[str], *, otherwise: str) -> str:
    """Return advice that names the known word most like a value, or else the other advice."""
    close = get_close_matches(value, known, n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def import_extra(package: str, extra: str, place: str) -> Any:
    """Import a package that only one extra of ChronoScene needs.

    Args:
        package: Name of the module.
        extra: Name of the extra that installs it.
        place: Command or option that needs it.

    Raises:
        ConfigError: If it is not installed, or cannot be loaded.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise ConfigError(
            place,
            expected=f"the package {package}",
            found=str(error),
            todo=f"pip install 'chronoscene[{extra}]'",
        ) from error


def load_entry(entries: Iterable[EntryPoint], name: str, kind: str) -> Any:
    """Import what an entry point names; its package may be of another version, or broken.

    Args:
        entries: Entry points of installed packages.
        name: Of one of these.
        kind: Of the plug-in, such as ``method``.

    Raises:
        ConfigError: If several packages have one of this name, or the import fails.
    """
    entry, *others = [entry for entry in entries if entry.name == name]
    package = _package(entry)
    if others:
        raise ConfigError(
            f"{kind} {name}",
            expected="one package that has it",
            found=" and ".join([package, *map(_package, others)]),
            todo="uninstall all but one",
        )
    try:
        return entry.load()
    except Exception as error:  # whatever the code of others raises
        raise ConfigError(
            f"{kind} {name}",
            expected=f"{entry.value}, which the package {package} names",
            found=f"{type(error).__name__}: {error}",
            todo=f"install what {package} needs, or another version of it, or uninstall it",
        ) from error


def line_of(error: Exception) -> str:
    """Return the line that raised an error, in parentheses; nothing if there is no file."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return "" if frame.filename.startswith("<") else f" ({frame.filename}:{frame.lineno})"


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist else entry.module
