"""What a method is: data that describes it, and the interface that the harness drives.

A method is a plug-in. Its `MethodSpec` is pure data, found through the entry-point group
``chronoscene.methods``; listing methods imports nothing heavy. Its class fulfils `Method`. The
harness owns the loop, the clock, the seeds and the files; a method sees a `TrainingSet` in the
normalised training frame and never a dataset folder.

A method may instead be another program, which trains itself in an environment of its own: then its
spec has a `Runner` and no class, and its entry point is in the group ``chronoscene.programs``.

A method that splats Gaussians need not implement all of `Method`: `GaussianMethod` in
`chronoscene.gaussians` and `AnchorMethod` in `chronoscene.anchors` do it, and say what to override.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from textwrap import dedent
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.similarity import Sim3

PeriodInput = Literal["none", "label", "continuous"]
Skipped = Literal["empty", "not finite"]
ENTRY_POINT_GROUP = "chronoscene.methods"
PROGRAM_GROUP = "chronoscene.programs"


@dataclass(frozen=True, slots=True)
class Runner:
    """How another program is trained, and asked for the test views.

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
    """Commands that follow it, and end with an image of each test view."""
    images: str
    """Place of these images below ``{output}``, with ``{name}``, the file name of the view in the
    training set without its extension, or ``{index}``, its number among the test views by name."""
    model: str
    """Files of the trained model below ``{output}``, as a glob pattern."""
    primitives: str | None = None
    """PLY file below ``{output}`` with a vertex for each Gaussian, or whatever is drawn."""
    unit: str = "primitives"
    """What these are: ``Gaussians``, ``anchors``."""
    prepare: str | None = None
    """``module:function``, called with ``{data}``, ``{output}`` and the config before the training:
    it writes there what the export lacks for this program, and returns notices for the user, which
    go on after the title of the method: ``ignores principal points``."""
    version: tuple[str, ...] = ()
    """Command whose last line of output is the version of the program."""
    tested: str = "untested"
    """How far this recipe was tried, in words."""


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
class MethodSpec:
    """What the harness knows of a method without importing it."""

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
    resumable: bool = False
    """Whether it has `Method.save_training` and `Method.load_training`."""
    runner: Runner | None = None
    """How it is run, if it is another program."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A pinhole camera to render: intrinsics in pixels, pose in the training frame."""

    K: NDArray[np.float64]
    """[3, 3]"""
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    """[4, 4]; the world here is the training frame."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView(View):
    """A view with an image to learn from."""

    name: str
    period: int


def no_mask(index: int) -> None:
    """`TrainingSet.load_mask` of sets whose images count everywhere."""


def nothing_ahead(indices: Sequence[int]) -> None:
    """`TrainingSet.expect` of sets whose images are at hand."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """Everything that a method may learn from, in the normalised training frame.

    The training frame is the world, recentred and scaled in float64 before anything is cast to
    float32: learning rates and voxel sizes depend on its scale. The inverse of
    `training_from_world` leads back.
    """

    views: tuple[TrainingView, ...]
    num_periods: int
    """1 where the harness hides the period; those so far where they arrive one after the other."""
    points: NDArray[np.float32]
    """Sparse points that a training view of these periods sees. [P, 3]"""
    colors: NDArray[np.uint8]
    """[P, 3]"""
    point_periods: NDArray[np.bool_]
    """Whether a training view of the period sees the point. [P, T]"""
    training_from_world: Sim3
    camera_extent: float
    """1.1 times the largest distance of a training camera from their mean, in training units."""
    background: NDArray[np.float32]
    """Colour behind everything, 0..1. [3]"""
    load_image: Callable[[int], NDArray[np.uint8]]
    """Image of ``views[i]``, decoded lazily and cached. [H, W, 3]"""
    load_mask: Callable[[int], NDArray[np.bool_] | None] = no_mask
    """Where the image of ``views[i]`` counts; None where all of it does. What the others show must
    not change the model. [H, W]"""
    expect: Callable[[Sequence[int]], None] = nothing_ahead
    """Takes the views whose images will be loaded next, in their order: they are decoded while the
    method does something else. A method that never calls it waits for each image."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A rendered view."""

    rgb: NDArray[np.float32]
    """0..1. [H, W, 3]"""
    alpha: NDArray[np.float32] | None = None
    """[H, W]"""
    depth: NDArray[np.float32] | None = None
    """Expected z-depth in units of the training frame; 0 where alpha is 0. [H, W]"""
    drawn: int | None = None
    """Gaussians, or whatever the method draws, that touch the image."""


