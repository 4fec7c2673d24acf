"""``chronoscene submit`` and ``leaderboard``: results of finished runs as a site."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, FOLDER, RUNS, reading_options, refuse_options
from chronoscene.cli.output import check_place, report_written, say, writing_to
from chronoscene.cli.progress import progress_bar
from chronoscene.harness.report.published import load_published
from leaderboard.board import read_board
from leaderboard.site import write_site
from leaderboard.submit import submit


@click.command("submit")
@RUNS
@click.option(
    "--to",
    type=FOLDER,
    required=True,
    help="Folder of entries, such as leaderboard/entries/measured.",
)
def submit_command(folders: tuple[Path, ...], to: Path) -> None:
    """Add finished runs to the entries of the leaderboard.

    RUNS are folders of single runs or of many. An entry is a JSON file with the values of all test
    views and the costs of the runs, and a folder of their predictions beside it. The predictions
    are scored again with the frozen ground truth, and a run with other values is refused. Seeds of
    one setting share a file; a seed that is already there is replaced.
    """
    with writing_to("--to", to):
        written = submit(folders, to)
    report_written(*written)


@click.command("leaderboard")
@click.argument("entries", type=EXISTING_FOLDER)
@click.option("--out", type=FOLDER, required=True, help="New folder for the site.")
@click.option(
    "--verify",
    "scenes",
    multiple=True,
    type=EXISTING_FOLDER,
    help="Folder of a scene: the predictions of its entries are scored again, against its own test "
    "photos. May be repeated.",
)
@reading_options("the scenes of --verify")
@click.option(
    "--runs",
    multiple=True,
    type=EXISTING_FOLDER,
    help="Folder of the runs that entries were made of: pictures of their test views come from "
    "there. May be repeated.",
)
def leaderboard_command(
    entries: Path,
    out: Path,
    scenes: tuple[Path, ...],
    dataset_format: str | None,
    period_by: str | None,
    runs: tuple[Path, ...],
) -> None:
    """Build the site of the leaderboard.

    ENTRIES is a folder of measured entries. Those whose predictions have been scored again, with
    --verify, are ranked; the others stand below as claimed. Entries that cannot be true, or whose
    values are not those of their predictions, are left out with a notice. Published figures are
    shown beside them. The site needs no server: open its index.html.
    """
    if not scenes:
        refuse_options(("dataset_format", "period_by"), "without --verify")
    check_place("--out", out)
    with progress_bar() as bar:
        board = read_board(
            entries,
            scenes,
            format=dataset_format,
            period_by=period_by,
            progress=bar if scenes else None,
        )
    pictured = write_site(board.standings, load_published(), out, runs)
    for notice in board.notices:
        say(notice, fg="yellow")
    claimed = Counter(standing.claimed for standing in board.standings)
    verified = claimed.pop("", 0)
    outdated = sum(standing.entry.outdated for standing in board.standings)
    click.echo(
        f"measured entries: {len(board.standings)}; verified: {verified}; "
        f"claimed: {claimed.total()}; of older code: {outdated}; with pictures: {pictured}"
    )
    if runs and not pictured:
        folders = ", ".join(map(str, runs))
        click.echo(f"no pictures: no run in {folders} is the first one of an entry")
    for reason, number in claimed.items():
        click.echo(f"claimed: {number}: {reason}")
    report_written(out / "index.html")
