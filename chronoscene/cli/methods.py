"""``chronoscene methods``: list the installed methods."""

from __future__ import annotations

import click
from rich.console import Console
from rich.table import Table

from chronoscene.methods import load_spec, method_names


@click.command("methods")
def command() -> None:
    """List the installed methods and their presets."""
    table = Table(title="Methods")
    for column in ("name", "title", "period input", "presets", "paper"):
        table.add_column(column)
    for name in method_names():
        spec = load_spec(name)
        table.add_row(
            name, spec.title, spec.period_input, ", ".join(sorted(spec.presets)), spec.paper
        )
    Console().print(table)
