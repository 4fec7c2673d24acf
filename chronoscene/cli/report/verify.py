"""``chronoscene verify``: scores of finished runs computed again and compared."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, LPIPS_WEIGHTS, RUNS
from chronoscene.cli.output import emit, terminal_width
from chronoscene.cli.progress import progress_bar
from chronoscene.harness.score.verification import Verified, verify
from chronoscene.io.tables import Table, boxed_text
from chronoscene.io.wording import printable
from leaderboard.verification import verify_entries

NOT_VERIFIED = 1  # Exit status when something differs or is absent


@click.command("verify")
@RUNS
@click.option(
    "--entries",
    type=EXISTING_FOLDER,
    help="Also compare entries of the leaderboard with the runs that they were made of.",
)
@LPIPS_WEIGHTS
def command(folders: tuple[Path, ...], entries: Path | None, lpips_weights: Path | None) -> None:
    """Compute scores again and compare them with stored ones.

    RUNS are folders of single runs or of many. Scores are computed from the stored predictions and
    the frozen ground truth, and compared with run.json, results.json, both rows.csv and, with
    --entries, entries of the leaderboard. Values agree if they differ by at most 1e-6 (relative for
    values above 1). The hashes of images, model and configuration and the bytes of the model are
    compared as well. Nothing is written. Exit status: 0 if everything agrees, else 1.
    """
    with progress_bar("load the metrics") as bar:
        found = [
            run
            for folder in folders
            for run in verify(folder, lpips_weights=lpips_weights, progress=bar)
        ]
    if entries is not None:
        found += verify_entries(entries, found)
    emit(boxed_text(_table(found), width=terminal_width()) + _findings(found))
    if any(run.verdict in ("differs", "incomplete") for run in found):
        click.get_current_context().exit(NOT_VERIFIED)


def _table(found: list[Verified]) -> Table:
    rows = [
        (run.label, str(run.views), str(len(run.metrics)), f"{run.largest:.3g}", run.verdict)
        for run in found
    ]
    return Table(["run", "views", "metrics", "largest difference", "verdict"], rows)


def _findings(found: list[Verified]) -> str:
    """Write what differs or is absent, and then once what was not checked."""
    lines = [
        f"{run.label}: {kind}: {text}"
        for run in found
        for kind, texts in (("differs", run.differs), ("incomplete", run.absent))
        for text in texts
    ]
    reasons = dict.fromkeys(pair for run in found for pair in run.unchecked.items())
    lines += [f"{name} not checked: {reason}" for name, reason in reasons]
    return "".join(printable(line) + "\n" for line in lines)
