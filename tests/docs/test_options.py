"""Options of commands and methods, and presets, that pages name exist."""

import re
import subprocess
from pathlib import Path

import click
import pytest

from chronoscene.cli import COMMANDS, cli
from chronoscene.methods import installed_methods, load_spec, options_of

ROOT = Path(__file__).parents[2]
PAGES = subprocess.run(
    ["git", "-C", str(ROOT), "ls-files", "docs", "README.md", "baselines", "benchmarks"],
    capture_output=True,
    text=True,
    check=True,
).stdout.splitlines()
MARKDOWN = [page for page in PAGES if page.endswith(".md")]


@pytest.fixture(scope="module")
def command_options() -> dict[str, set[str]]:
    """Options by command."""
    group = click.Context(cli)
    return {
        name: {option for p in cli.get_command(group, name).params for option in p.opts}
        for name in COMMANDS
    }


@pytest.fixture(scope="module")
def known() -> tuple[set[str], set[str]]:
    """Options and presets of the installed methods."""
    specs = [load_spec(name) for name in installed_methods()]
    options = {option.name for spec in specs for option in options_of(spec)}
    return options, {preset for spec in specs for preset in spec.presets}


@pytest.mark.parametrize("page", MARKDOWN)
def test_options_of_commands_exist(page: str, command_options: dict[str, set[str]]) -> None:
    text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
    for command, rest in re.findall(r"chronoscene ([a-z-]+)( [^`\n#]*)?", text):
        if command in COMMANDS:
            named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest))
            assert named - {"--help"} <= command_options[command], command


@pytest.mark.parametrize("page", MARKDOWN)
def test_options_and_presets_exist(page: str, known: tuple[set[str], set[str]]) -> None:
    known_options, known_presets = known
    text = (ROOT / page).read_text(encoding="utf-8")
    options = {name.rpartition(".")[2] for name in re.findall(r"--set\s+'?([\w.-]+)=", text)}
    assert options - {"NAME", "METHOD.NAME", "key", "KEY"} <= known_options
    named = re.findall(r"--preset\s+([\w./-]+)", text)
    presets = {name.rstrip(".") for name in named if not name.endswith(".toml")}
    assert presets - {"NAME", "TEXT", "demo"} <= known_presets  # "demo" is one of synth
