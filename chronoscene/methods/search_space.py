"""Search spaces of methods: whether a preset lies in one, and what is drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from chronoscene.errors import ConfigError
from chronoscene.methods.options import MethodConfig
from chronoscene.methods.spec import MethodSpec, Range

if TYPE_CHECKING:
    from optuna.trial import BaseTrial

DIGITS = 4  # Of numbers that are drawn: more would say nothing


def starting_point(spec: MethodSpec, config: MethodConfig) -> dict[str, Any]:
    """Return what a trial draws where it has the options of a config.

    Raises:
        ConfigError: If the method has no search space, or the config lies outside of it.
    """
    if not spec.search:
        raise ConfigError(
            f"tune {spec.name}",
            expected="a method with a search space",
            found="none",
            todo='add a search to its MethodSpec, such as search={"OPTION": Range(LOW, HIGH)}: '
            "docs/guides/adding-a-method.md",
        )
    options = dataclasses.asdict(config)
    point = {}
    for name, space in spec.search.items():
        value = 1.0 if isinstance(options[name], tuple) else options[name]
        inside = value in space if isinstance(space, tuple) else space.low <= value <= space.high
        if not inside:
            raise ConfigError(
                f"tune {spec.name}: {name}",
                expected=f"a preset within {describe(space)}",
                found=str(options[name]),
                todo="start from another preset, or widen the search space of the method",
            )
        point[name] = value
    return point


def describe(space: tuple[Any, ...] | Range) -> str:
    """Return the values that are tried, in words."""
    if isinstance(space, tuple):
        return " or ".join(map(str, space))
    return f"{space.low:g} to {space.high:g}"


def draw(trial: BaseTrial, spec: MethodSpec, config: MethodConfig) -> dict[str, Any]:
    """Draw the options of a trial; return those that differ from the config where it starts."""
    options, drawn = dataclasses.asdict(config), {}
    for name, space in spec.search.items():
        now, value = options[name], _draw(trial, name, space)
        if isinstance(now, tuple) and value == 1.0:
            continue
        if isinstance(now, tuple):
            drawn[name] = tuple(_rounded(part * value) for part in now)
        elif value != now:
            drawn[name] = _rounded(value)
    return drawn


def _draw(trial: BaseTrial, name: str, space: tuple[Any, ...] | Range) -> Any:
    if isinstance(space, tuple):
        return trial.suggest_categorical(name, space)
    if space.kind == "int":
        return trial.suggest_int(name, int(space.low), int(space.high))
    return trial.suggest_float(name, space.low, space.high, log=space.kind == "log")


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def ends(spec: MethodSpec, config: MethodConfig) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the options at the lower and at the upper end of each range, or the outer choices."""
    options = dataclasses.asdict(config)

    def at(end: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, space in spec.search.items():
            value = space[end] if isinstance(space, tuple) else (space.low, space.high)[end]
            now = options[name]
            found[name] = tuple(part * value for part in now) if isinstance(now, tuple) else value
        return found

    return at(0), at(-1)
