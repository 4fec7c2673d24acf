"""Folders of results that appear whole or not at all."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from chronoscene.errors import DiskFullError
from chronoscene.registration import output


def test_a_copy_to_a_full_disk_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: str, target: str) -> None:
        Path(target).touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "staged").mkdir()
    (tmp_path / "staged/a.txt").touch()
    monkeypatch.setattr(shutil, "copy2", full)
    with pytest.raises(DiskFullError, match="out: expected space"):
        output._copy(tmp_path / "staged", tmp_path / ".out.partial", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["staged"]
