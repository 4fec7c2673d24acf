"""Presets in TOML files: options of a method, and how they were found."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from chronoscene.errors import ConfigError
from chronoscene.methods.spec import MethodSpec

SUFFIX = ".toml"


class PresetFile(BaseModel):
    """Content of a preset file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: str
    base: str
    """Preset of the method that it starts from."""
    options: Mapping[str, Any] = {}
    """Values that differ from those of the base."""
    tuning: Mapping[str, Any] = {}
    """Search by which the options were chosen, for the reader; nothing depends on it."""


def is_preset_file(preset: str) -> bool:
    """Return True if a preset is a file, and not one of those of a method."""
    return preset.endswith(SUFFIX)


def preset_name(preset: str) -> str:
    """Return the name of a preset: that of its file without the ending, if it has one."""
    return Path(preset).stem if is_preset_file(preset) else preset


def read_preset_file(path: Path, spec: MethodSpec) -> PresetFile:
    """Read a preset file of a method.

    Raises:
        ConfigError: If it is missing or damaged, of another method, or has the name of a preset.
    """
    try:
        preset = PresetFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _wrong(path, "a preset file", f"{first['msg']} ({where})") from error
    except (OSError, ValueError) as error:  # ValueError: TOML or UTF-8
        found = str(getattr(error, "strerror", None) or error)
        raise _wrong(path, "a preset file", found) from error
    if preset.method != spec.name:
        raise _wrong(path, f"a preset of {spec.name}", f"one of {preset.method}")
    if path.stem in spec.presets:
        raise _wrong(path, f"another name than presets of {spec.name} have", path.stem)
    return preset


def find_preset(preset: str, spec: MethodSpec) -> PresetFile:
    """Return a preset of a method: that of a file, or one by its name, without further options.

    Raises:
        ConfigError: As `read_preset_file`. Names are not checked.
    """
    if is_preset_file(preset):
        return read_preset_file(Path(preset), spec)
    return PresetFile(method=spec.name, base=preset)


def _wrong(path: Path, expected: str, found: str) -> ConfigError:
    todo = "choose another file, or correct it as docs/guides/tuning.md describes"
    return ConfigError(f"--preset {path}", expected=expected, found=found, todo=todo)


def preset_text(preset: PresetFile) -> str:
    """Return the text of a preset file."""
    lines = [f"method = {json.dumps(preset.method)}", f"base = {json.dumps(preset.base)}"]
    for name, values in (("options", preset.options), ("tuning", preset.tuning)):
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """Return a value, list or mapping in TOML. JSON has the same texts, but for DEL."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
