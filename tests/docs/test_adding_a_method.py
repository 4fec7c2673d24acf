"""The guide to methods: its packages work, its dataclasses and rules are those of the code."""

import ast
import dataclasses
import importlib
import re
from pathlib import Path

import pytest
from command_line import run_command

from chronoscene import methods
from chronoscene.harness.contract import CHECKS
from chronoscene.scene.similarity import Sim3

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/guides/adding-a-method.md").read_text(encoding="utf-8")
EXAMPLE = ROOT / "chronoscene/cli/methods/skeleton"
SHOWN = dict(re.findall(r"^`([\w./-]+)`:\n\n```\w+\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
"""Content of each file that the page shows, by its path."""


def test_the_page_shows_the_package_of_new_method():
    shown = {name: text for name, text in SHOWN.items() if not name.startswith("voxel_field/")}
    assert len(shown) == 3 and len(SHOWN) == 5
    for name, text in shown.items():
        assert text == (EXAMPLE / name).read_text(encoding="utf-8"), name


def smaller(text):
    """The same code with a grid and rays that suit the tiny photos of the rules."""
    for option, size in (("resolution", 24), ("rays", 256), ("samples", 48)):
        text = re.sub(rf"^(    {option}: int) = [\d_]+$", rf"\1 = {size}", text, flags=re.MULTILINE)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("package", ["voxel_field", "tinted_gaussians"])
def test_the_packages_on_the_page_keep_all_rules(package, tmp_path, monkeypatch):
    (tmp_path / package).mkdir()
    for name in (f"{package}/__init__.py", f"{package}/method.py"):
        (tmp_path / name).write_text(smaller(SHOWN[name]))
    monkeypatch.syspath_prepend(tmp_path)
    done = run_command("check-method", f"{package}:SPEC")
    assert done.exit_code == 0, done.output
    assert f"{package}:SPEC: 0 of {len(CHECKS)} rules broken" in done.stdout


def test_what_a_subclass_overrides_exists():
    part = PAGE.partition("The base classes")[2].partition("\n\n`chronoscene.rasterizer")[0]
    bullets = re.split(r"^- ", part, flags=re.MULTILINE)[1:]
    assert len(bullets) == 3
    for bullet in bullets:
        words = re.findall(r"`([\w.]+)`", bullet)
        places = [word.rpartition(".") for word in words if word.startswith("chronoscene.")]
        classes = [getattr(importlib.import_module(module), name) for module, _, name in places]
        known = {name for c in classes for name in (*dir(c), *c.__annotations__)}
        assert {w for w in words if re.fullmatch(r"\w+", w)} <= known


def test_the_dataclasses_on_the_page_have_all_fields():
    (block,) = (
        b for b in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class View:" in b
    )
    shown = {
        node.name: [n.target.id for n in node.body if isinstance(n, ast.AnnAssign)]
        for node in ast.parse(block).body
        if isinstance(node, ast.ClassDef)
    }
    shown["TrainingView"] = shown["View"] + shown["TrainingView"]
    for name, fields in shown.items():
        found = Sim3 if name == "Sim3" else getattr(methods, name)
        assert fields == [field.name for field in dataclasses.fields(found)], name


def test_the_rules_on_the_page_are_those_that_are_checked():
    rules = [" ".join(check.__doc__.split("\n\n")[0].split()) for check in CHECKS]
    assert re.findall(r"^- (.*)$", PAGE.partition("## 5. The rules")[2], re.MULTILINE) == rules
