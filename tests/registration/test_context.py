"""Options of a registration, as its log keeps them."""

from pathlib import Path

import pytest

from chronoscene.registration.context import Options


def test_paths_in_the_log_hold_in_other_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record = Options(tie_points=Path("points.csv"), seed=3).record()
    assert record["tie_points"] == str(tmp_path / "points.csv")
    assert record["seed"] == 3 and "cameras" not in record
