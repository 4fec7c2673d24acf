"""``chronoscene methods``: the list, and the description of one method."""

import sys
from pathlib import Path

import pytest
from command_line import invoke, succeed
from installed import install

from chronoscene.methods import load_spec, method_names, options_of

PLUGINS = Path(__file__).parents[2] / "harness" / "plugins"


def methods(*arguments):
    return succeed("methods", *arguments).stdout


def test_the_list_has_every_method():
    text = methods()
    assert all(name in text for name in method_names())


def test_a_broken_plug_in_is_named_below_the_others(tmp_path, monkeypatch):
    entries = {"broken": "needs_more:SPEC", "gone": "not.there:SPEC", "no-spec": "needs_none:SPEC"}
    modules = {"needs_more": "import torch_of_tomorrow", "needs_none": "SPEC = 1"}
    install(monkeypatch, tmp_path, modules, "chronoscene.methods", entries)
    done = invoke("methods")
    assert done.exit_code == 0 and "chronogs" in done.stdout and "realtime4dgs" in done.stdout
    lines = done.stderr.splitlines()
    assert [line.split(":")[1] for line in lines] == [" method broken", " method gone", " no-spec"]
    assert "No module named 'torch_of_tomorrow'; install what plug-in needs" in lines[0]
    assert "expected a MethodSpec, found int" in lines[2]


@pytest.mark.parametrize("name", [*method_names(), "baselines.external:SPLATFACTO"])
def test_every_option_has_a_meaning(name):
    assert [option.name for option in options_of(load_spec(name)) if not option.meaning] == []


def test_a_description_has_defaults_presets_and_meanings():
    text = methods("3dgs")
    assert text.startswith("3DGS (3dgs)\npaper: Kerbl et al., ")
    assert "\niterations=30000; accurate: 8000; balanced: 3000; fast: 1000\n    Training st" in text
    assert "\nstretch=" not in text and "more options: chronoscene methods 3dgs --all\n" in text
    text = methods("3dgs", "--all")
    assert "\nstretch=false; accurate, balanced, fast: true\n    False: moment i is step i" in text
    assert "--all" not in text


def test_commands_name_a_method_that_is_not_installed_by_its_module():
    name = "baselines.gaussian_splatting:SPEC"
    assert f"more options: chronoscene methods {name} --all\n" in methods(name)


@pytest.mark.parametrize("name", method_names())
def test_ten_options_come_first(name):
    spec = load_spec(name)
    first = [option.name for option in options_of(spec)][: len(spec.main_options)]
    assert first == list(spec.main_options) and len(first) == 10 and first[0] == "iterations"


def test_a_method_of_the_current_folder(monkeypatch):
    monkeypatch.delitem(sys.modules, "toy_methods", raising=False)
    monkeypatch.chdir(PLUGINS)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert "rate=0.5\n    (no description)" in methods("toy_methods:MEAN")
