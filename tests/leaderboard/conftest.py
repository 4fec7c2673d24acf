"""Finished runs that nobody trained, with their predictions."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from made_runs import write_scored


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Factory of folders of runs below ``tmp_path / "runs"``."""
    return partial(write_scored, tmp_path / "runs")
