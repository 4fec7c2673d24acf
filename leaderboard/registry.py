"""Names that the board knows by itself: methods and their titles, scenes and their hashes.

An entry does not say how its method is called in tables, and cannot give a name that is taken to
something else.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from chronoscene.harness.files.command_line import command_line
from chronoscene.harness.files.records import RunRecord, variant_options
from chronoscene.harness.report.comparable import budget_of
from chronoscene.harness.report.published import load_published
from chronoscene.harness.report.tradeoff import BUDGET_TOLERANCE, as_configurations
from chronoscene.methods import MethodSpec, installed_methods, load_spec
from leaderboard import scenes
from leaderboard.scenes import views_hash

LAST_STEP = 10.0
"""Seconds by which the last step of a model may exceed a budget."""
_ALIKE = str.maketrans("015i", "olsl")


@cache
def spec_of(method: str) -> MethodSpec | None:
    """Load the spec of an installed method; nothing that an entry names is imported."""
    return load_spec(method) if method in installed_methods() else None


@cache
def _titles() -> dict[str, str]:
    """Titles of methods that are not installed."""
    text = Path(__file__).with_name("methods.toml").read_text(encoding="utf-8")
    return {method: title for title, method in load_published().methods.items()} | tomllib.loads(
        text
    )


def title_of(method: str, preset: str = "") -> str | None:
    """Return the name of a method in tables; None for a method that is not registered."""
    spec = spec_of(method)
    return _titles().get(method) if spec is None else spec.title_of(preset)


def command_of(run: RunRecord) -> str:
    """Write the command that repeats a run; empty if method or preset are not installed here.

    Options of other programs are parts of commands: there is none for these.
    """
    spec = spec_of(run.method)
    if spec is None or spec.runner is not None or run.preset not in spec.presets:
        return ""
    (configuration,) = as_configurations([run])
    return command_line("SCENE", dict(configuration), run.seed)


def check_scene(run: RunRecord, views: Iterable[tuple[str, int]]) -> None:
    """Check that a scene with a known name or hash is that one, with all of its test views.

    Raises:
        ValueError: If it is not.
    """
    known = scenes.fixed_scenes()
    taken = {_skeleton(row.scene): row.scene for row in load_published().rows}
    taken |= {_skeleton(name): name for name in known}
    by_hash = [name for name, scene in known.items() if scene.scene_hash == run.scene_hash]
    name = next(iter(by_hash), taken.get(_skeleton(run.scene)))
    if name is None:
        return
    if name not in known:
        raise ValueError(f"scene {name} of the paper, whose hash is not in scenes.toml")
    fixed = known[name]
    given = (run.scene, run.scene_hash, run.split_hash)
    if given != (name, fixed.scene_hash, fixed.split_hash):
        raise ValueError(f"another name, photos or split than {name} has in scenes.toml")
    if views_hash(views) != fixed.views_hash:
        raise ValueError(f"other views or periods than the test views of {name}")


def _skeleton(name: str) -> str:
    """Return what a reader sees at a glance: no case, no signs, and letters for alike digits."""
    return re.sub(r"[^a-z0-9]", "", name.casefold()).translate(_ALIKE)


def check_effort(run: RunRecord) -> None:
    """Compare seconds and steps of a run with what its preset and options allow.

    Raises:
        ValueError: If they are more.
    """
    options = variant_options(run.variant)
    models = len(run.period_labels)
    if "budget" in options:
        budget, late = budget_of(run), 1 + BUDGET_TOLERANCE
        if not (budget and run.seconds and run.seconds <= late * budget + LAST_STEP * models):
            raise ValueError(f"{run.seconds} s of training with budget={options['budget']}")
        return
    spec = spec_of(run.method)
    steps = spec.presets.get(run.preset, {}).get("iterations") if spec is not None else None
    if "iterations" in options:
        steps = int(options["iterations"].rpartition("+")[2])
    if steps is not None and run.iterations is not None and run.iterations > steps * models:
        raise ValueError(f"{run.iterations} training steps with {steps} by preset and options")
