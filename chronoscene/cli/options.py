"""Options and arguments that several commands share."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable
from functools import reduce
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from chronoscene.errors import ConfigError
from chronoscene.formats import format_names, formats_that_load

PATH = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
EXISTING_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
EXISTING_FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)


class FiniteFloat(click.types.FloatParamType):
    """A number, which infinity and NaN are not, though click takes them for numbers."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Convert the text of an option."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"expected a finite number, found {number}", param, ctx)
        return number


class FiniteRange(FiniteFloat, click.FloatRange):
    """A finite number in a range."""


class OneOfSeveral(click.types.StringParamType):
    """A value of an option that takes several, which click fills up with the next option."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Refuse the name of an option of the command."""
        text: str = super().convert(value, param, ctx)
        known = {name for p in ctx.command.params for name in p.opts} if ctx is not None else ()
        if text.startswith("-") and text.partition("=")[0] in known:
            values = "another value" if param is None else str(param.metavar)
            self.fail(f"expected {values}, found the option {text} in place of one", param, ctx)
        return text


class ImageSize(click.ParamType):
    """Width and height of images in pixels, such as ``320x240``."""

    name = "widthxheight"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Convert the text of an option."""
        match = re.fullmatch(r"([0-9]{1,5})[xX]([0-9]{1,5})", value.strip())
        if match is None:
            self.fail(f"expected WIDTHxHEIGHT, such as 320x240, found {value!r}", param, ctx)
        return int(match[1]), int(match[2])


IMAGE_SIZE = ImageSize()


def _period_help() -> str:
    known = {name: getattr(it, "PERIOD_BY", ()) for name, it in formats_that_load().items()}
    rules = "; ".join(f"{name}: {', '.join(by)}" for name, by in known.items() if by)
    return f"Rule that groups images into periods, for formats with a choice. {rules}."


def reading_options(scene: str) -> Callable[[Any], Any]:
    """Add the options ``--dataset-format`` and ``--period-by`` of a command that reads scenes."""
    help = f"Format of {scene}.  [default: detected]"
    format_option = click.option("--dataset-format", type=click.Choice(format_names()), help=help)
    period_option = click.option("--period-by", metavar="RULE", help=_period_help())
    return lambda command: format_option(period_option(command))


TABLE = click.option(
    "--table",
    type=EXISTING_FILE,
    help="CSV with the columns image and period; paths are relative to CAPTURES.",
)

RUNS = click.argument("folders", metavar="RUNS...", nargs=-1, required=True, type=EXISTING_FOLDER)

SCENES = click.argument("scenes", metavar="[DIR]...", nargs=-1, type=FOLDER)

LINK = click.option(
    "--link", type=click.Choice(["hard", "sym"]), help="Link the images instead of copying them."
)

LPIPS_WEIGHTS = click.option(
    "--lpips-weights",
    type=click.Path(path_type=Path, exists=True),
    help="Folder or file with the weights of LPIPS.",
)

RUNS_OUT = click.option("--out", type=FOLDER, default=Path("runs"), help="Folder for the runs.")


def refuse_options(names: Iterable[str], condition: str) -> None:
    """Refuse options of the running command that were typed and have no effect.

    Args:
        names: Of their parameters.
        condition: Why they have none, such as ``with --periods``.

    Raises:
        ConfigError: If one was typed.
    """
    context = click.get_current_context()
    wanted = set(names)
    typed = [
        parameter
        for parameter in context.command.params
        if parameter.name in wanted
        and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    ]
    if not typed:
        return
    number = len(typed)
    kind = "option" if any(p.param_type_name == "option" for p in typed) else "argument"
    raise ConfigError(
        ", ".join(parameter.opts[0] for parameter in typed),
        expected=f"no such {kind}{'' if number == 1 else 's'} {condition}",
        found="one" if number == 1 else str(number),
        todo="leave it out" if number == 1 else "leave them out",
    )


def split_list(option: str, text: str) -> tuple[str, ...]:
    """Split a comma-separated list, without repetitions; names may have commas in parentheses.

    Raises:
        ConfigError: If an item is empty.
    """
    items = [item.strip() for item in re.split(r",(?![^(]*\))", text)]
    if not all(items):
        raise ConfigError(
            option, expected="names separated by commas", found=repr(text), todo="correct the list"
        )
    return tuple(dict.fromkeys(items))


RUN = click.argument("folder", metavar="RUN", type=PATH)

SCENE = click.option(
    "--scene", type=EXISTING_FOLDER, help="Folder of the scene of the run, if it has moved."
)

STAGE = click.option(
    "--stage",
    type=click.IntRange(min=0),
    help="For strategy sequential: use the model after the period with this number.  "
    "[default: the last]",
)

DEVICE = click.option(
    "--device", type=click.Choice(["cpu", "cuda"]), default="cpu", help="Device to render on."
)


def _plugins(_context: click.Context, _option: click.Parameter, value: str | None) -> Iterable[str]:
    names = () if value is None else split_list("--plugin", value)
    look_here_for(names)
    return names


PLUGIN = click.option(
    "--plugin",
    metavar="module:SPEC",
    callback=_plugins,
    help="Also open runs of this method, which is not installed; several are separated by commas. "
    "Its code is executed.",
)


PRESET = click.option(
    "--preset", default="balanced", help="Preset of the methods, or a file FILE.toml with one."
)

_TRAINING = {
    "preset": PRESET,
    "iterations": click.option(
        "--iterations", type=click.IntRange(min=1), help="Stop after this many iterations."
    ),
    "seeds": click.option(
        "--seeds", type=click.IntRange(min=1), default=1, help="Number of seeds."
    ),
    "assignments": click.option(
        "--set",
        "assignments",
        multiple=True,
        help="Set an option of the methods, as KEY=VALUE or METHOD.KEY=VALUE. May be repeated.",
    ),
    "jobs": click.option(
        "--jobs",
        type=click.IntRange(min=1),
        help="Number of runs at a time.  [default: 1; with --ray, as many as fit]",
    ),
    "job_memory": click.option(
        "--job-memory",
        type=FiniteRange(min=0, min_open=True),
        callback=lambda _context, _option, value: value and round(value * 1e9),
        help="Memory of a run in GB: the next one starts if this much is free.  "
        "[default: an estimate]",
    ),
    "ray": click.option(
        "--ray",
        metavar="ADDRESS",
        help="Address of a Ray cluster to run on; auto for that of this machine.",
    ),
    "threads": click.option(
        "--threads",
        type=click.IntRange(min=1),
        help="Number of threads of a run.  [default: one per processor, divided by --jobs; "
        "with --ray, those of the smallest machine]",
    ),
    "device": click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        help="Device to train and render on.",
    ),
}


def add_options(*names: str) -> Callable[[Any], Any]:
    """Add some of the options of trainings, by the names of their arguments."""
    options = [_TRAINING[name] for name in reversed(names)]
    return lambda command: reduce(lambda found, option: option(found), options, command)


training_options = add_options(*_TRAINING)
"""Add the options that ``bench`` and ``study`` share."""


def parse_assignments(assignments: tuple[str, ...], option: str = "--set") -> dict[str, str]:
    """Parse ``KEY=VALUE`` texts of an option.

    Raises:
        ConfigError: If one has no ``=``, or a key is there twice.
    """
    parsed: dict[str, str] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        key, value = key.strip(), value.strip()
        if not equals or not key:
            raise ConfigError(
                option, expected="KEY=VALUE", found=repr(text), todo="write KEY=VALUE"
            )
        if key in parsed:
            found = f"{parsed[key]} and {value}"
            raise ConfigError(
                f"{option} {key}", expected="one value", found=found, todo="leave one out"
            )
        parsed[key] = value
    return parsed


def look_here_for(names: Iterable[str]) -> None:
    """Make a plug-in ``module:SPEC`` in the current folder importable."""
    if any(":" in name for name in names) and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
