"""Share of planted bugs that the tests catch: ``make mutants``.

``mutants.toml`` beside this file lists the bugs. Each is planted alone in a copy of the repository,
where the tests run that one would run after work on that place. Exit status 1 below `GOAL`, 2 for a
list that does not fit the code.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("mutants.toml")

GOAL = 0.95  # Share of the bugs that the tests must catch
LIMIT = 120.0  # Seconds after which tests of a bug, an endless loop perhaps, have caught it

_LEFT_OUT = ("build", "demo", "dist", "runs")  # Folders of the repository that no test needs


class StaleError(Exception):
    """A bug that does not fit the code, or tests that do not pass without it."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """A bug: one piece of code replaced by another."""

    name: str
    path: str
    before: str
    """Part of the code that is in the file once."""
    after: str
    tests: tuple[str, ...]
    """Files or names of tests, as for pytest."""

    def planted(self, root: Path) -> str:
        """Return the text of the file with the bug.

        Raises:
            StaleError: If the code is not there, or several times.
        """
        file = root / self.path
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        if text.count(self.before) != 1:
            raise StaleError(
                f"{self.name}: expected {self.before!r} once in {self.path}, "
                f"found {text.count(self.before)} times; correct {TABLE.name}"
            )
        return text.replace(self.before, self.after)


def read_mutants(table: Path = TABLE) -> list[Mutant]:
    """Read the list of bugs."""
    rows = tomllib.loads(table.read_text(encoding="utf-8"))
    return [Mutant(name, **{**row, "tests": tuple(row["tests"])}) for name, row in rows.items()]


def copy_repository(target: Path) -> Path:
    """Copy the repository as it is now, with compiled kernels, which are in __pycache__."""

    def left_out(folder: str, names: list[str]) -> list[str]:
        at_root = Path(folder) == ROOT
        return [n for n in names if n.startswith(".") or (at_root and n in _LEFT_OUT)]

    return shutil.copytree(ROOT, target, ignore=left_out)


def run_tests(root: Path, tests: Sequence[str], limit: float | None = None) -> int | None:
    """Run pytest up to the first failure; without a limit of seconds, its output is shown.

    Returns:
        Its exit status; None at the limit.
    """
    options = ["-x", "-q", "-p", "no:cacheprovider"]
    output = None if limit is None else subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=output,
        stderr=output,
        start_new_session=True,
    )
    try:
        return process.wait(limit)
    except subprocess.TimeoutExpired:
        return None
    finally:
        if process.poll() is None:  # with the processes that it has started
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def planted(root: Path, mutant: Mutant) -> Iterator[None]:
    """Have the bug in the files for the block; their times are as before afterwards."""
    file = root / mutant.path
    text, times = mutant.planted(root), file.stat()
    original = file.read_bytes()
    file.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        file.write_bytes(original)
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))


def survivors(root: Path, mutants: Sequence[Mutant]) -> list[Mutant]:
    """Run the tests of each bug in a folder, with a line for each; return those not caught.

    Raises:
        StaleError: If a bug does not fit the code, or tests fail without a bug, or do not start
            with it.
    """
    for mutant in mutants:
        mutant.planted(root)
    tests = list(dict.fromkeys(test for mutant in mutants for test in mutant.tests))
    if status := run_tests(root, tests):
        raise StaleError(f"the tests do not pass without a bug: pytest ended with {status}")
    alive = []
    for mutant in mutants:
        begin = time.perf_counter()
        with planted(root, mutant):
            status = run_tests(root, mutant.tests, LIMIT)
        if status not in (0, 1, None):
            raise StaleError(f"{mutant.name}: the tests do not run, pytest ended with {status}")
        result = "survived" if status == 0 else "caught"
        if status == 0:
            alive.append(mutant)
        print(f"{result:8} {time.perf_counter() - begin:6.1f} s  {mutant.name}", flush=True)
    return alive


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("names", nargs="*", help="bugs to plant; all by default")
    names = parser.parse_args().names
    mutants = [m for m in read_mutants() if not names or m.name in names]
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_repository(Path(folder) / "copy")
        try:
            alive = survivors(copy, mutants)
        except StaleError as error:
            print(error, file=sys.stderr)
            return 2
    share = 1 - len(alive) / len(mutants)
    minutes = (time.perf_counter() - begin) / 60
    print(f"{len(mutants) - len(alive)} of {len(mutants)} caught: {share:.0%}, {minutes:.1f} min")
    return int(share < GOAL)


if __name__ == "__main__":
    sys.exit(main())
