"""Progress of a training, or of several: a live bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from chronoscene.io.log import Log
from chronoscene.io.processes import Report
from chronoscene.io.wording import format_time, printable

KNOWN = 0.1  # Share of a run after which rate and time left are shown: before, it mostly starts


class RunsDisplay:
    """Shows how many of several runs at a time have ended, their rate, and the time left."""

    def __init__(self, total: int, log: Log, console: Console | None = None) -> None:
        self._total, self._ended = total, 0
        self._log = log
        self._shares: dict[Report, float] = {}
        self._elsewhere: dict[Report, float] = {}  # of them, what took none of our time
        self._began = time.monotonic()
        self._lock = threading.Lock()
        console = console or Console(stderr=True)
        self._live = console.is_terminal
        self._bar = Progress(
            BarColumn(bar_width=12),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.description}", markup=False),
            console=console,
            transient=True,
            disable=not self._live,
        )

    def __enter__(self) -> RunsDisplay:
        self._task = self._bar.add_task(self.status(0.0), total=self._total)
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def log(self, line: str) -> None:
        """Print a line above the bar."""
        if self._live:
            line = printable(line)
            self._bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
        else:
            self._log(line)

    @contextmanager
    def showing(self) -> Iterator[Report]:
        """A function that takes the progress of a run; it has ended when the block does."""

        def report(what: str, done: int, total: int) -> None:
            if not total:
                self.log(what)
                return
            self._shares[report] = done / total
            self._elsewhere.setdefault(report, done / total)  # the first one: trained before
            self._show()

        with self._lock:
            self._shares[report] = 0.0
        self._show()
        yield report
        with self._lock:  # an error ends the display, too
            del self._shares[report]
            self._ended += 1
        self._show(plain=True)

    def leave_out(self, report: Report) -> None:
        """Count a run that gives no result, or that another command has finished, in no rate."""
        self._elsewhere[report] = 1.0

    def _show(self, *, plain: bool = False) -> None:
        with self._lock:
            done = self._ended + sum(self._shares.values())
            line = self.status(done)
            self._bar.update(self._task, completed=done, description=line)
        if plain and not self._live:
            self._log(line)

    def status(self, done: float) -> str:
        """Describe the progress in one line; ``done`` counts shares of unfinished runs, too."""
        pieces = [f"{self._ended} of {self._total} runs", f"{len(self._shares)} under way"]
        seconds, ours = time.monotonic() - self._began, done - sum(self._elsewhere.values())
        if ours > KNOWN:
            pieces.append(f"{3600 * ours / max(seconds, 1e-9):,.1f} runs/h")
            pieces.append(f"{format_time(seconds * (self._total - done) / ours)} left")
        return ", ".join(pieces)
