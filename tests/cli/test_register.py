"""The command register: messages and exit status; tests/registration has the work itself."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from chronoscene.cli import cli as main
from chronoscene.cli import register
from chronoscene.errors import ChronoSceneError, ConfigError


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["register", *map(str, arguments)])


def photos(folder: Path, count: int) -> Path:
    """Grey photos, all different."""
    folder.mkdir(parents=True)
    for i in range(count):
        Image.fromarray(np.full((480, 640, 3), 10 * i, np.uint8)).save(folder / f"{i}.jpg")
    return folder


@pytest.mark.parametrize(("level", "status"), [("pass", 0), ("doubtful", 0), ("fail", 1)])
def test_the_verdict_decides_on_the_exit_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, level: str, status: int
) -> None:
    def run(*inputs: Any, inspected: Any, **options: Any) -> Any:
        verdict = SimpleNamespace(level=level)
        inspected(SimpleNamespace(verdict=verdict, summary=f"verdict: {level}\n"))
        return SimpleNamespace(
            route="joint",
            unit="metre",
            labels=("a", "b"),
            periods=np.array([0, 0, 1]),
            unregistered_periods={"b/1.jpg": 1},
            unregistered={"b/1.jpg": "no matches"},
            points=np.zeros((5, 3)),
        )

    photos(tmp_path / "in/a", 2)
    photos(tmp_path / "in/b", 2)
    monkeypatch.setattr(register, "run", run)
    done = call(tmp_path / "in", tmp_path / "out")
    assert done.exit_code == status, done.output
    assert "period 1 (b): 1 of 2 photos registered" in done.output
    assert "b/1.jpg: no matches" in done.output and f"verdict: {level}" in done.output


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_photos_end_in_one_message(tmp_path: Path, count: int) -> None:
    photos(tmp_path / "in/a", count)
    done = call(tmp_path / "in", tmp_path / "out")
    assert isinstance(done.exception, ChronoSceneError), done.output
    assert not (tmp_path / "out").exists()


def test_the_scene_does_not_go_into_the_photos(tmp_path: Path) -> None:
    photos(tmp_path / "in/a", 3)
    done = call(tmp_path / "in", tmp_path / "in/out")
    assert isinstance(done.exception, ConfigError)
    assert not (tmp_path / "in/out").exists()
