"""Steps of structure from motion in a process of their own.

pycolmap can abort the process, and deadlocks after a fork. A step therefore runs in a fresh
interpreter (see `chronoscene.io.processes`): an abort turns into a message, and whatever the step
had stored stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from chronoscene.errors import RegistrationError
from chronoscene.io.processes import Report, run_worker

STEPS = {
    "features": "chronoscene.registration.features.database:extract",
    "pairs": "chronoscene.registration.features.pairs:choose_pairs",
    "matches": "chronoscene.registration.features.database:match",
    "holdout": "chronoscene.registration.features.holdout:hold_out",
    "joint": "chronoscene.registration.reconstruct.routes:joint",
    "separate": "chronoscene.registration.reconstruct.routes:separate",
    "frozen": "chronoscene.registration.reconstruct.routes:add_period",
    "refine": "chronoscene.registration.reconstruct.routes:refine",
}
"""Name of a step to ``module:function``, which takes a dictionary and a `Report` and returns what
JSON can hold."""

LOG_LINES = 4
"""Of the step's own output, at the end of a message."""


def run_step(
    step: str,
    arguments: Mapping[str, Any],
    *,
    log: Path,
    report: Report | None = None,
    inherited: Sequence[int] = (),
) -> Any:
    """Run a step in a process of its own and return its result.

    Args:
        step: One of `STEPS`.
        arguments: What JSON can hold.
        log: File to which the step's own output is appended.
        report: Called with its progress.
        inherited: File descriptors that stay open in the process.

    Raises:
        RegistrationError: If the process dies.
        ChronoSceneError: What the step raised, as a `RegistrationError` with the same words.
    """
    with log.open("ab") as file:
        outcome = run_worker(STEPS[step], arguments, report=report, log=file, inherited=inherited)
    if outcome.message is None:
        said = _end_of(log)
        raise RegistrationError(
            f"step {step}",
            expected="the step to finish",
            found=f"{outcome.cause} ({said})" if said else outcome.cause,
            todo="what was computed before is kept: run the command again, with --threads 1 or "
            f"other settings if it happens again; see {log}",
        )
    if "error" in outcome.message:
        raise RegistrationError(**outcome.message["error"])
    return outcome.message["result"]


def _end_of(log: Path) -> str:
    """The last lines of a log on one line."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return " / ".join(line.strip()[:160] for line in lines[-LOG_LINES:])
