"""Programs of others: run to their end, with a log, and watched with all that they start."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen, TimeoutExpired

import psutil

from chronoscene.errors import ProgramError
from chronoscene.io.processes import Outcome, end_processes, process_tree, stoppable
from chronoscene.io.wording import printable

END_OF_LOG, START_OF_COMMAND = 300, 80  # Characters that an error repeats
FIRST_PAUSE, LONGEST_PAUSE = 0.1, 1.0
"""Seconds between two looks at the memory: to measure a large process takes some milliseconds."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Time and memory of a program."""

    seconds: float
    peak_memory_bytes: int | None
    """Sum over all its processes, shared pages counted once, sampled once a second; None if it is
    unknown."""


def run_program(command: Sequence[str], *, folder: Path, log: Path) -> Usage:
    """Run a command to its end. All that it started ends with it, also on interruption.

    Args:
        command: The words.
        folder: The current folder of the program.
        log: File that everything it prints is added to.

    Raises:
        ProgramError: If it cannot be started or fails; with the last lines of the log.
    """
    started, peak = time.perf_counter(), 0
    with log.open("ab") as file, stoppable():
        file.write(f"$ {shlex.join(command)}\n".encode())
        file.flush()
        try:
            process = Popen(
                command,
                cwd=folder,
                stdin=DEVNULL,
                stdout=file,
                stderr=STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            raise ProgramError(
                _named(command),
                expected="a program that can be started",
                found=error.strerror or str(error),
                todo="install it, or name its environment with --set prefix=...; "
                "docs/guides/other-programs.md says how",
            ) from error
        try:
            pause = FIRST_PAUSE
            while process.poll() is None:
                peak = max(peak, memory_of(process_tree([process.pid])))
                with suppress(TimeoutExpired):
                    process.wait(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
            seconds = time.perf_counter() - started
        finally:
            end_processes([process.pid])
            process.wait()
    if process.returncode:
        raise ProgramError(
            _named(command),
            expected="the program to succeed",
            found=f"{Outcome(process.returncode, None).cause}; {log.name} ends with: "
            + printable(_end_of(" | ".join(log_lines(log)))),
            todo="correct what it says",
        )
    return Usage(seconds, peak or None)


def _named(command: Sequence[str]) -> str:
    text = shlex.join(command)
    return text if len(text) <= START_OF_COMMAND else f"{text[:START_OF_COMMAND]} ..."


def _end_of(text: str) -> str:
    return text if len(text) <= END_OF_LOG else f"... {text[-END_OF_LOG:]}"


def log_lines(log: Path) -> list[str]:
    """Read the lines of a log that are not empty, without blanks around them."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line.strip() for line in lines if line.strip()]


def memory_of(processes: set[int]) -> int:
    """Sum the memory of processes in bytes, with their shares of pages in common with others.

    Where the share is unknown (macOS, Windows), pages in common are left out.
    """
    total = 0
    for pid in processes:
        with suppress(psutil.Error):  # ended in the meantime, or another user's
            taken = psutil.Process(pid).memory_full_info()
            total += getattr(taken, "pss", taken.uss)
    return total
