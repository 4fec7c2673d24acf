"""Rules for the description of a method: its spec, presets and config."""

from __future__ import annotations

import dataclasses
import json

from chronoscene.harness.contract.subject import NotApplicableError, Subject, demand, python
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.train.checks import refuse
from chronoscene.methods import build_config
from chronoscene.methods.search_space import ends, starting_point

HEAVY = {"torch", "numba", "cv2", "matplotlib", "pycolmap"}
"""Modules that listing the methods must not import."""


def spec_is_plain_data(subject: Subject) -> None:
    """The spec is plain data with known values."""
    spec = subject.spec
    text = json.dumps(dataclasses.asdict(spec))
    name = spec.name if ":" in subject.name else subject.name
    demand(json.loads(text)["name"] == spec.name == name, "MethodSpec.name", name, spec.name)
    for field in ("title", "paper", "licence"):
        demand(getattr(spec, field), f"MethodSpec.{field}", "a text", "none")
    inputs = ("none", "label", "continuous")
    demand(
        spec.period_input in inputs, "MethodSpec.period_input", " or ".join(inputs),
        spec.period_input,
    )  # fmt: skip
    demand(
        spec.strategy in STRATEGIES, "MethodSpec.strategy", " or ".join(STRATEGIES), spec.strategy
    )
    outputs = {"rgb", "alpha", "depth"}
    demand(
        {"rgb"} <= set(spec.outputs) <= outputs, "MethodSpec.outputs",
        "rgb, and alpha and depth where it has them", spec.outputs,
    )  # fmt: skip
    demand(
        spec.devices and set(spec.devices) <= {"cpu", "cuda"}, "MethodSpec.devices",
        "cpu, cuda, or both", spec.devices,
    )  # fmt: skip


def spec_imports_nothing_heavy(subject: Subject) -> None:
    """Loading the spec imports nothing heavy: torch belongs into the module of the class."""
    code = (
        "import sys; from chronoscene.methods import load_spec\n"
        f"load_spec({subject.name!r})\n"
        f"print(*sorted({HEAVY!r} & set(sys.modules)))"
    )
    done = python("-c", code)
    demand(done.returncode == 0, subject.name, "a spec that can be imported", done.stderr.strip())
    demand(not done.stdout.strip(), subject.name, "a light import", done.stdout.strip())


def presets_build_a_frozen_config(subject: Subject) -> None:
    """Presets balanced and fast exist, and each builds a frozen config with iterations."""
    spec = subject.spec
    for field in ("titles", "per_period"):
        named = set(getattr(spec, field))
        demand(named <= spec.presets.keys(), f"MethodSpec.{field}", "names of presets", named)
    for preset in ("balanced", "fast"):
        demand(preset in spec.presets, "MethodSpec.presets", f"a preset {preset}", [*spec.presets])
    for preset in spec.presets:
        config = build_config(spec, preset=preset)
        place = f"{type(config).__name__}, preset {preset}"
        number = getattr(config, "iterations", None)
        demand(
            isinstance(number, int) and number > 0, f"{place}: iterations", "a positive integer",
            number,
        )  # fmt: skip
        demand(json.loads(json.dumps(dataclasses.asdict(config))), place, "what JSON can hold")
        try:
            config.iterations = 1  # type: ignore[misc]
        except dataclasses.FrozenInstanceError:
            continue
        raise refuse(place, "a frozen dataclass", "one that can be changed")


def search_space_holds_the_presets(subject: Subject) -> None:
    """Each option of the search space exists, with the value of the presets; its ends are valid."""
    spec = subject.spec
    if not spec.search:
        raise NotApplicableError("it has no search space")
    for preset in spec.presets:
        config = build_config(spec, preset=preset)
        for name in spec.search:
            demand(hasattr(config, name), "MethodSpec.search", "options of the config", name)
        starting_point(spec, config)
    for preset in ("balanced", "fast"):
        for options in ends(spec, build_config(spec, preset=preset)):
            build_config(spec, preset=preset, overrides=options)


CHECKS = (
    spec_is_plain_data,
    spec_imports_nothing_heavy,
    presets_build_a_frozen_config,
    search_space_holds_the_presets,
)
