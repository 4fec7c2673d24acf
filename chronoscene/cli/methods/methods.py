"""``chronoscene methods``: list the installed methods, or everything that one of them can do."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from textwrap import indent

import click
from rich.console import Console
from rich.table import Table

from chronoscene.cli.options import look_here_for
from chronoscene.cli.output import emit, say
from chronoscene.errors import ConfigError
from chronoscene.methods import (
    PROGRAM_GROUP,
    MethodSpec,
    as_typed,
    load_spec,
    method_names,
    options_of,
)
from chronoscene.methods.options import Option
from chronoscene.scene.grouping import grouped


@click.command("methods")
@click.argument("name", required=False)
@click.option("--all", "everything", is_flag=True, help="Show all options of the method NAME.")
def command(name: str | None, everything: bool) -> None:
    """List the installed methods, or describe one.

    For the method NAME (or module:SPEC), print the main options with their defaults, meaning and
    values in the presets.
    """
    if name is None:
        list_methods()
        return
    look_here_for([name])
    emit("\n".join(describe(name, everything=everything)) + "\n")


def list_methods() -> None:
    """Print a table of all installed methods, one of other programs, and what is broken."""
    console = Console()
    table = Table(title="Methods")
    for column in ("name", "title", "period input", "presets"):
        table.add_column(column, no_wrap=column == "name")
    methods, broken = _load(method_names())
    for name, spec in methods.items():
        table.add_row(name, spec.title, spec.period_input, ", ".join(sorted(spec.presets)))
    console.print(table)
    programs, others = _load(method_names(PROGRAM_GROUP))
    if programs:
        console.print(_program_table(programs.values()))
    console.print("chronoscene methods NAME describes one: paper, licence, options.")
    for error in (*broken, *others):
        say(f"left out: {error}", fg="yellow")


def _load(names: Iterable[str]) -> tuple[dict[str, MethodSpec], list[ConfigError]]:
    """Load the methods of these names, and collect the errors of those that cannot be."""
    specs, errors = {}, []
    for name in names:
        try:
            specs[name] = load_spec(name)
        except ConfigError as error:
            errors.append(error)
    return specs, errors


def _program_table(specs: Iterable[MethodSpec]) -> Table:
    """Return the table of methods that are other programs."""
    table = Table(title="External programs, installed apart from ChronoScene")
    for column in ("name", "title", "period input", "tested"):
        table.add_column(column, no_wrap=column == "name")
    for spec in specs:
        tested = spec.runner.tested if spec.runner else ""
        table.add_row(spec.name, spec.title, spec.period_input, tested)
    return table


def describe(name: str, *, everything: bool) -> Iterator[str]:
    """Yield the description of a method, by its name or ``module:SPEC``, line by line."""
    spec = load_spec(name)
    yield f"{spec.title} ({spec.name})"
    yield f"paper: {spec.paper}"
    yield f"licence: {spec.licence}"
    yield f"period input: {spec.period_input}; outputs: {', '.join(spec.outputs)}; " + (
        f"devices: {', '.join(spec.devices)}; can be resumed: {'yes' if spec.resumable else 'no'}"
    )
    yield f"strategy: {spec.strategy}; presets: {', '.join(spec.presets)}"
    if spec.runner is not None:
        yield f"external program, installed apart from ChronoScene; {spec.runner.tested}; commands:"
        for words in (spec.runner.train, *spec.runner.render):
            yield indent(click.wrap_text(shlex.join(words), width=90), "    ")
    options = options_of(spec)
    shown = options if everything else options[: len(spec.main_options) or None]
    yield "\nOptions, with their defaults; --set NAME=VALUE changes one:\n"
    for option in shown:
        yield describe_option(option)
    if hidden := len(options) - len(shown):
        yield f"\n{hidden} more options: chronoscene methods {name} --all"


def describe_option(option: Option) -> str:
    """Return name, default and values in presets of an option, and its meaning below."""
    presets = grouped((as_typed(value), preset) for preset, value in option.presets.items())
    others = "".join(f"; {', '.join(names)}: {value}" for value, names in presets.items())
    text = click.wrap_text(option.meaning or "(no description)", width=80, initial_indent="")
    return f"{option.name}={as_typed(option.default)}{others}\n{indent(text, '    ')}"
