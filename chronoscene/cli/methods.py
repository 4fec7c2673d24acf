"""``chronoscene methods``: list the installed methods."""

from __future__ import annotations

import click
from rich.console import Console
from rich.table import Table

from chronoscene.methods import PROGRAM_GROUP, load_spec, method_names


@click.command("methods")
def command() -> None:
    """List the installed methods and their presets."""
    console = Console()
    table = Table(title="Methods")
    for column in ("name", "title", "period input", "presets", "paper"):
        table.add_column(column)
    for name in method_names():
        spec = load_spec(name)
        table.add_row(
            name, spec.title, spec.period_input, ", ".join(sorted(spec.presets)), spec.paper
        )
    console.print(table)
    if programs := method_names(PROGRAM_GROUP):
        console.print(_program_table(programs))


def _program_table(names: tuple[str, ...]) -> Table:
    """Methods that are other programs, which are installed on their own."""
    table = Table(title="External programs, installed apart from ChronoScene")
    for column in ("name", "title", "period input", "tested", "paper"):
        table.add_column(column)
    for spec in map(load_spec, names):
        tested = spec.runner.tested if spec.runner else ""
        table.add_row(spec.name, spec.title, spec.period_input, tested, spec.paper)
    return table
