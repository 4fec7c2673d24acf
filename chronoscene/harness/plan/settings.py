"""Settings of a bench, and those of them that each run carries along."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from itertools import chain
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.formats import DetectedFormat, find_scenes
from chronoscene.formats.shared.grouping import absolute_rule
from chronoscene.harness.files.protocols import PROTOCOLS, check_protocol
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.images.store import MAX_WIDTH
from chronoscene.io.staging import check_outside
from chronoscene.methods import is_preset_file, preset_name
from chronoscene.metrics.lpips_weights import check_available

PHOTO_MEMORY = 2 * 10**9
PHOTO_DISK = 20 * 10**9

SHARING = ("total", "each")
"""The models of ``separate``, or the stages of ``sequential``, share iterations and time
(``total``), or each of them gets all (``each``). ``each`` is the default of the presets in
`MethodSpec.per_period`; with these it holds for ``joint``, too, whose model of T periods gets all
T times."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """Settings that all runs of a bench share; every job has a copy. Paths are absolute."""

    runs: Path
    """Folder of all runs."""
    preset: str = "balanced"
    """Name of a preset of the methods, or path of a preset file."""
    overrides: Mapping[str, str] = field(default_factory=dict)
    """Options of the methods: ``key`` for all that are run, or ``method.key`` for one. In the
    settings of a job, keys have no prefix."""
    iterations: int | None = None
    budget_seconds: float | None = None
    separate_iterations: str | None = None
    """One of `SHARING`; None for that of the preset, which planning fills in."""
    max_width: int = MAX_WIDTH
    """Pixels; wider images are scaled down to it."""
    threads: int | None = None
    device: str = "auto"
    """``auto``, ``cpu`` or ``cuda``."""
    validation: bool = False
    """True if views held back from the training views are scored, and test views are not read."""
    validation_seed: int = 0
    """Seed of the choice of these views."""
    fit_half: bool = False
    """True if appearance is fitted to the left half of test photos, and the right half scored."""
    photo_memory: int = PHOTO_MEMORY
    """Bytes that training photos may take in memory, those that are being decoded included."""
    photo_disk: int = PHOTO_DISK
    """Bytes that decoded photos may take on disk."""
    protocol: str = ""
    """Name in `PROTOCOLS`, or empty."""
    checkpoint_seconds: float = 300.0
    """Time from one checkpoint of a training to the next."""
    keep_training: bool = False
    """True if finished runs keep what it takes to train them further."""
    lpips_weights: Path | None = None

    @property
    def shrink(self) -> int:
        """Divisor of the width and height of all images."""
        return PROTOCOLS[self.protocol].shrink if self.protocol else 1

    @property
    def preset_name(self) -> str:
        """Name of the preset in results."""
        return preset_name(self.preset)


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """A bench as the user asked for it."""

    scenes: tuple[DetectedFormat, ...]
    methods: tuple[str, ...]
    """Names, or ``module:SPEC``."""
    run: RunSettings
    strategies: tuple[str, ...] = ()
    """Empty for `MethodSpec.strategy` of each method."""
    seeds: tuple[int, ...] = (0,)
    continue_to: int | None = None
    """Train finished runs further, up to this many iterations."""
    overwrite: bool = False
    """True if finished runs and unfinished trainings with other settings may be replaced."""
    jobs: int | None = None
    """Runs at a time; None for one, or as many as the cluster has room for."""
    job_memory: int | None = None
    """Bytes of memory that a run takes; None for an estimate."""
    ray: str | None = None
    """Address of the Ray cluster to run on; None for this machine."""

    def __post_init__(self) -> None:
        """Refuse settings that contradict each other.

        Raises:
            ConfigError: If a strategy or a way of sharing is unknown, a number is out of range,
                several options give a number of iterations, of which one would win silently, or one
                contradicts the protocol.
        """
        self._check_numbers()
        for strategy in self.strategies:
            check_choice("--strategy", strategy, STRATEGIES)
        if self.run.separate_iterations is not None:
            check_choice("--separate-iterations", self.run.separate_iterations, SHARING)
        if self.run.validation_seed and not self.run.validation:
            raise ConfigError(
                "--validation-seed",
                expected="--validation with it",
                found="it alone",
                todo="add --validation, or leave it out",
            )
        if self.run.protocol:
            run = self.run
            fixed = self.scenes, self.strategies, run.max_width, run.validation
            check_protocol(run.protocol, *fixed)
        own = any(key.rpartition(".")[2] == "iterations" for key in self.run.overrides)
        given = {
            "--continue-to": self.continue_to,
            "--iterations": self.run.iterations,
            "--set iterations": own,
            # Only --iterations ends a training beside it.
            "--budget": (self.continue_to or own) and self.run.budget_seconds,
        }
        options = [name for name, value in given.items() if value]
        if len(options) > 1:
            raise ConfigError(
                options[0],
                expected=f"no {' and no '.join(options[1:])} beside it",
                found=" and ".join(options[1:]),
                todo="leave all of them but one out",
            )

    def _check_numbers(self) -> None:
        """Refuse numbers without a meaning, most of which no option of a command lets through."""
        counts = {
            "--max-width": self.run.max_width,
            "--threads": self.run.threads,
            "--jobs": self.jobs,
        }
        for option, number in counts.items():
            if number is not None and not (type(number) is int and number >= 1):
                raise _refused(option, "a whole number of 1 or more", number)
        seeds = [("--seed", seed) for seed in self.seeds]
        for option, seed in (*seeds, ("--validation-seed", self.run.validation_seed)):
            if not (type(seed) is int and 0 <= seed < 2**64):
                raise _refused(option, "seeds from 0 to 2^64 - 1", seed)
        budget = self.run.budget_seconds
        if budget is not None and not (isinstance(budget, Real) and 0 < budget < math.inf):
            raise _refused("--budget", "a positive number of seconds", budget)


def _refused(option: str, expected: str, found: float) -> ConfigError:
    return ConfigError(option, expected=expected, found=str(found), todo="choose another number")


def bench_settings(
    scenes: Iterable[Path],
    methods: tuple[str, ...],
    runs: Path,
    *,
    preset: str = "balanced",
    dataset_format: str | None = None,
    period_by: str | None = None,
    lpips_weights: Path | None = None,
    **options: Any,
) -> BenchSettings:
    """Make the settings of a bench, with scenes and paths that hold in every folder and process.

    Args:
        scenes: Folders of scenes, or of folders that have scenes in them.
        methods: As for `BenchSettings`.
        runs: As ``preset`` and ``lpips_weights`` for `RunSettings`, in any form.
        dataset_format: Format of the scenes; None to detect it.
        period_by: Rule by which images are grouped into periods, as for `read_scene`.
        options: Other fields of both classes, by their names; numbers may be of NumPy.

    Raises:
        SceneError: If a folder has no scene.
        ConfigError: If the format is unknown, the folder of runs is in a scene, or as
            `BenchSettings`.
        MetricUnavailableError: If there are no weights of LPIPS at the place given.
    """
    if lpips_weights is not None:
        check_available(lpips_weights)
    options = {name: _plain(value) for name, value in options.items()}
    rule = absolute_rule(period_by)
    found = [find_scenes(folder, format=dataset_format, period_by=rule) for folder in scenes]
    listed = tuple(chain.from_iterable(found))
    check_outside(runs, [scene.path for scene in listed], option="--out")
    ours = {one.name for one in fields(BenchSettings)} & options.keys()
    run = RunSettings(
        runs.resolve(),
        preset=str(Path(preset).resolve()) if is_preset_file(preset) else preset,
        lpips_weights=lpips_weights.resolve() if lpips_weights else None,
        **{k: value for k, value in options.items() if k not in ours},
    )
    shared = {name: options[name] for name in ours}
    return BenchSettings(listed, methods, run, **shared)


def _plain(value: Any) -> Any:
    """Return numbers of NumPy as those of Python: jobs and configs are stored as JSON."""
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    return value.item() if isinstance(value, np.generic) else value
