"""A job is one run as data, which the bench passes to a worker process as JSON."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import shorten
from typing import Any

from chronoscene.bench.files.predictions import safe_name
from chronoscene.bench.files.provenance import config_hash
from chronoscene.bench.files.records import SOURCE_FILE, Failure
from chronoscene.bench.files.source import RunSource
from chronoscene.bench.plan.stop import StopRule
from chronoscene.io.staging import write_text_atomic
from chronoscene.methods import MethodSpec, ProgramConfig, as_typed, build_config
from chronoscene.scene.similarity import Sim3

PHOTO_MEMORY = 2 * 10**9
PHOTO_DISK = 20 * 10**9


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


def deciding_options(config: Any) -> dict[str, Any]:
    """The options of a method that its result depends on: all, but the places of a program."""
    options = dataclasses.asdict(config)
    places = ("prefix", "source") if isinstance(config, ProgramConfig) else ()
    return {name: value for name, value in options.items() if name not in places}


def write_source(job: Job, training_from_world: Sim3) -> None:
    """Write ``source.json`` of a run into its staging folder."""
    source = RunSource(
        method=job.method,
        plugin_path=job.plugin_path,
        scene_root=job.scene_root,
        scene_format=job.scene_format,
        period_by=job.period_by,
        training_from_world=training_from_world.to_matrix().tolist(),
    )
    write_text_atomic(Path(job.staging) / SOURCE_FILE, source.model_dump_json(indent=1) + "\n")
