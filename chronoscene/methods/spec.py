"""Descriptions of methods: pure data, found by entry points, which import nothing heavy."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from chronoscene.checks import check_choice, line_of, load_entry, nearest
from chronoscene.errors import ConfigError

PeriodInput = Literal["none", "label", "continuous"]
ENTRY_POINT_GROUP = "chronoscene.methods"
PROGRAM_GROUP = "chronoscene.programs"


@dataclass(frozen=True, slots=True)
class Runner:
    """Commands that train another program, and ask it for the test views.

    A command is a tuple of words. In them, and in the option ``prefix``, these stand for values:
    ``{data}``, the folder of the exported training set; ``{output}``, an empty folder, the current
    one of every command; ``{work}``, the folder that holds both; ``{iterations}``; ``{seconds}``,
    of ``--budget``, 0 without; ``{seed}``; and the options of the config.

    The training set has the test views, too, for the program's own command that renders them, but
    their photos are black, and no point has an observation in them.
    """

    exports: str
    """Format of the training set, one that ``chronoscene convert --to`` writes."""
    train: tuple[str, ...]
    """The command that trains. Its time is the training time."""
    render: tuple[tuple[str, ...], ...]
    """Commands that follow it, and end with an image of each test view; none if training does."""
    images: str
    """Place of these images below ``{output}``, with ``{name}``, the file name of the view in the
    training set without its extension, or ``{index}``, its number among the test views by name."""
    model: str
    """Files of the trained model below ``{output}``, as a glob pattern."""
    primitives: str | None = None
    """PLY file below ``{output}`` with a vertex for each Gaussian, or whatever is drawn."""
    unit: str = "primitives"
    """Name of the primitives: ``Gaussians``, ``anchors``."""
    prepare: str | None = None
    """``module:function``, called with ``{data}``, ``{output}`` and the config before the training:
    it writes there what the export lacks for this program, and returns notices for the user, which
    go on after the title of the method: ``ignores principal points``."""
    version: tuple[str, ...] = ()
    """Command whose last line of output is the version of the program."""
    tested: str = "untested"
    """Note on how far this recipe was tried."""


@dataclass(frozen=True, slots=True)
class ProgramConfig:
    """Options of another program. A class of its own with more fields is possible."""

    iterations: int = 30_000
    """Training steps."""
    prefix: str = ""
    """Words before each command: ``conda run -n ENVIRONMENT``, or ``docker run ... IMAGE``."""
    source: str = ""
    """Folder with the source code of the program, where its commands are files in it."""


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers that a search tries for an option.

    An option that is a pair of numbers is multiplied by the number that is tried.
    """

    low: float
    high: float
    kind: Literal["log", "linear", "int"] = "log"
    """``log``: small numbers as often as large ones; ``int``: whole numbers."""


@dataclass(frozen=True, slots=True)
class MethodSpec:
    """Description of a method, known without importing it."""

    name: str
    """Name on the command line."""
    title: str
    """Name in tables."""
    paper: str
    licence: str
    """Licence of this implementation, and of the official code where it differs."""
    period_input: PeriodInput
    """``none``: hidden from it; ``label``: an integer; ``continuous``: may be fractional."""
    outputs: tuple[str, ...]
    """Subset of ``rgb, alpha, depth``."""
    devices: tuple[str, ...]
    """Subset of ``cpu, cuda``."""
    method: str
    """``module:Class`` that fulfils `Method`; empty where there is a `runner`."""
    config: str
    """``module:Class``, a frozen dataclass with a field ``iterations``. With a `runner`, it
    is a `ProgramConfig`."""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Preset name to the values that differ from the defaults of the config class."""
    titles: Mapping[str, str] = field(default_factory=dict)
    """Names in tables of presets of which `title` would say too much or too little."""
    strategy: str = "joint"
    """Strategy of runs for which none is asked: ``sequential`` if the method is made for periods
    that come one by one."""
    mixes_views: bool = False
    """True if a step learns from pixels of all views at once: no single one makes it empty."""
    learns_background: bool = False
    """True if the model says what is behind everything, so that no view shows the background."""
    per_period: tuple[str, ...] = ()
    """Presets whose iterations are those of each period: each stage of ``sequential`` and each
    model of ``separate`` has all of them, and a model of several periods as often as many."""
    draws_gaussians: bool = True
    """False if it works on a GPU without gsplat."""
    resumable: bool = False
    """True if it has `Method.save_training` and `Method.load_training`."""
    main_options: tuple[str, ...] = ()
    """Options that people change first, in the order of ``chronoscene methods NAME``, which shows
    these alone unless asked for all. Empty: all options."""
    search: Mapping[str, tuple[str | bool | int | float, ...] | Range] = field(default_factory=dict)
    """Options that ``chronoscene tune`` searches over: the values to choose from, or a range."""
    runner: Runner | None = None
    """Commands, if it is another program."""

    def title_of(self, preset: str) -> str:
        """Return the name in tables of the method with a preset."""
        return self.titles.get(preset, self.title)


def import_object(reference: str) -> Any:
    """Import ``module:Name``.

    Raises:
        ConfigError: If there is no such module, its import fails, or it has no such name.
    """
    place, _, name = reference.partition(":")
    try:
        module = importlib.import_module(place)
    except Exception as error:  # whatever the code of others raises
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if not place or place[0] == "." or f"{place}.".startswith(f"{missing}."):
            raise ConfigError(
                reference,
                expected="an importable module:Name",
                found=str(error),
                todo="check the spelling; start the command in the folder of the module, or "
                "install its package",
            ) from error
        raise ConfigError(
            reference,
            expected="a module that can be imported",
            found=f"{type(error).__name__}: {error}{line_of(error)}",
            todo=f"correct {place}, or install what it needs",
        ) from error
    try:
        return getattr(module, name)
    except AttributeError as error:
        raise ConfigError(
            reference,
            expected=f"a name in the module {place}",
            found=f"none called {name!r}",
            todo=nearest(name, dir(module), otherwise="define it there, or check the spelling"),
        ) from error


def method_names(group: str = ENTRY_POINT_GROUP) -> tuple[str, ...]:
    """Return the sorted names of the methods of an entry-point group; import none of them."""
    return tuple(sorted({entry.name for entry in _entries(group, tuple(sys.path))}))


def installed_methods() -> dict[str, EntryPoint]:
    """Return the entry points of all methods, other programs among them, by name."""
    return {entry.name: entry for entry in _all_entries()}


def _all_entries() -> tuple[EntryPoint, ...]:
    path = tuple(sys.path)
    return (*_entries(PROGRAM_GROUP, path), *_entries(ENTRY_POINT_GROUP, path))


@cache
def _entries(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Look through the packages on a module path once: it reads a file of each of them."""
    return tuple(entry_points(group=group))


def load_spec(name: str) -> MethodSpec:
    """Find a method by its name, or by ``module:SPEC`` while it is being developed.

    Raises:
        ConfigError: If there is no such method; the message lists the known ones. Or if it is
            installed, but by several packages, or cannot be imported.
    """
    if ":" in name:
        spec = import_object(name)
    else:
        check_choice("--method", name, installed_methods())
        spec = load_entry(_all_entries(), name, "method")
    if not isinstance(spec, MethodSpec):
        raise ConfigError(
            name, expected="a MethodSpec", found=type(spec).__name__, todo="name its SPEC object"
        )
    return spec
