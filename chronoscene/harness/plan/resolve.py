"""A run with all that follows from its settings: made once when planned, once in its worker."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.harness.files.provenance import config_hash
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.parts import Part
from chronoscene.harness.plan.settings import SHARING, RunSettings
from chronoscene.harness.plan.stop import StopRule, duration_text
from chronoscene.methods import (
    MethodConfig,
    MethodSpec,
    ProgramConfig,
    as_typed,
    build_config,
    load_spec,
)
from chronoscene.methods.interface import HALVED_PIXELS
from chronoscene.methods.preset_files import find_preset

_NEUTRAL = {
    "depth_weight": 0.0,
    "half_size_share": 0.0,
    "opacity_dropout": 0.0,
    "period_decay": 0.0,
    "views_per_step": 1,
}


@dataclass(frozen=True, slots=True)
class ResolvedMethod:
    """A method as all runs of a bench train it."""

    reference: str
    """Argument of `load_spec`."""
    spec: MethodSpec
    settings: RunSettings
    """Their overrides are those of this method."""
    config: MethodConfig
    preset: dict[str, Any]
    """Options of the preset that decide the result."""

    def sharing(self, strategy: str) -> str:
        """Return how the models or stages of a strategy share iterations, one of `SHARING`."""
        asked = self.settings.separate_iterations if self.has_sharing(strategy) else None
        return asked or self._own_sharing

    def has_sharing(self, strategy: str) -> bool:
        """Return True if a strategy has models or stages, or iterations of each period."""
        kind = STRATEGIES[strategy]
        return kind.model_per_period or kind.in_order or self._own_sharing == "each"

    @property
    def _own_sharing(self) -> str:
        """Return that of the preset, or of the one that a preset file starts from."""
        return SHARING[find_preset(self.settings.preset, self.spec).base in self.spec.per_period]

    def run(self, job: Job) -> ResolvedRun:
        """Resolve a run of this method; its job gets its variant.

        The variant lists the options that differ from the preset, and what else ends the run;
        ``iterations=20+50`` is a training of 20 iterations that went on to 50.
        """
        job = job.with_settings(separate_iterations=self.sharing(job.strategy))
        config, settings = self.config, job.settings
        if settings.iterations not in (None, config.iterations):
            config = replace(config, iterations=settings.iterations)
        options = deciding_options(config)
        differ = {k: value for k, value in options.items() if value != self.preset[k]}
        if job.continued_from:
            lengths = [*job.continued_from, config.iterations]
            differ["iterations"] = "+".join(map(str, lengths))
        if settings.budget_seconds is not None:
            if settings.iterations is not None:
                differ["iterations"] = settings.iterations
            differ["budget"] = duration_text(settings.budget_seconds)
        budget_each = settings.separate_iterations == "each" and settings.budget_seconds is not None
        if budget_each or settings.separate_iterations != self._own_sharing:
            differ["separate_iterations"] = settings.separate_iterations
        differ |= _unusual(settings)
        variant = ",".join(f"{k}={as_typed(v)}" for k, v in differ.items())
        return ResolvedRun.of(replace(job, variant=variant), self.spec, config)


@dataclass(frozen=True, slots=True)
class ResolvedRun:
    """A job with its method, the configuration of it, and its end."""

    job: Job
    spec: MethodSpec
    config: MethodConfig
    """Frozen configuration of the method."""
    stop: StopRule
    """Number of iterations of the configuration, unless there is a time budget and no number."""
    document: dict[str, Any]
    """Everything that decides the result; written beside it as ``config.json``."""

    @classmethod
    def of(cls, job: Job, spec: MethodSpec, config: MethodConfig) -> ResolvedRun:
        """Derive the end of the run and its document."""
        settings = job.settings
        stop = StopRule(int(config.iterations), settings.budget_seconds)
        if settings.budget_seconds is not None and settings.iterations is None:
            stop = StopRule(None, settings.budget_seconds)
        decides = {
            "method": job.method_name,
            "preset": settings.preset_name,
            "method_config": _with_effect(deciding_options(config), job.photo_pixels),
            "strategy": job.strategy,
            "stop": dataclasses.asdict(stop),
            "separate_iterations": settings.separate_iterations,
            "max_width": settings.max_width,
            **({"continued_from": job.continued_from} if job.continued_from else {}),
            **_unusual(settings),
        }
        decides = json.loads(json.dumps(decides))
        document = {
            "config": decides,
            "config_hash": config_hash(decides),
            "scene": job.scene,
            "scene_hash": job.scene_hash,
            "seed": job.seed,
            "device": settings.device,
        }
        return cls(job, spec, config, stop, document)

    def stops(self, parts: Sequence[Part]) -> tuple[StopRule, ...]:
        """Return the end of the training of each model, or of each stage.

        Raises:
            ConfigError: If there are fewer iterations than models, so that one would stay as it is.
        """
        if self.job.settings.separate_iterations != "each":
            if self.stop.iterations is not None and self.stop.iterations < len(parts):
                raise ConfigError(
                    f"{self.spec.name} --iterations",
                    expected=f"at least one for each of {len(parts)} models or stages",
                    found=f"{self.stop.iterations} in all",
                    todo="use more iterations, or --separate-iterations each",
                )
            return self.stop.split(len(parts))
        periods = [{view.period for view in part.train.views} for part in parts]
        return tuple(self.stop.times(len(own)) for own in periods)


def resolve_methods(references: Sequence[str], settings: RunSettings) -> list[ResolvedMethod]:
    """Build the configurations of several methods for all runs of a bench.

    Raises:
        ConfigError: If a method does not exist, two have one name, or as `check_overrides` and
            `resolve_method`.
    """
    specs = [load_spec(reference) for reference in references]
    named: dict[str, str] = {}
    for reference, spec in zip(references, specs, strict=True):
        if (other := named.setdefault(spec.name, reference)) != reference:
            raise _same_name(reference, spec.name, f"that of {other}, too")
    check_overrides(settings.overrides, [spec.name for spec in specs])
    return [resolve_method(*pair, settings) for pair in zip(references, specs, strict=True)]


def _same_name(reference: str, name: str, found: str) -> ConfigError:
    return ConfigError(
        f"--method {reference}",
        expected="a method with a name of its own",
        found=f"{name!r}, {found}",
        todo="change the name in its MethodSpec, or run it with another --out",
    )


def check_overrides(overrides: Mapping[str, str], names: Sequence[str]) -> None:
    """Check that overrides name no method but those that are run.

    Raises:
        ConfigError: If one does.
    """
    for key in overrides:
        method, dot, _ = key.rpartition(".")
        if dot and method not in names:
            raise ConfigError(
                f"--set {key}",
                expected=f"a key, or one after {', '.join(f'{n}.' for n in names)}",
                found=repr(method),
                todo="use the name of a method that is run",
            )


def overrides_of(overrides: Mapping[str, str], method: str) -> dict[str, str]:
    """Return the options of one method; those with its name win over those of all."""
    prefix = f"{method}."
    common = {key: value for key, value in overrides.items() if "." not in key}
    own = {k.removeprefix(prefix): v for k, v in overrides.items() if k.startswith(prefix)}
    return common | own


def resolve_method(reference: str, spec: MethodSpec, settings: RunSettings) -> ResolvedMethod:
    """Build the configuration of a method for all runs of a bench.

    Raises:
        ConfigError: If a preset, key or value does not exist, or the method cannot use the device.
    """
    settings = replace(settings, overrides=overrides_of(settings.overrides, spec.name))
    preset = deciding_options(build_config(spec, preset=settings.preset))
    config = _config(spec, settings)
    if settings.device != "auto":
        check_choice(f"{spec.name} --device", settings.device, spec.devices)
    return ResolvedMethod(reference, spec, settings, config, preset)


def resolve(job: Job) -> ResolvedRun:
    """Resolve a planned job in the process that runs it."""
    spec = load_spec(job.origin.method)
    return ResolvedRun.of(job, spec, _config(spec, job.settings))


def _config(spec: MethodSpec, settings: RunSettings) -> MethodConfig:
    overrides: dict[str, Any] = dict(settings.overrides)
    if settings.iterations is not None:
        overrides["iterations"] = settings.iterations
    config = build_config(spec, preset=settings.preset, overrides=overrides)
    iterations = getattr(config, "iterations", None)
    if not isinstance(iterations, int) or iterations < 1:
        raise ConfigError(
            f"{spec.name}: iterations",
            expected="a positive number",
            found=repr(iterations),
            todo="correct --iterations",
        )
    return config


def _unusual(settings: RunSettings) -> dict[str, Any]:
    """Return settings that most runs leave empty, as far as these do not."""
    names = ("validation", "validation_seed", "fit_half", "protocol")
    return {name: value for name in names if (value := getattr(settings, name))}


def _with_effect(options: Mapping[str, Any], photo_pixels: int) -> dict[str, Any]:
    """Leave out options that came later, where they change nothing.

    Runs of versions that did not have them are the same runs.
    """
    idle = {"half_size_share"} if photo_pixels < HALVED_PIXELS else set()
    return {k: v for k, v in options.items() if k not in idle and _NEUTRAL.get(k) != v}


def deciding_options(config: MethodConfig) -> dict[str, Any]:
    """Return the options of a method that its result depends on: all, but places of a program."""
    options = dataclasses.asdict(config)
    places = ("prefix", "source") if isinstance(config, ProgramConfig) else ()
    return {name: value for name, value in options.items() if name not in places}
