"""Hashes change with what they name and with nothing else; the commit is that of this code."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fresh_process import run_python

import chronoscene
from chronoscene.errors import ImageError
from chronoscene.formats import read_scene
from chronoscene.harness.files import provenance


@pytest.fixture
def scene(scene_folder, tmp_path):
    return read_scene(shutil.copytree(scene_folder, tmp_path / "ring"))


def test_a_copy_has_the_same_hash(scene, scene_folder):
    assert provenance.scene_hash(scene) == provenance.scene_hash(read_scene(scene_folder))
    assert re.fullmatch("[0-9a-f]{64}", provenance.scene_hash(scene))


@pytest.mark.parametrize("field", ["period", "split", "cam_from_world", "camera"])
def test_changes_of_a_frame_change_the_hash(scene, field):
    frame = scene.frames[0]
    pose = frame.cam_from_world.copy()
    pose[0, 3] += 1e-6
    values = {
        "period": 1,
        "split": "test",
        "cam_from_world": pose,
        "camera": replace(frame.camera, params=(20.0, 21.0, 11.5, 8.26)),
    }
    changed = scene.with_frames([replace(frame, **{field: values[field]}), *scene.frames[1:]])
    assert provenance.scene_hash(changed) != provenance.scene_hash(scene)


@pytest.mark.parametrize(
    ("field", "at", "change"),
    [("xyz", (0, 0), 1e-3), ("rgb", (0, 0), 1), ("track_start", 1, -1), ("track_frame", 0, 1)],
)
def test_changes_of_points_change_the_hash(scene, field, at, change):
    values = getattr(scene.points, field).copy()
    values[at] += change
    changed = replace(scene, points=replace(scene.points, **{field: values}))
    assert provenance.scene_hash(changed) != provenance.scene_hash(scene)


def test_changes_of_pixels_change_the_hash(scene):
    before = provenance.scene_hash(scene)
    path = scene.image_path(scene.frames[0])
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert provenance.scene_hash(scene) != before


def test_stamps_need_no_content(scene, monkeypatch):
    before = provenance.scene_stamp(scene)
    monkeypatch.setattr(Path, "open", None)
    monkeypatch.setattr(provenance, "sha256_of", None)
    assert provenance.scene_stamp(scene) == before
    os.utime(scene.image_path(scene.frames[0]), (1, 1))
    assert provenance.scene_stamp(scene) != before


def test_masks_change_the_hash(scene, tmp_path):
    before, mask = provenance.scene_hash(scene), tmp_path / "mask.png"
    mask.write_bytes(b"one")
    masked = replace(scene, masks={scene.frames[0].name: mask})
    hashes = {before, provenance.scene_hash(masked)}
    mask.write_bytes(b"two")
    hashes |= {provenance.scene_hash(masked)}
    hashes |= {provenance.scene_hash(replace(scene, masks={scene.frames[1].name: mask}))}
    assert len(hashes) == 4


def test_the_last_digit_of_a_pose_does_not_count(scene):
    frame = scene.frames[0]
    pose = np.nextafter(frame.cam_from_world, 10.0)
    changed = scene.with_frames([replace(frame, cam_from_world=pose), *scene.frames[1:]])
    assert provenance.scene_hash(changed) == provenance.scene_hash(scene)


def test_a_missing_image_is_named(scene):
    scene.image_path(scene.frames[0]).unlink()
    with pytest.raises(ImageError, match=r"a/0\.png: expected an image, found No such file"):
        provenance.scene_hash(scene)


def test_config_hashes_ignore_the_order_of_keys():
    assert provenance.config_hash({"a": 1, "b": [2]}) == provenance.config_hash({"b": [2], "a": 1})
    assert provenance.config_hash({"a": 1}) != provenance.config_hash({"a": 2})


def git(folder, *arguments):
    command = ["git", "-C", str(folder), "-c", "user.name=t", "-c", "user.email=t@t", *arguments]
    subprocess.run(command, check=True, capture_output=True)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package inside a repository of someone, which may or may not track it."""
    package = tmp_path / "repository" / "chronoscene"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package.parent / "other.txt").write_text("")
    git(package.parent, "init", "-q")
    monkeypatch.setattr(chronoscene, "__file__", str(package / "__init__.py"))
    return package


def test_the_commit_with_a_mark_for_changes(package):
    git(package.parent, "add", ".")
    git(package.parent, "commit", "-q", "-m", "first")
    assert re.fullmatch("[0-9a-f]{40}", provenance.code_version())
    (package / "__init__.py").write_text("changed = 1\n")
    assert re.fullmatch("[0-9a-f]{40}-dirty", provenance.code_version())


def test_the_commit_of_another_repository_is_not_ours(package):
    git(package.parent, "add", "other.txt")
    git(package.parent, "commit", "-q", "-m", "first")
    assert provenance.code_version() == f"version {chronoscene.__version__}"


def test_versions_and_machine():
    assert provenance.method_version("chronogs").startswith("chronoscene ")
    assert provenance.method_version("toy_methods:MEAN") == "unpackaged"
    assert {"python", "numpy", "torch"} <= provenance.library_versions().keys()
    assert provenance.describe_device("cpu", 1).endswith(", 1 thread)")
    assert provenance.processor_name()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_peak_memory_follows_allocations():
    """In a process of its own: what other tests took here is part of the peak."""
    code = (
        "import numpy as np; from chronoscene.harness.files.provenance import peak_memory_bytes; "
        "before = peak_memory_bytes(); block = np.ones(before + 200_000_000, np.uint8); "
        "print(peak_memory_bytes() - before)"
    )
    assert int(run_python(code)) > 150_000_000


def test_a_system_whose_memory_is_unknown(monkeypatch):
    monkeypatch.setattr(provenance, "Path", lambda place: Path("/absent"))
    monkeypatch.setitem(sys.modules, "resource", None)
    assert provenance.peak_memory_bytes() is None
