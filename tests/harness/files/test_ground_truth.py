"""The test photos of a scene, frozen in the folder of runs."""

import os
import shutil
from pathlib import Path

from chronoscene.harness.files.ground_truth import freeze_ground_truth, ground_truth_folder
from chronoscene.io.staging import partial_name


def test_what_a_killed_bench_left_of_it_is_removed(make_scene, tmp_path):
    scene, runs = make_scene(name="ring [1]"), tmp_path / "runs"
    folder = ground_truth_folder(runs, scene.name)
    ended = partial_name(folder.name).replace(f".{os.getpid()}.", f".{2**22 + 1}.")
    folder.with_name(ended).mkdir(parents=True)
    freeze_ground_truth(runs, scene, "hash", 1600)
    assert list(folder.parent.iterdir()) == [folder]


def test_another_bench_may_have_written_it_a_moment_before(make_scene, tmp_path, monkeypatch):
    scene, replace = make_scene(), os.replace

    def later(source, target):
        if Path(source).is_dir():
            shutil.copytree(source, target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", later)
    manifest = freeze_ground_truth(tmp_path / "runs", scene, "hash", 1600)
    assert len(manifest.images) == 3
    folder = ground_truth_folder(tmp_path / "runs", scene.name)
    assert list(folder.parent.iterdir()) == [folder]
