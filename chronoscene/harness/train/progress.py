"""Progress of one training: a live bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from chronoscene.harness.plan.stop import StopRule
from chronoscene.io.processes import Report
from chronoscene.io.wording import format_time, printable
from chronoscene.methods import StepReport

REFRESH = 0.1  # Seconds between two updates of the bar

REPORTING = 1.0  # Seconds between two reports to another process

SILENCE = 60.0  # Seconds after which a line is printed although no probe was scored

SMOOTHING = 0.95  # Weight of the past in the loss that is shown


class ProgressDisplay:
    """Display of iteration, loss, probe PSNR, speed and time left of one model after another.

    Args:
        label: Name of the run.
        console: Terminal; None for standard error.
        report: Called with thousandths of the run and with notes, instead of the terminal.
        models: Number of models of the run.
    """

    def __init__(
        self,
        label: str,
        console: Console | None = None,
        *,
        report: Report | None = None,
        models: int = 1,
    ) -> None:
        self.label = label
        self.console = console or Console(stderr=True, quiet=report is not None)
        self._report, self._models, self._model = report, models, -1
        self._live = self.console.is_terminal and report is None
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=12),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[status]}", markup=False),
            console=self.console,
            transient=True,
            disable=not self._live,
        )
        self._task: TaskID | None = None
        self._stop = StopRule(1, None)
        self._name = label
        self._loss: float | None = None
        self._psnr: float | None = None
        self._shown = self._printed = 0.0

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def wait(self, step: str) -> None:
        """Show a step of the run before or after its trainings."""
        self._show(step, None, "")
        if not self._live:
            self._print(f"{self.label}: {step}")

    def begin(self, part: str, stop: StopRule) -> None:
        """Start over for the next model."""
        self._name = self.label if part == "all" else f"{self.label} {part}"
        self._stop, self._loss, self._psnr, self._shown = stop, None, None, 0.0
        self._printed = time.monotonic()
        self._model += 1
        # The runner has named the run already, and a terminal may be 80 columns wide.
        shown = "" if part == "all" else part
        self._show(shown, 1.0, "setup")
        if not self._live:
            self._print(f"{self._name}: training")

    def log(self, line: str) -> None:
        """Print a line above the bar."""
        if self._report is not None:
            self._report(f"{self._name}: {line}", 0, 0)
        self._print(f"{self._name}: {line}")

    def update(
        self, iteration: int, seconds: float, report: StepReport, psnr: float | None
    ) -> None:
        """Show one step, as the observer of `loop.train`."""
        if report.skipped is None and math.isfinite(report.loss):
            past = report.loss if self._loss is None else self._loss
            self._loss = SMOOTHING * past + (1 - SMOOTHING) * report.loss
        now, progress = time.monotonic(), self._stop.progress(iteration, seconds)
        if self._report is not None and now - self._shown > REPORTING:
            self._shown = now
            done = (self._model + progress) / self._models
            self._report(self.status(iteration, seconds, psnr), round(1000 * done), 1000)
        if self._live and self._task is not None and (now - self._shown > REFRESH or progress == 1):
            self._shown = now
            status = self.status(iteration, seconds, psnr)
            self._bar.update(self._task, completed=progress, status=status)
        scored = psnr is not None and str(psnr) != str(self._psnr)  # or nan
        if not self._live and (scored or now - self._printed > SILENCE):
            self._printed = now
            status = self.status(iteration, seconds, psnr)
            self._print(f"{self._name}: {progress:4.0%} {status}, {report.primitives} primitives")
        self._psnr = psnr

    def _show(self, step: str, total: float | None, status: str) -> None:
        """Replace what the bar shows."""
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(printable(step), total=total, status=status)

    def _print(self, line: str) -> None:
        """Print a line, in which names of scenes are only text."""
        self.console.print(printable(line), highlight=False, markup=False, soft_wrap=True)

    def status(self, iteration: int, seconds: float, psnr: float | None) -> str:
        """Return the state of the training in one line."""
        left = self._stop.seconds_left(iteration, seconds)
        pieces = [f"iteration {iteration}"]
        if self._loss is not None:
            pieces.append(f"loss {self._loss:.4f}")
        if psnr is not None and not math.isnan(psnr):
            pieces.append(f"{psnr:.2f} dB")
        pieces.append(f"{iteration / max(seconds, 1e-9):.1f} it/s")
        if left is not None and left > 0:
            pieces.append(f"{format_time(left)} left")
        return ", ".join(pieces)
