"""``chronoscene submit`` and ``leaderboard``: results of finished runs as a site."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, FOLDER, RUNS
from chronoscene.cli.output import check_place, report_written, writing_to
from chronoscene.harness.report.published import load_published
from leaderboard.entries import read_entries
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
    views, the costs of the runs, and the hashes of the predictions, which are checked. Seeds of one
    setting share a file; a seed that is already there is replaced.
    """
    with writing_to("--to", to):
        written = submit(folders, to)
    report_written(*written)


@click.command("leaderboard")
@click.argument("entries", type=EXISTING_FOLDER)
@click.option("--out", type=FOLDER, required=True, help="New folder for the site.")
@click.option(
    "--runs",
    multiple=True,
    type=EXISTING_FOLDER,
    help="Folder of the runs that entries were made of: pictures of their test views come from "
    "there. May be repeated.",
)
def leaderboard_command(entries: Path, out: Path, runs: tuple[Path, ...]) -> None:
    """Build the site of the leaderboard.

    ENTRIES is a folder of measured entries; published figures are shown beside them. The site needs
    no server: open its index.html.
    """
    check_place("--out", out)
    found = [*read_entries(entries).values()]
    pictured = write_site(found, load_published(), out, runs)
    outdated = sum(entry.outdated for entry in found)
    click.echo(f"{len(found)} measured entries: {outdated} of older code, {pictured} with pictures")
    report_written(out / "index.html")
