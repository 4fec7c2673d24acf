"""Scripts of the benchmarks can be imported, and their README lists each."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "benchmarks/README.md").read_text(encoding="utf-8")
SCRIPTS = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "benchmarks").rglob("*.py"))
    if 'if __name__ == "__main__"' in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("script", SCRIPTS)
def test_script_is_imported_and_listed(script: str) -> None:
    assert hasattr(importlib.import_module(script), "main")
    assert re.search(rf"`python -m {re.escape(script)}[ `]", README)


def test_idle_threads_are_told_how_to_wait_before_torch_is_imported() -> None:
    code = (
        "import os, sys, benchmarks; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    )
    environment = {"PYTHONPATH": str(ROOT), "PATH": ""}
    shown = subprocess.check_output([sys.executable, "-P", "-c", code], env=environment, text=True)
    assert shown.split() == ["passive", "False"]
