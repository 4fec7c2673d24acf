"""Python in a process of its own, with nothing loaded."""

import subprocess
import sys


def run_python(code: str, *arguments: object) -> str:
    """Return what code prints; it must not fail."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_by(code: str) -> set[str]:
    """Return the names of all modules that code loads."""
    shown = run_python(f"{code}\nimport sys; print('loaded', *sys.modules)")
    return set(shown.rpartition("loaded")[2].split())
