"""A job is one run as data, which the bench passes to a worker process as JSON."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from string import Formatter
from textwrap import shorten
from typing import Any

from chronoscene.bench.predictions import safe_name
from chronoscene.bench.provenance import config_hash
from chronoscene.bench.results import Failure
from chronoscene.bench.strategies import STRATEGIES
from chronoscene.checks import check_choice
from chronoscene.errors import BackendError, ConfigError
from chronoscene.formats import writable_formats
from chronoscene.kernels.runtime import gsplat_release
from chronoscene.methods import (
    MethodSpec,
    ProgramConfig,
    Runner,
    as_typed,
    build_config,
    import_object,
)

PHOTO_MEMORY = 2 * 10**9
PHOTO_DISK = 20 * 10**9

_UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}


def parse_duration(text: str, option: str = "--budget") -> float:
    """Seconds of ``90s``, ``5m``, ``1.5h`` or ``1h30m``.

    Raises:
        ConfigError: If the text is none of these or not positive.
    """
    pieces = re.findall(r"(\d+(?:\.\d+)?)([hms])", text)
    seconds = sum(float(number) * _UNITS[unit] for number, unit in pieces)
    if "".join(number + unit for number, unit in pieces) != text or not seconds:
        raise ConfigError(
            option,
            expected="a positive time such as 90s, 5m or 1h30m",
            found=repr(text),
            todo="write numbers with the units h, m or s",
        )
    return seconds


@dataclass(frozen=True, slots=True)
class StopRule:
    """When a training ends: after some iterations, after a time, or whichever comes first."""

    iterations: int | None
    seconds: float | None

    def progress(self, iterations: int, seconds: float) -> float:
        """Share of the training that is over, 0..1."""
        shares = [0.0]
        if self.iterations is not None:
            shares.append(iterations / self.iterations if self.iterations else 1.0)
        if self.seconds is not None:
            shares.append(seconds / self.seconds)
        return min(1.0, max(shares))

    def seconds_left(self, iterations: int, seconds: float) -> float | None:
        """Estimate of the training time that is left; None if there is nothing to go by yet."""
        progress = self.progress(iterations, seconds)
        return seconds * (1.0 - progress) / progress if progress > 0 else None

    def split(self, parts: int) -> tuple[StopRule, ...]:
        """Equal shares for several models; the first ones get what is left over."""
        seconds = None if self.seconds is None else self.seconds / parts
        if self.iterations is None:
            return (replace(self, seconds=seconds),) * parts
        base, extra = divmod(self.iterations, parts)
        return tuple(StopRule(base + (i < extra), seconds) for i in range(parts))


LOCKS = ".locks"  # Folder beside the results, with a file for each run

LONGEST_NAME = 180  # Characters; file systems allow 255 bytes, and special ones become longer

SHARING = ("total", "each")
"""The models of ``separate``, or the stages of ``sequential``, share iterations and time, or each
get all of them."""


@dataclass(frozen=True, slots=True)
class Job:
    """One run. Paths are absolute."""

    scene_root: str
    scene_format: str
    """Name in `chronoscene.formats`."""
    scene: str
    scene_hash: str
    split_hash: str
    method: str
    """What `load_spec` takes: a name or ``module:SPEC``."""
    method_name: str
    strategy: str
    preset: str
    overrides: dict[str, str]
    iterations: int | None
    budget_seconds: float | None
    separate_iterations: str
    seed: int
    max_width: int
    threads: int | None
    device: str
    """``auto``, ``cpu`` or ``cuda``."""
    runs: str
    """Folder of all runs."""
    lpips_weights: str | None
    period_by: str | None = None
    """As for `read_scene`."""
    notices: list[str] = field(default_factory=list)
    staging: str = ""
    """Where the worker writes; renamed to `folder` when it has ended."""
    photo_memory: int = PHOTO_MEMORY
    """Bytes that training photos may take in memory, those that are being decoded included."""
    photo_disk: int = PHOTO_DISK
    """Bytes that decoded photos may take on disk."""
    checkpoint_seconds: float = 300.0
    """Time from one checkpoint of the training to the next."""
    keep_training: bool = False
    """Whether the finished run keeps what it takes to be trained further."""
    continued_from: list[int] = field(default_factory=list)
    """Iterations of the shorter trainings that this one began with."""
    continues: str = ""
    """Folder of the last of them."""
    variant: str = ""
    """What differs from the preset, as `with_variant` writes it."""
    plugin_path: str | None = None
    """Folder from which ``module:SPEC`` may be imported."""
    memory: int = 0
    """Bytes of memory that the run is expected to take."""
    commit: str = ""
    """Of the code that runs it, which the worker asks for."""
    reports: bool = False
    """Whether progress is sent to the bench, which runs several jobs at a time, and not shown."""
    moved: dict[str, str] = field(default_factory=dict)
    """What the job names, to where the machine that runs it has a copy."""

    def here(self, place: str) -> str:
        """Where this machine has something that the job names."""
        return self.moved.get(place, place)

    @property
    def folder(self) -> Path:
        """Where the finished run goes."""
        name = "-".join(filter(None, (*self._names, self.variant)))
        if len(name) > LONGEST_NAME:
            name = f"{name[:LONGEST_NAME]}-{config_hash({'variant': self.variant})[:8]}"
        folder = safe_name(name).replace("/", "%2F")
        return Path(self.runs) / safe_name(self.scene) / folder / f"seed{self.seed}"

    @property
    def _names(self) -> tuple[str, ...]:
        return self.method_name, self.strategy, self.preset

    @property
    def training(self) -> Path:
        """Where the checkpoints of the training are while the run is not finished."""
        return self.folder.with_name(f".{self.folder.name}.training")

    @property
    def label(self) -> str:
        """The run in words."""
        names = " ".join(filter(None, (*self._names, self.variant)))
        return f"{self.scene}: {names} seed {self.seed}"

    def with_variant(self, spec: MethodSpec) -> Job:
        """The job with its name: options that differ from the preset, and what else ends it.

        ``iterations=20+50`` is a training of 20 iterations that went on to 50.
        """
        preset = deciding_options(build_config(spec, preset=self.preset))
        config = deciding_options(self.method_config(spec))
        differ = {name: value for name, value in config.items() if value != preset[name]}
        if self.continued_from:
            lengths = [*self.continued_from, config["iterations"]]
            differ["iterations"] = "+".join(map(str, lengths))
        if self.budget_seconds is not None:
            if self.iterations is not None:
                differ["iterations"] = self.iterations
            differ["budget"] = f"{self.budget_seconds:g}s"
        if self.separate_iterations != SHARING[0]:
            differ["separate_iterations"] = self.separate_iterations
        return replace(self, variant=",".join(f"{k}={as_typed(v)}" for k, v in differ.items()))

    def failure(self, reason: str) -> Failure:
        """The record of a run that has no result; the reason becomes one line."""
        return Failure(
            method=self.method_name,
            strategy=self.strategy,
            preset=self.preset,
            variant=self.variant,
            scene=self.scene,
            seed=self.seed,
            reason=shorten(reason, 500, placeholder=" ..."),
        )

    def stop_rule(self, spec: MethodSpec) -> StopRule:
        """Number of iterations of the config, unless there is a time budget and no number."""
        if self.budget_seconds is not None and self.iterations is None:
            return StopRule(None, self.budget_seconds)
        return StopRule(int(self.method_config(spec).iterations), self.budget_seconds)

    def stop_rules(self, spec: MethodSpec, parts: int) -> tuple[StopRule, ...]:
        """Stop rule of each model or stage of the strategy."""
        rule = self.stop_rule(spec)
        return (rule,) * parts if self.separate_iterations == "each" else rule.split(parts)

    def method_config(self, spec: MethodSpec) -> Any:
        """The frozen config of the method."""
        overrides: dict[str, Any] = dict(self.overrides)
        if self.iterations is not None:
            overrides["iterations"] = self.iterations
        return build_config(spec, preset=self.preset, overrides=overrides)

    def document(self, spec: MethodSpec) -> dict[str, Any]:
        """Everything that decides the result, merged; written beside it as ``config.json``."""
        config = {
            "method": self.method_name,
            "preset": self.preset,
            "method_config": deciding_options(self.method_config(spec)),
            "strategy": self.strategy,
            "stop": dataclasses.asdict(self.stop_rule(spec)),
            "separate_iterations": self.separate_iterations,
            "max_width": self.max_width,
            **({"continued_from": self.continued_from} if self.continued_from else {}),
        }
        config = json.loads(json.dumps(config))
        return {
            "config": config,
            "config_hash": config_hash(config),
            "scene": self.scene,
            "scene_hash": self.scene_hash,
            "seed": self.seed,
            "device": self.device,
        }


OPTIONS = ("iterations", "budget", "separate_iterations", "max_width")
"""What a variant names that is an option of ``bench`` and none of the method."""


def command_line(scene: str, config: Mapping[str, Any], seed: int | None = None) -> str:
    """The command that trains a configuration; for a compressed one, also that which compresses it.

    Args:
        scene: Argument that stands for its folder.
        config: ``method``, ``strategy``, ``preset`` and ``variant`` (`Job.with_variant`, and what
            `compress_run` adds to it).
        seed: None leaves the option out.
    """
    words = ["chronoscene", "bench", scene]
    for name in ("method", "strategy", "preset"):
        words += [f"--{name}", config[name]]
    words += [] if seed is None else ["--seed", str(seed)]
    compress: list[str] = []
    # A comma inside of a value is followed by no name.
    for assignment in filter(None, re.split(r",(?=\w+=)", config["variant"])):
        name, _, value = assignment.partition("=")
        if name == "iterations" and "+" in value:
            words += ["--continue-to", value.rpartition("+")[2]]
        elif name == "compressed":
            loss = ["--plain"] if value == "plain" else ["--max-loss", value.removesuffix("dB")]
            compress = ["chronoscene", "compress", "RUN", *loss]
        elif name in OPTIONS:
            words += [f"--{name.replace('_', '-')}", value]
        else:
            words += ["--set", assignment]
    return " && ".join(map(shlex.join, filter(None, (words, compress))))


def deciding_options(config: Any) -> dict[str, Any]:
    """The options of a method that its result depends on: all, but the places of a program."""
    options = dataclasses.asdict(config)
    places = ("prefix", "source") if isinstance(config, ProgramConfig) else ()
    return {name: value for name, value in options.items() if name not in places}


def check_device(device: str) -> None:
    """Check on the machine that will train that it has the device.

    Raises:
        BackendError: If a GPU is asked for that is not there, or its kernels are not.
    """
    if device != "cuda":
        return
    import torch

    if not torch.cuda.is_available():
        raise BackendError(
            "--device cuda",
            expected="a CUDA device and a torch build for it",
            found=f"torch {torch.__version__} without one",
            todo="use --device cpu",
        )
    gsplat_release()


VALUES = ("data", "output", "work", "iterations", "seconds", "seed")
"""What a `Runner` may name besides the options of its config."""


def used_values(runner: Runner, prefix: str) -> set[str]:
    """Values that the commands of another program name."""
    words = (prefix, *runner.version, *runner.train, *chain(*runner.render))
    return {name for word in words for _, name, _, _ in Formatter().parse(word) if name}


def check_runner(job: Job, spec: MethodSpec, runner: Runner) -> None:
    """Check what another program needs before it is run.

    Raises:
        ConfigError: If a command names a value that does not exist or is not set, or the program
            cannot be stopped by the clock.
    """
    config = job.method_config(spec)
    if not isinstance(config, ProgramConfig):
        raise ConfigError(
            f"{spec.name}: {spec.config}",
            expected="a ProgramConfig, or a class made from it",
            found=type(config).__name__,
            todo="correct the specification of the method",
        )
    options = dataclasses.asdict(config)
    try:
        shlex.split(config.prefix)
        used = used_values(runner, config.prefix)
    except ValueError as error:
        raise ConfigError(
            f"{spec.name} --set prefix",
            expected="words as for a shell, with {work} and the like for values, {{ for a brace",
            found=str(error),
            todo="correct the prefix",
        ) from error
    for name in sorted(used):
        check_choice(f"{spec.name}: commands", name, {*VALUES, *options})
        if options.get(name) == "":
            raise ConfigError(
                f"{spec.name} --set {name}",
                expected="a value, which its commands need",
                found="none",
                todo=f"pass --set {name}=..., as docs/other-programs.md says",
            )
    if job.budget_seconds is not None and "seconds" not in used:
        raise ConfigError(
            f"{spec.name} --budget",
            expected="a program that ends by the clock",
            found="one that ends after a number of iterations",
            todo="use --iterations",
        )
    check_choice(f"{spec.name}: exports", runner.exports, writable_formats())


def check_stages(job: Job, spec: MethodSpec) -> None:
    """Check that a method can be trained in stages.

    Raises:
        ConfigError: If it cannot, or is to be trained further after the last one.
    """
    if spec.runner is not None or not hasattr(import_object(spec.method), "extend"):
        raise ConfigError(
            f"{spec.name} --strategy {job.strategy}",
            expected="a method that can be trained on one period after the other",
            found="one without extend",
            todo="use another strategy, or write the function: docs/adding-a-method.md",
        )
    if job.keep_training:
        raise ConfigError(
            f"--keep-training, --continue-to with --strategy {job.strategy}",
            expected="neither, as a stage ends for good when the next one begins",
            found="one of them",
            todo="train anew with --iterations",
        )
    if teachers := getattr(job.method_config(spec), "teachers", 0):
        raise ConfigError(
            f"{spec.name} --strategy {job.strategy}: teachers",
            expected="0, as they would have to learn each further period as well",
            found=str(teachers),
            todo="set teachers=0, or use another strategy",
        )


def check_job(job: Job, spec: MethodSpec) -> None:
    """Check the settings before anything is trained.

    Raises:
        ConfigError: If a preset, key, value or device does not exist.
    """
    if (job.keep_training or job.continued_from) and not spec.resumable:
        raise ConfigError(
            "--keep-training, --continue-to",
            expected="methods that can be trained further",
            found=spec.name,
            todo="run this method without",
        )
    check_choice("--separate-iterations", job.separate_iterations, SHARING)
    if STRATEGIES[job.strategy].in_order:
        check_stages(job, spec)
    if spec.runner is not None:
        check_runner(job, spec, spec.runner)
    if job.device != "auto":
        check_choice(f"{spec.name} --device", job.device, spec.devices)
    config = job.method_config(spec)
    if not isinstance(getattr(config, "iterations", None), int) or config.iterations < 1:
        raise ConfigError(
            f"{spec.name}: iterations",
            expected="a positive number",
            found=repr(getattr(config, "iterations", None)),
            todo="correct --iterations",
        )
