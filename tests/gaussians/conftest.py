"""Makes ``toy_scene`` importable."""

import sys
from pathlib import Path

import pytest

from chronoscene.kernels.runtime import set_threads

sys.path.append(str(Path(__file__).parent / "support"))


@pytest.fixture(autouse=True)
def one_thread():
    """Scenes this small are quicker on one thread, most of all beside other work."""
    set_threads(1)
    yield
    set_threads()
