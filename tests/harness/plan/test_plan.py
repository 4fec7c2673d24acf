"""Plans: whose overrides they are, and what a run differs in."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from chronoscene import methods
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene
from chronoscene.harness.plan import plan as planning
from chronoscene.harness.plan import resolve
from chronoscene.harness.plan.finished import first_difference
from chronoscene.harness.plan.plan import plan_runs
from chronoscene.harness.plan.resolve import overrides_of
from chronoscene.harness.plan.settings import RunSettings, bench_settings
from chronoscene.harness.use.trained_run import open_run
from chronoscene.scene import Points


def test_differences_are_named():
    old = {"config": {"a": 1, "b": {"c": 2}}, "seed": 0}
    new = {"config": {"a": 1, "b": {"c": 3}}, "seed": 0}
    assert first_difference(old, new) == ("c 2", "c 3")


def test_overrides_with_a_prefix_are_for_one_method(tmp_path):
    settings = RunSettings(tmp_path, overrides={"blind.rate": "1", "rate": "2"})
    assert overrides_of(settings.overrides, "mean") == {"rate": "2"}
    assert overrides_of(settings.overrides, "blind") == {"rate": "1"}


def test_numbers_of_numpy_are_taken_as_those_of_python(scene_folder, tmp_path):
    numbers = {"seeds": tuple(np.arange(2)), "iterations": np.int64(3), "max_width": np.int32(24)}
    numbers["budget_seconds"] = np.float32(1.5)
    settings = bench_settings((scene_folder,), ("toy_methods:MEAN",), tmp_path / "runs", **numbers)
    runs = plan_runs(settings, lambda line: None).runs
    assert [folder.name for folder in runs] == ["seed0", "seed1"]
    documents = [json.loads(json.dumps(run.job.document())) for run in runs.values()]
    assert [document["seed"] for document in documents] == [0, 1]


def test_planning_builds_each_configuration_once(scene_folder, tmp_path, monkeypatch):
    """That of the preset and that with overrides of each method, whatever the number of runs."""
    built = []

    def build_config(spec, **options):
        built.append(spec.name)
        return methods.build_config(spec, **options)

    monkeypatch.setattr(resolve, "build_config", build_config)
    names = ("toy_methods:MEAN", "toy_methods:BLIND")
    settings = bench_settings((scene_folder,), names, tmp_path / "runs", seeds=(0, 1))
    assert len(plan_runs(settings, lambda line: None).runs) == 4
    assert sorted(built) == ["blind", "blind", "mean", "mean"]


def test_a_bench_on_a_gpu_begins_with_what_each_method_takes_of_its_memory(
    scene_folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(planning, "check_device", lambda device, gsplat: None)
    for device, expected in (("cuda", ["chronogs", "3dgs"]), ("cpu", []), ("auto", [])):
        settings = bench_settings(
            (scene_folder,), ("chronogs", "3dgs"), tmp_path / device, seeds=(0, 1), device=device
        )
        said = []
        plan_runs(settings, said.append)
        assert [line.split()[1] for line in said if " of the GPU with " in line] == expected


def test_one_view_to_a_step_is_what_earlier_versions_did(scene_folder, tmp_path):
    """Their runs, whose settings do not name the option, are neither trained again nor others."""
    documents = []
    for number in (1, 2):
        settings = bench_settings(
            (scene_folder,), ("3dgs",), tmp_path, overrides={"views_per_step": str(number)}
        )
        (run,) = plan_runs(settings, lambda line: None).runs.values()
        documents.append((run.document["config"]["method_config"], run.job.variant))
    (first, plain), (second, variant) = documents
    assert "views_per_step" not in first and plain == ""
    assert second == {**first, "views_per_step": 2} and variant == "views_per_step=2"


def test_a_scene_without_points_is_refused_before_anything_starts(scene_folder, tmp_path):
    bare = replace(read_scene(scene_folder), points=Points.empty())
    our_format.write(bare, tmp_path / "bare")
    settings = bench_settings((tmp_path / "bare",), ("toy_methods:MEAN",), tmp_path / "runs")
    with pytest.raises(SceneError, match="found none; triangulate some: chronoscene triangulate"):
        plan_runs(settings, lambda line: None)


def test_periods_that_the_user_names_hold_for_the_whole_run(
    bench_here, scene_folder, tmp_path, monkeypatch
):
    """For the planning, the training, and whoever opens the run from another folder."""
    folder = tmp_path / "project"
    shutil.copytree(scene_folder, folder)
    (folder / "sparse/split.txt").unlink()
    rows = [f"{name}/{i}.png,{i // 2}" for name in "ab" for i in range(4)]
    (tmp_path / "periods.csv").write_text("\n".join(["file,period", *rows]))
    monkeypatch.chdir(tmp_path)
    outcome, _ = bench_here("toy_methods:MEAN", scenes=(folder,), period_by="table:periods.csv")
    monkeypatch.chdir("/")
    run = open_run(*outcome.finished, plugin="toy_methods:MEAN")
    assert [frame.period for frame in run.scene().frames] == [0, 0, 1, 1] * 2
