"""Progress of long commands: one bar on a terminal, else a plain line for each step, on stderr.

`chronoscene bench` has its own bar for trainings, `chronoscene.harness.train.progress`, which shows
the loss and handles trainings that end by the clock.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

from chronoscene.cli.output import say
from chronoscene.io.processes import Report
from chronoscene.io.wording import printable

T = TypeVar("T")
BAR_WIDTH = 20
"""Characters: the rest of a line of 80 is for the name of the step and the numbers."""
BETWEEN_LINES = 30.0  # Seconds after which a step that goes on is printed again, without a terminal
MEMORY = 300.0  # Seconds over which the rate is a mean; a step may be a scene, which takes a minute


@contextmanager
def progress_bar(first: str = "") -> Iterator[Report]:
    """Yield a function that reports progress.

    On a terminal, it draws a bar with counts, rate, elapsed and remaining time, which disappears
    when the block ends. Elsewhere, it prints a line when a step begins, and its counts twice a
    minute. ``partial(report, "images")`` is for work that counts only images.

    Args:
        first: The first step, which has no counts.
    """
    if sys.stderr.isatty():
        with _bar(first) as report:
            yield report
    else:
        report = _print_steps()
        if first:
            report(first, 0, 1)
        yield report


def tracked(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
    """Yield items while a bar counts the finished ones.

    Args:
        items: Any iterable; one without a length needs a ``total``.
        what: Text before the bar.
        total: Number of items.
    """
    if total is None:
        assert isinstance(items, Sized)
        total = len(items)
    with progress_bar() as report:
        report(what, 0, total)
        for done, item in enumerate(items, 1):
            yield item
            report(what, done, total)


@contextmanager
def _bar(first: str = "") -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),  # names of scenes may have brackets
        BarColumn(BAR_WIDTH),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("<"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, speed_estimate_period=MEMORY
    ) as progress:
        bar = progress.add_task(first, total=None, rate="")

        def report(what: str, done: int, total: int) -> None:
            task, what = progress.tasks[0], printable(what)
            counts_on = task.total == total and done > task.completed  # under another name
            if what != task.description and not counts_on:
                progress.reset(bar, total=total, completed=done, description=what, rate="")
            progress.update(bar, description=what, completed=done, total=total)
            task.fields["rate"] = format_rate(task.speed)

        yield report


def _print_steps() -> Report:
    last, printed = "", 0.0

    def report(what: str, done: int, total: int) -> None:
        nonlocal last, printed
        now = time.monotonic()
        if what != last or (now - printed >= BETWEEN_LINES and done < total):
            say(f"{what}: {done} of {total}" if total > 1 else what)
            last, printed = what, now

    return report


def format_rate(speed: float | None) -> str:
    """Return ``120/s`` or ``0.25/s``, or nothing if the rate is not known yet."""
    if not speed:
        return ""
    return f"{speed:,.0f}/s" if speed >= 9.5 else f"{speed:.2g}/s"