@dataclass(frozen=True, slots=True)
class StepReport:
    """What one training step tells the harness."""

    loss: float
    primitives: int
    """Gaussians or anchors held now."""
    skipped: Skipped | None = None
    """Why nothing was learned, so that no parameter and no moment of the optimiser changed:
    ``empty``, the view shows no primitive, or its mask ignores all of the image; ``not finite``,
    the loss or a gradient was not."""


@dataclass(frozen=True, slots=True)
class MethodSize:
    """How big a trained model is."""

    primitives: int
    parameters: int
    """Numbers stored in the checkpoint."""
    unit: str = "primitives"
    """What the primitives are: ``Gaussians``, ``anchors``."""


class Method(Protocol):
    """The interface of a method. ``method(config)`` makes one, `setup` or `load` fills it."""

    def __init__(self, config: Any) -> None: ...

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        """Build the initial model. Nothing else draws from the global random state."""

    def step(self, index: int, progress: float) -> StepReport:
        """Do one training step.

        Args:
            index: Number of steps done before, from 0.
            progress: Share of the training that is over, 0..1. Every schedule (learning rates,
                densification) follows it, so that a run that ends by the clock goes through the
                same phases as one that ends after a number of iterations.
        """

    def render(self, view: View, period: float) -> Prediction:
        """Render a view as of a period; fractional only where the spec says ``continuous``."""

    def save(self, folder: Path) -> None:
        """Write ``model.safetensors`` and ``model.json`` into an existing empty folder."""

    def load(self, folder: Path, *, device: str) -> None:
        """Read what `save` wrote; `render` then gives the same pixels."""

    def size(self) -> MethodSize: ...

    def render_split(
        self, view: View, *, geometry_period: float, appearance_period: float
    ) -> Prediction:
        """Render the geometry of one period in the colours of another.

        Only where a method keeps them apart; one that does not has no such function.
        """

    def to_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """The model as of a period as Gaussians with spherical harmonics, for other programs.

        Only where a method draws Gaussians; one that does not has no such function.

        Args:
            period: As for `render`.
            views: Those of the training. What spherical harmonics cannot hold, such as an opacity
                that depends on the direction, is to be right in these.

        Returns:
            In the training frame, in float32.
        """

    def render_gaussians(self, gaussians: GaussianCloud, view: View) -> Prediction:
        """Render what `to_gaussians` gave."""

    def permute(self, order: NDArray[np.int64]) -> None:
        """Put the anchors or Gaussians of a loaded model into another order. [N]

        Only where the model is a set of these, whose positions are the tensor ``anchors`` or
        ``means``; a method without it has no such function.
        """

    def save_training(self, folder: Path) -> None:
        """Write everything that the steps to come depend on into an existing empty folder.

        That is the model as the optimiser has it, moments, statistics for densification, generators
        of random numbers and places in schedules; no step may notice that it was asked for. Only
        where the spec says ``resumable``.

        Raises:
            OSError, DiskFullError: If the disk refuses.
        """

    def load_training(self, folder: Path) -> None:
        """Go on from what `save_training` wrote; `setup` or `extend` was called as before it.

        On a CPU the steps to come then give the same bits as without the interruption.
        """

    def extend(self, train: TrainingSet) -> None:
        """Go on from the model at the end of a training, with the views of the next period.

        Called instead of `setup` under the strategy ``sequential``; seed and device are those of
        `setup`, and steps and progress count from 0 again. Only where a method can; one that cannot
        has no such function.

        Args:
            train: Its views are of the new period alone, its periods are those so far.
        """


