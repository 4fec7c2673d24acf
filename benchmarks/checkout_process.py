"""A process that runs the code of one checkout, or of a changed copy, and answers line by line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class CheckoutProcess:
    """A Python process that reads lines and answers each with a line of JSON.

    Args:
        name: Of the code, for messages.
        arguments: Of Python.
        folders: Where modules are found, the code first.
    """

    def __init__(self, name: str, arguments: Sequence[str], folders: Sequence[Path]) -> None:
        self.name = name
        paths = os.pathsep.join(str(folder.resolve()) for folder in folders)
        self._process = subprocess.Popen(
            [sys.executable, "-P", *arguments],
            env={**os.environ, "PYTHONPATH": paths},
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def ask(self, line: str) -> Any:
        """Send a line and wait for the answer."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(line, file=self._process.stdin, flush=True)
        if not (answer := self._process.stdout.readline()):
            raise SystemExit(f"{self.name}: the process ended early; its message is above")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
