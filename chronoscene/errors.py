"""Errors that a user can act on."""

from __future__ import annotations

from functools import partial
from typing import Any

MAX_LENGTH = 1000
"""Characters of ``expected`` and ``found``: text from a damaged file may have millions."""


class ChronoSceneError(Exception):
    """A problem with what the user gave us, never with our own invariants.

    The message has one form: ``place: expected X, found Y; what to do``. The command line prints it
    on one line and exits with status 2.

    Args:
        place: File, file and line, option or argument where the problem sits.
        expected: What would have been right there. Shown up to `MAX_LENGTH` characters.
        found: What is there instead; likewise.
        todo: What the user can do about it.
    """

    def __init__(self, place: object, *, expected: str, found: str, todo: str) -> None:
        expected, found = _shortened(expected), _shortened(found)
        self.place = str(place)
        self.expected = expected
        self.found = found
        self.todo = todo
        super().__init__(f"{place}: expected {expected}, found {found}; {todo}")

    @property
    def fields(self) -> dict[str, str]:
        """Arguments by name."""
        return {key: getattr(self, key) for key in ("place", "expected", "found", "todo")}

    def __reduce__(self) -> tuple[Any, ...]:
        # By default, exceptions are unpickled without keyword arguments.
        return partial(type(self), **self.fields), ()


def _shortened(text: str) -> str:
    """Beginning and end of a long text."""
    half = MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]} ... {text[-half:]}"


class ConfigError(ChronoSceneError):
    """An option, preset or configuration value that does not exist or does not fit."""


class SceneError(ChronoSceneError):
    """A scene folder that cannot be read or lacks required information."""


class ImageError(SceneError):
    """An image that is missing, damaged or of an unsupported kind."""


class DiskFullError(ChronoSceneError):
    """A disk without space for what is to be written; nothing half written is left."""


class DownloadError(ChronoSceneError):
    """A host that does not answer, or what came from it and is not what it should be."""


class RegistrationError(ChronoSceneError):
    """Photos that cannot be registered, or a step that failed; what was computed is kept."""


class ProgramError(ChronoSceneError):
    """Another program that cannot be started, or that failed."""


class CheckpointError(ChronoSceneError):
    """A checkpoint or run folder that is incomplete or of another kind."""


class ShapeError(ChronoSceneError):
    """An array argument with the wrong shape, type or values."""


class BackendError(ChronoSceneError):
    """A compute backend that is unknown or not usable on this machine."""


class MetricUnavailableError(ChronoSceneError):
    """A metric that cannot be computed on this machine (its weights are missing, say)."""
