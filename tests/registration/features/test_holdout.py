"""The copy of a database without the tracks that are held out."""

import errno
from pathlib import Path

import numpy as np
import pytest

from chronoscene.errors import DiskFullError
from chronoscene.registration.features import holdout


def test_a_full_disk_leaves_no_journals(tmp_path, monkeypatch):
    def full(source: Path, target: Path) -> None:
        for suffix in ("", "-wal", "-shm"):
            Path(f"{target}{suffix}").touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(holdout, "_copy_database", full)
    nothing = np.zeros(0, np.int64)
    tracks = holdout.Tracks(nothing, nothing, nothing, {}, nothing)
    with pytest.raises(DiskFullError):
        holdout._filtered_copy(tmp_path / "a.db", tmp_path / "b.db", tracks, nothing)
    assert not list(tmp_path.iterdir())
