"""Imports point one way; docs/reference/architecture.md shows which."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LAYERS = (
    ("chronogs", "baselines", "chronoscene.__main__"),
    ("chronoscene.cli",),
    ("chronoscene.workflow",),
    ("chronoscene.api",),
    ("leaderboard", "chronoscene.survey"),
    ("chronoscene.harness.study", "chronoscene.harness.contract", "chronoscene.harness.tune"),
    ("chronoscene.harness.view",),
    ("chronoscene.harness.run", "chronoscene.harness.train"),
    ("chronoscene.harness.report", "chronoscene.harness.use"),
    ("chronoscene.harness.score",),
    ("chronoscene.harness.plan",),
    ("chronoscene.harness.files", "chronoscene.harness"),
    ("chronoscene.registration", "chronoscene.figures", "chronoscene.synth"),
    ("chronoscene.statistics", "chronoscene.validation", "chronoscene.download"),
    ("chronoscene.anchors", "chronoscene.gaussians", "chronoscene.fields"),
    ("chronoscene.training",),
    ("chronoscene.rasterizer", "chronoscene.metrics"),
    ("chronoscene.convert", "chronoscene.edit", "chronoscene.undistort"),
    ("chronoscene.methods", "chronoscene.formats", "chronoscene.splat_files"),
    ("chronoscene.images",),
    ("chronoscene.colmap",),
    ("chronoscene.scene",),
    ("chronoscene.compression", "chronoscene.io", "chronoscene.geodesy"),
    ("chronoscene.kernels",),
    ("chronoscene.checks",),
    ("chronoscene.errors", "chronoscene.arrays"),
)
"""From the top down. A module imports from its own package and from lower layers."""

TORCH_SIDE = {
    f"chronoscene.{name}" for name in ("anchors", "gaussians", "fields", "training", "rasterizer")
}
"""Packages that need torch and are used by methods only."""


SKELETON = set((ROOT / "chronoscene/cli/methods/skeleton").rglob("*.py"))


def modules() -> dict[str, Path]:
    """All modules by name; those of the example for methods are a package of its own."""
    found = {}
    for package in ("chronoscene", "chronogs", "baselines", "leaderboard"):
        for path in sorted({*(ROOT / package).rglob("*.py")} - SKELETON):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(name: str) -> set[str]:
    """Our modules that a module imports, also inside of its functions."""
    targets = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                targets.add(whole if whole in MODULES else node.module)
    return {target for target in targets if target in MODULES and target != name}


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    """Imports of each module but the root, which imports its public interface at the first use."""
    return {name: imports(name) for name in MODULES if name != "chronoscene"}


def package(name: str) -> str:
    """Package of a module, in the words of `LAYERS`: the innermost one that has it."""
    found = [p for packages in LAYERS for p in packages if name == p or name.startswith(f"{p}.")]
    assert found, f"{name} is in no layer"
    return max(found, key=len)


def layer(name: str) -> int:
    """Height of a module, 0 at the bottom."""
    heights = {p: height for height, packages in enumerate(reversed(LAYERS)) for p in packages}
    return heights[package(name)]


def test_imports_point_down(graph: dict[str, set[str]]) -> None:
    upward = {
        name: found
        for name, targets in graph.items()
        if (found := {t for t in others(name, targets) if layer(t) >= layer(name)})
    }
    assert not upward


def others(name: str, targets: set[str]) -> set[str]:
    """Those of the modules that are in other packages than the first."""
    return {t for t in targets - {"chronoscene"} if package(t) != package(name)}


def test_no_circle(graph: dict[str, set[str]]) -> None:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_torch_side_is_for_methods(graph: dict[str, set[str]]) -> None:
    users = {
        name: used
        for name, targets in graph.items()
        if package(name) not in TORCH_SIDE | {"chronogs", "baselines"}
        and (used := {t for t in targets - {"chronoscene"} if package(t) in TORCH_SIDE})
    }
    assert not users


def test_few_modules_at_the_root() -> None:
    assert len(list((ROOT / "chronoscene").glob("[!_]*.py"))) <= 8
