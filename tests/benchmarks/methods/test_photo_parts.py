"""Pictures of what a run of NeRF-W makes of its photos."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.methods import photo_parts


def test_a_photo_that_is_no_training_image_is_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    frames = [SimpleNamespace(name="2016/b.jpg"), SimpleNamespace(name="2016/a.jpg")]
    run = SimpleNamespace(scene=lambda: SimpleNamespace(select=lambda split: frames))
    monkeypatch.setattr(photo_parts, "open_run", lambda path: run)
    monkeypatch.setattr(sys, "argv", ["photo_parts", "run", str(tmp_path / "out.webp"), "c.jpg"])
    with pytest.raises(SystemExit, match="2"):
        photo_parts.main()
    message = capsys.readouterr().err
    assert "expected the name of a training image, such as 2016/a.jpg, found c.jpg" in message


def test_a_folder_without_a_run_is_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", ["photo_parts", str(tmp_path), "out.webp", "c.jpg"])
    with pytest.raises(SystemExit, match="2"):
        photo_parts.main()
    assert str(tmp_path) in capsys.readouterr().err
