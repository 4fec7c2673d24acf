"""Steps of structure from motion in a process of their own.

pycolmap can abort the process, and deadlocks after a fork. A step therefore runs in a fresh
interpreter: an abort turns into a message, and whatever the step had stored stays. The step writes
its results to files; what passes between the two processes are lines of JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from chronoscene.errors import ChronoSceneError, RegistrationError

Report = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and its total."""

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
    command = [sys.executable, "-m", "chronoscene.registration.worker", STEPS[step]]
    with log.open("ab") as errors:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            pass_fds=inherited,
        )
        try:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # it died already: the log says why
                process.stdin.write(json.dumps(arguments))
                process.stdin.close()
            result = _listen(process, report)
            status = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    if result is None:
        raise RegistrationError(
            f"step {step}",
            expected="an end",
            found=_ending(status, log),
            todo="what was computed before is kept: run the command again, with --threads 1 or "
            f"other settings if it happens again; see {log}",
        )
    if "error" in result:
        raise RegistrationError(**result["error"])
    return result["result"]


def _listen(process: subprocess.Popen[str], report: Report | None) -> dict[str, Any] | None:
    """Pass progress on until the last message, which is returned."""
    assert process.stdout is not None
    result = None
    for line in process.stdout:
        try:
            message = json.loads(line)
        except ValueError:
            continue  # cut off by the death of the process
        if "progress" in message:
            if report is not None:
                report(*message["progress"])
        else:
            result = message
    return result


def _ending(status: int, log: Path) -> str:
    """How a process ended, and the end of what it said."""
    how = f"signal {-status}" if status < 0 else f"exit status {status}"
    if -status in set(signal.Signals):
        how = f"signal {signal.Signals(-status).name}"
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = " / ".join(line.strip()[:160] for line in lines[-LOG_LINES:])
    return f"{how} ({said})" if said else how


def _die_with(parent: int) -> None:
    """End this process when its parent is gone: two processes must not write one database."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Read arguments from stdin, run the step, write progress and the result as lines."""
    _die_with(os.getppid())
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # libraries print to stdout, which is ours alone

    def send(message: Mapping[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")

    def report(what: str, done: int, total: int) -> None:
        send({"progress": [what, done, total]})

    arguments = json.load(sys.stdin)
    module, _, name = sys.argv[1].partition(":")
    try:
        step = getattr(importlib.import_module(module), name)
        send({"result": step(arguments, report)})
    except ChronoSceneError as error:
        keys = ("place", "expected", "found", "todo")
        send({"error": {key: getattr(error, key) for key in keys}})


if __name__ == "__main__":
    main()
