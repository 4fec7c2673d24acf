"""The test photos of a scene, frozen in the folder of runs."""

import os

from chronoscene.harness.files.ground_truth import freeze_ground_truth, ground_truth_folder
from chronoscene.io.staging import partial_name


def test_what_a_killed_bench_left_of_it_is_removed(make_scene, tmp_path):
    scene, runs = make_scene(name="ring [1]"), tmp_path / "runs"
    folder = ground_truth_folder(runs, scene.name)
    ended = partial_name(folder.name).replace(f".{os.getpid()}.", f".{2**22 + 1}.")
    folder.with_name(ended).mkdir(parents=True)
    freeze_ground_truth(runs, scene, "hash", 1600)
    assert list(folder.parent.iterdir()) == [folder]
