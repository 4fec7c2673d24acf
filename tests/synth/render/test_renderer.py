"""The ray caster that other parts can do without."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from chronoscene.errors import BackendError
from chronoscene.synth import generate, preset
from chronoscene.synth.render.renderer import load_open3d


def test_without_open3d_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load_open3d.cache_clear()
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(BackendError, match=r"pip install 'chronoscene\[synth\]'"):
        generate(tmp_path / "out", preset("tiny"))
    assert not list(tmp_path.iterdir())
