"""Progress of long commands: one bar on stderr, or lines in a log.

`chronoscene bench` has a bar of its own for trainings, `chronoscene.bench.display`: it shows the
loss, and trainings may end by the clock.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

import click

from chronoscene.io.processes import Report

T = TypeVar("T")
BAR_WIDTH = 20
"""Characters: with the names of our steps, the rest of a line of 80 is for the numbers."""
MEMORY = 300.0  # Seconds over which the rate is a mean; a step may be a scene, which takes a minute


@contextmanager
def progress_bar(*, log: bool = False) -> Iterator[Report]:
    """A function that reports progress.

    On a terminal it draws a bar with counts, rate, elapsed and remaining time, which disappears
    when the block ends. Pass ``partial(report, "images")`` to what counts only images.

    Args:
        log: Print a line whenever a step begins if there is no terminal; otherwise print nothing.
    """
    if sys.stderr.isatty():
        with _bar() as report:
            yield report
    else:
        yield _print_steps() if log else lambda what, done, total: None


def tracked(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
    """Yield items while a bar counts those that the caller has finished.

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
def _bar() -> Iterator[Report]:
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
        bar = progress.add_task("", total=None, rate="")

        def report(what: str, done: int, total: int) -> None:
            task = progress.tasks[0]
            counts_on = task.total == total and done > task.completed  # under another name
            if what != task.description and not counts_on:
                progress.reset(bar, total=total, completed=done, description=what, rate="")
            progress.update(bar, description=what, completed=done, total=total)
            task.fields["rate"] = format_rate(task.speed)

        yield report


def _print_steps() -> Report:
    last = ""

    def report(what: str, done: int, total: int) -> None:
        nonlocal last
        if what != last:
            click.echo(f"{what} ({total})", err=True)
            last = what

    return report


def format_rate(speed: float | None) -> str:
    """``120/s``, ``0.25/s``; nothing where it is not known yet."""
    if not speed:
        return ""
    return f"{speed:,.0f}/s" if speed >= 9.5 else f"{speed:.2g}/s"
