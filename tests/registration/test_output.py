"""Folders of results that appear whole or not at all."""

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from chronoscene.errors import DiskFullError
from chronoscene.formats import read_scene
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


def test_records_that_lead_out_of_the_scene_are_left_out(
    make_scene_folder: Callable[..., Path], tmp_path: Path
) -> None:
    folder, out = make_scene_folder(), tmp_path / "out"
    out.mkdir()
    (tmp_path / "secret").write_text("{}")
    (folder / output.CERTIFICATE).symlink_to(tmp_path / "secret")
    (folder / "frame.json").write_text("{}")
    (folder / output.GEOREFERENCE).symlink_to("frame.json")
    assert output.copy_records(read_scene(folder), out) == (output.GEOREFERENCE,)
    (copy,) = out.iterdir()
    assert copy.read_text() == "{}" and not copy.is_symlink()


def test_a_certificate_is_about_the_periods_of_the_scene_itself(
    make_scene_folder: Callable[..., Path], tmp_path: Path
) -> None:
    folder = make_scene_folder()
    (folder / output.CERTIFICATE).touch()
    scene = read_scene(folder)
    assert not output.copy_records(replace(scene, format="colmap-folders"), tmp_path)
    assert not output.copy_records(scene, tmp_path, certificate=False)
    assert output.copy_records(scene, tmp_path) == (output.CERTIFICATE,)
