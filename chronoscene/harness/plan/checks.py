"""Checks of a planned run before anything is trained."""

from __future__ import annotations

import dataclasses
import shlex
from itertools import chain
from string import Formatter

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.formats import writable_formats
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.resolve import ResolvedRun
from chronoscene.methods import MethodSpec, ProgramConfig, Runner, has_function

VALUES = ("data", "output", "work", "iterations", "seconds", "seed")
"""Values that a `Runner` may name besides the options of its config."""


def used_values(runner: Runner, prefix: str) -> set[str]:
    """Values that the commands of another program name."""
    words = (prefix, *runner.version, *runner.train, *chain(*runner.render))
    return {name for word in words for _, name, _, _ in Formatter().parse(word) if name}


def check_runner(run: ResolvedRun, runner: Runner) -> None:
    """Check what another program needs before it is run.

    Raises:
        ConfigError: If a command names a value that does not exist or is not set, or the program
            cannot be stopped by the clock.
    """
    spec, config = run.spec, run.config
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
                todo=f"pass --set {name}=..., as docs/guides/other-programs.md says",
            )
    if run.stop.seconds is not None and "seconds" not in used:
        raise ConfigError(
            f"{spec.name} --budget",
            expected="a program that ends by the clock",
            found="one that ends after a number of iterations",
            todo="use --iterations",
        )
    check_choice(f"{spec.name}: exports", runner.exports, writable_formats())


def _check_function(spec: MethodSpec, name: str, option: str, expected: str, todo: str) -> None:
    """Check that a method has the function that an option needs."""
    if not has_function(spec, name):
        place, found = f"{spec.name} {option}", f"one without {name}"
        raise ConfigError(place, expected=expected, found=found, todo=todo)


def check_run(run: ResolvedRun) -> None:
    """Check a run before anything is trained.

    Raises:
        ConfigError: If the method cannot do what is asked for, or an option has no such value.
    """
    job, spec, settings = run.job, run.spec, run.job.settings
    if settings.keep_training and not spec.resumable:
        raise ConfigError(
            "--keep-training, --continue-to",
            expected="methods that can be trained further",
            found=spec.name,
            todo="run this method without",
        )
    if STRATEGIES[job.strategy].in_order:
        option = f"--strategy {job.strategy}"
        expected = "a method that can be trained on one period after the other"
        todo = "use another strategy, or write the function: docs/guides/adding-a-method.md"
        _check_function(spec, "extend", option, expected, todo)
        if settings.keep_training:
            raise ConfigError(
                f"--keep-training, --continue-to with {option}",
                expected="neither, as a stage ends for good when the next one begins",
                found="one of them",
                todo="train anew with --iterations",
            )
    if settings.fit_half:
        expected = "a method whose appearance belongs to single photos"
        todo = "run it without --fit-half, which scores whole photos"
        _check_function(spec, "fitted_to", "--fit-half", expected, todo)
    if spec.runner is not None:
        check_runner(run, spec.runner)
