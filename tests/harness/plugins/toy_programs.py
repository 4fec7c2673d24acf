"""Methods that are other programs, found as ``toy_programs:NAME``."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from chronoscene.methods import MethodSpec, ProgramConfig, Runner

SCRIPT = str(Path(__file__).with_name("stand_in.py"))


@dataclass(frozen=True)
class Config(ProgramConfig):
    iterations: int = 9
    python: str = sys.executable
    hold: str = "-"


PROGRAM = MethodSpec(
    name="program",
    title="Program",
    paper="none",
    licence="Apache-2.0",
    period_input="label",
    outputs=("rgb",),
    devices=("cuda",),
    method="",
    config="toy_programs:Config",
    presets={"balanced": {}},
    runner=Runner(
        exports="chronoscene",
        train=(
            *("{python}", "-I", SCRIPT, "train", "--data", "{data}", "--seed", "{seed}"),
            *("--iterations", "{iterations}", "--hold={hold}", "--seconds", "{seconds}"),
        ),
        render=(("{python}", "-I", SCRIPT, "render", "--data", "{data}"),),
        images="images/{name}.png",
        model="model/*",
        primitives="model/points.ply",
        unit="points",
        version=("{python}", "--version"),
    ),
)
assert PROGRAM.runner is not None

FAILING = replace(
    PROGRAM,
    name="failing",
    runner=replace(PROGRAM.runner, train=(*PROGRAM.runner.train, "--fail", "yes")),
)
ABSENT = replace(
    PROGRAM, name="absent", runner=replace(PROGRAM.runner, train=("no-such-program", "{data}"))
)
NAMED = replace(
    PROGRAM, name="named", runner=replace(PROGRAM.runner, train=("{source}/x", "{datum}"))
)
FROM_SOURCE = replace(
    PROGRAM, name="from-source", runner=replace(PROGRAM.runner, train=("{source}/x", "{data}"))
)
NO_POINTS = replace(
    PROGRAM, name="no-points", runner=replace(PROGRAM.runner, primitives="model/cloud.ply")
)
OTHER_CONFIG = replace(PROGRAM, name="other-config", config="toy_methods:Config")
LEAVES_NOTHING = replace(
    PROGRAM, name="leaves-nothing", runner=replace(PROGRAM.runner, model="elsewhere/*")
)