def import_object(reference: str) -> Any:
    """Import ``module:Name``."""
    module, _, name = reference.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            reference,
            expected="an importable module:Name",
            found=f"{type(error).__name__}: {error}",
            todo="check the spelling, and that its package is installed",
        ) from error


def method_names(group: str = ENTRY_POINT_GROUP) -> tuple[str, ...]:
    """Names of the installed methods of an entry-point group, sorted; imports none of them."""
    return tuple(sorted({entry.name for entry in entry_points(group=group)}))


def installed_methods() -> dict[str, EntryPoint]:
    """Entry points of all methods by their names, other programs among them."""
    groups = (PROGRAM_GROUP, ENTRY_POINT_GROUP)
    return {entry.name: entry for group in groups for entry in entry_points(group=group)}


def load_spec(name: str) -> MethodSpec:
    """Find a method by its name, or by ``module:SPEC`` while it is being developed.

    Raises:
        ConfigError: If there is no such method; the message lists the known ones.
    """
    if ":" in name:
        spec = import_object(name)
    else:
        installed = installed_methods()
        check_choice("--method", name, installed)
        spec = installed[name].load()
    if not isinstance(spec, MethodSpec):
        raise ConfigError(
            name, expected="a MethodSpec", found=type(spec).__name__, todo="name its SPEC object"
        )
    return spec


def build_config(
    spec: MethodSpec, *, preset: str, overrides: Mapping[str, Any] | None = None
) -> Any:
    """Make the frozen config of a method from a preset and values given by the user.

    Strings are parsed to the type of the field's default, so ``--set`` can pass them as typed.

    Raises:
        ConfigError: If the preset or a key is unknown, or a value does not parse.
    """
    config_class = import_object(spec.config)
    check_choice(f"{spec.name} --preset", preset, spec.presets)
    values = dict(spec.presets[preset])
    fields = {f.name: f for f in dataclasses.fields(config_class)}
    for key, value in (overrides or {}).items():
        check_choice(f"{spec.name} --set", key, fields)
        default = getattr(config_class(), key)
        values[key] = _parse_like(f"{spec.name} --set {key}", value, default)
    return config_class(**values)


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a method, as ``chronoscene methods NAME`` lists it."""

    name: str
    default: Any
    presets: dict[str, Any]
    """Preset name to its value, where it differs from the default."""
    meaning: str
    """The docstring below the field; empty if there is none."""


def options_of(spec: MethodSpec) -> list[Option]:
    """All options of a method, in the order of its config class."""
    config_class = import_object(spec.config)
    meanings: dict[str, str] = {}
    for base in reversed(config_class.__mro__[:-1]):
        meanings |= _field_docstrings(base)
    options = []
    for name, default in dataclasses.asdict(config_class()).items():
        values = {key: preset.get(name, default) for key, preset in spec.presets.items()}
        differ = {key: value for key, value in values.items() if value != default}
        options.append(Option(name, default, differ, meanings.get(name, "")))
    return options


def _field_docstrings(config_class: type) -> dict[str, str]:
    """Python keeps no docstrings of fields, so they are read from the source."""
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


def config_from_values(spec: MethodSpec, values: Mapping[str, Any]) -> Any:
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


def as_typed(value: Any) -> str:
    """A value of an option as ``--set`` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def _parse_like(place: str, value: Any, default: Any) -> Any:
    if not isinstance(value, str) or isinstance(default, str):
        return value
    text = value.lower() if value.lower() in ("true", "false") else value
    if isinstance(default, tuple) and text[:1] + text[-1:] == "()":
        text = f"[{text[1:-1].rstrip(', ')}]"
    try:
        parsed = json.loads(text)
        if isinstance(default, tuple) and isinstance(parsed, list):
            return tuple(parsed)
        if isinstance(default, float) and isinstance(parsed, int) and not isinstance(parsed, bool):
            return float(parsed)
        if default is None or type(parsed) is type(default):
            return parsed
    except json.JSONDecodeError:
        pass
    raise ConfigError(
        place, expected=f"a value like {default!r}", found=repr(value), todo="correct the value"
    )
