"""Two checkouts beside each other: each process runs the code of its own folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.training.versions import compare

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_each_version_runs_its_own_code(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asked = {"method": "3dgs", "points": 300, "size": (32, 24), "threads": 1, "scene": None}
    compare((ROOT, ROOT), asked, 5)
    method, points, threads, *times = capfd.readouterr().out.split()
    assert (method, points, threads) == ("3dgs", "300", "1")
    assert len(times) == 6 and all(float(value) > 0 for value in times)
    (tmp_path / "chronoscene").mkdir()
    (tmp_path / "chronoscene" / "__init__.py").write_text("raise SystemExit('another version')\n")
    with pytest.raises(SystemExit, match="ended early"):
        compare((tmp_path, ROOT), asked, 5)
    assert "another version" in capfd.readouterr().err
