"""``chronoscene table``: results as a table for a terminal, a paper or a program."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.bench.tables import format_runs, read_runs
from chronoscene.cli.output import emit
from chronoscene.errors import ConfigError
from chronoscene.io.tables import FORMATS
from chronoscene.metrics.names import metric_info


@click.command("table")
@click.argument(
    "folders",
    metavar="RUNS...",
    nargs=-1,
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
)
@click.option("--format", "style", type=click.Choice(FORMATS), default="table", show_default=True)
@click.option("--metric", "metrics", multiple=True, help="NAME[,NAME...]; default: all there are.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="File to write.")
def command(
    folders: tuple[Path, ...], style: str, metrics: tuple[str, ...], out: Path | None
) -> None:
    """Show the results of one or several folders of runs.

    Per metric: every period, then macro (mean over periods), micro (mean over views) and the worst
    period. Over several seeds: mean, standard deviation and number.
    """
    wanted = [metric_info(m).name for text in metrics for m in split_list("--metric", text)]
    records, failures = read_runs(folders)
    text = format_runs(records, failures, style, wanted)
    emit(text, out)


def split_list(option: str, text: str) -> tuple[str, ...]:
    """Items of a comma-separated list, each once.

    Raises:
        ConfigError: If an item is empty.
    """
    items = [item.strip() for item in text.split(",")]
    if not all(items):
        raise ConfigError(
            option, expected="names with commas between", found=repr(text), todo="correct the list"
        )
    return tuple(dict.fromkeys(items))
