"""Options of methods: from presets and text to the frozen config of a method, and back.

A config is a frozen dataclass. Its annotations say what an option may be: a type, a ``Literal`` of
choices, a bound such as ``PositiveInt`` or ``Annotated[float, Field(lt=0.5)]``. pydantic checks
them; docstrings below the fields say what they mean.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from textwrap import dedent
from typing import Any, ClassVar, Protocol, get_type_hints

from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from chronoscene.checks import check_choice, nearest
from chronoscene.errors import ConfigError
from chronoscene.methods.preset_files import find_preset
from chronoscene.methods.spec import MethodSpec, import_object


class Options(Protocol):
    """A frozen dataclass with a default for each field."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]


class MethodConfig(Options, Protocol):
    """Options of a method."""

    @property
    def iterations(self) -> int:
        """Training steps."""


def build_config(
    spec: MethodSpec, *, preset: str, overrides: Mapping[str, Any] | None = None
) -> MethodConfig:
    """Make the frozen config of a method from a preset and values given by the user.

    Text is read as the annotation of the option asks for, so ``--set`` can pass it as typed.

    Args:
        spec: The method.
        preset: Name of one of its presets, or the path of a preset file.
        overrides: Values that replace those of the preset.

    Raises:
        ConfigError: If the preset or a key is unknown, a value is not what the option takes, or an
            option that is given has no effect beside the others.
    """
    config_class = import_object(spec.config)
    start = find_preset(preset, spec)
    check_choice(f"{spec.name} --preset", start.base, spec.presets)
    adapters, values = _adapters(config_class), dict(spec.presets[start.base])
    places = ((preset, start.options), (f"{spec.name} --set", overrides or {}))
    for place, given in places:
        for key, value in given.items():
            check_choice(place, key, adapters)
            values[key] = _parsed(f"{place} {key}", value, adapters[key])
    config: MethodConfig = config_class(**values)
    idle = idle_options(config)
    for place, given in places:
        for key in given.keys() & idle.keys():
            raise ConfigError(
                f"{place} {key}",
                expected=f"{idle[key]}, without which it has no effect",
                found="another value of that option",
                todo=f"leave {key} out, or change that option",
            )
    return config


def idle_options(config: MethodConfig) -> dict[str, str]:
    """Return options that have no effect beside the others of a config, and what they need."""
    return config.without_effect() if hasattr(config, "without_effect") else {}


def config_from_values(spec: MethodSpec, values: Mapping[str, Any]) -> MethodConfig:
    """Make the frozen config of a method from all of its values, as JSON gives them back.

    Raises:
        ConfigError: If the config class has other fields: the method has changed since.
    """
    listed = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    try:
        return import_object(spec.config)(**listed)
    except TypeError as error:
        raise ConfigError(
            f"{spec.name}: configuration",
            expected="the options that this version of the method has",
            found=str(error),
            todo="use the version of the software that made the run, or run bench again",
        ) from error


def check_options(config: Options) -> None:
    """Check all options of a config against its annotations; call it in ``__post_init__``.

    Raises:
        ConfigError: If a value has another type, is out of bounds or not among the choices.
    """
    for name, adapter in _adapters(type(config)).items():
        try:
            adapter.validate_python(getattr(config, name), strict=True)
        except ValidationError as error:
            raise _refusal(name, error) from error


_FINITE = ConfigDict(allow_inf_nan=False)  # A config is stored as JSON, which has no others


@cache
def _adapters(config_class: type[Options]) -> dict[str, TypeAdapter[Any]]:
    """Return what checks and reads each option, by its name."""
    try:
        kinds = get_type_hints(config_class, include_extras=True)
        fields = dataclasses.fields(config_class)
        return {f.name: TypeAdapter(kinds[f.name], config=_FINITE) for f in fields}
    except (NameError, PydanticUserError) as error:
        raise ConfigError(
            f"{config_class.__module__}.{config_class.__name__}",
            expected="fields with types that pydantic can read",
            found=str(error).splitlines()[0],
            todo="annotate plain types, and import their names outside of TYPE_CHECKING",
        ) from error


def _parsed(place: str, value: object, adapter: TypeAdapter[Any]) -> Any:
    """Read a value as given: text that the option takes as it is, or else JSON or a tuple."""
    readings = [json.dumps(value, default=_plain)]
    if isinstance(value, str):
        text = value.lower() if value.lower() in ("true", "false") else value
        readings.append(re.sub(r"^\((.*?),?\s*\)$", r"[\1]", text))
    refusal: ValidationError | None = None
    for reading in readings:
        try:
            return adapter.validate_json(reading, strict=True)
        except ValidationError as error:
            if refusal is None or error.errors()[0]["type"] != "json_invalid":
                refusal = error
    assert refusal is not None
    raise _refusal(place, refusal) from refusal


_EXPECTED = {
    "missing": "more values",
    "too_long": "fewer values",
    "tuple_type": "values in parentheses, such as (1, 2)",
}
"""Types of pydantic's findings whose messages do not fit behind "expected"."""


def _refusal(place: str, error: ValidationError) -> ConfigError:
    """Return pydantic's first finding as an error of one line."""
    (finding, *_) = error.errors(include_url=False)
    expected = _EXPECTED.get(finding["type"], finding["msg"].removeprefix("Input should be "))
    expected = re.sub("^(greater|less) than", r"a value \g<0>", expected)
    known = re.findall(r"'([^']*)'", expected) if finding["type"] == "literal_error" else []
    return ConfigError(
        place,
        expected=expected,
        found=repr(finding["input"]),
        todo=nearest(str(finding["input"]), known, otherwise="correct the value"),
    )


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a method, as ``chronoscene methods NAME`` lists it."""

    name: str
    default: Any
    presets: dict[str, Any]
    """Preset name to its value, where it differs from the default."""
    meaning: str
    """Docstring below the field; empty if there is none."""


def options_of(spec: MethodSpec) -> list[Option]:
    """Return all options of a method: its main ones, then the others as its class has them."""
    config_class = import_object(spec.config)
    meanings: dict[str, str] = {}
    for base in reversed(config_class.__mro__[:-1]):
        meanings |= _field_docstrings(base)
    options = []
    for name, default in dataclasses.asdict(config_class()).items():
        values = {key: preset.get(name, default) for key, preset in spec.presets.items()}
        differ = {key: value for key, value in values.items() if value != default}
        options.append(Option(name, default, differ, meanings.get(name, "")))
    places = {name: place for place, name in enumerate(spec.main_options)}
    return sorted(options, key=lambda option: places.get(option.name, len(places)))


def _field_docstrings(config_class: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class, by name, from its source.

    pydantic does the same, but only for classes that ask for it, and not for their bases.
    """
    try:
        (definition,) = ast.parse(dedent(inspect.getsource(config_class))).body
    except (OSError, TypeError):  # made without a file
        return {}
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field_, text in itertools.pairwise(definition.body):
        if isinstance(field_, ast.AnnAssign) and isinstance(field_.target, ast.Name):
            match text:
                case ast.Expr(ast.Constant(str(docstring))):
                    found[field_.target.id] = " ".join(docstring.split())
    return found


def as_typed(value: Any) -> str:
    """Return a value of an option as ``--set`` takes it."""
    return value if isinstance(value, str) else json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    """Return what JSON has in place of a number or array of NumPy; it has nothing else."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise ConfigError(
        "value of an option",
        expected="text, a number, true or false, or several of these",
        found=repr(value),
        todo="correct the value; dates are text, in quotes",
    )
