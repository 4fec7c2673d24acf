"""Makes ``toy_scene`` importable; all tests here are on one thread."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent / "support"))


@pytest.fixture(autouse=True)
def quick(one_thread: None) -> None:
    """Trainings here are of small scenes."""
