"""``chronoscene study`` from the outside: a study file, the table, the files."""

import json
from types import SimpleNamespace

from command_line import invoke

from .test_bench import IMAGES, TESTS, chronoscene

STUDY = """
title = "Rates"
question = "Which rate is better?"
method = "toy_methods:MEAN"

[[rows]]
label = "slow"
set = { rate = 0.01 }

[[rows]]
label = "fast"
set = { rate = 0.5 }
"""


def test_a_study_of_ones_own(make_scene_folder, tmp_path, runs_here):
    scene = make_scene_folder(IMAGES, tests=TESTS, name="place")
    file, runs = tmp_path / "rates.toml", tmp_path / "runs"
    file.write_text(STUDY)
    call = ("study", file, scene, "--iterations", 12, "--threads", 1, "--out", runs)
    done = chronoscene(*call)
    assert done.exit_code == 0, done.stderr
    assert "Which rate is better?" in done.stdout
    assert "published" not in done.stdout
    assert "2 of 2 runs are finished and kept" in (again := chronoscene(*call)).stderr
    assert again.stdout == done.stdout
    rows = {e["row"] for e in json.loads((runs / "study-rates.json").read_text())["entries"]}
    assert rows == {"slow", "fast"}
    assert "| place | fast |" in (runs / "study-rates.md").read_text()
    assert (runs / "study-rates.csv").read_text().startswith("row,source,scene,")


def test_budget_width_and_memory_are_options(make_scene_folder, tmp_path, monkeypatch):
    asked = []

    def run(study, settings, log):
        asked.append(settings.run)
        return SimpleNamespace(finished=[], failures=[]), {}

    monkeypatch.setattr("chronoscene.cli.runs.study.run_study", run)
    (tmp_path / "rates.toml").write_text(STUDY)
    scene = make_scene_folder(IMAGES)
    options = ("--budget", "1m", "--max-width", 320, "--photo-memory", 0.5)
    invoke("study", tmp_path / "rates.toml", scene, *options)
    found = [(run.budget_seconds, run.max_width, run.photo_memory) for run in asked]
    assert found == [(60.0, 320, 500_000_000)]


def test_mistakes_are_one_line(make_scene_folder, tmp_path):
    scene, file = make_scene_folder(IMAGES, name="place"), tmp_path / "rates.toml"
    file.write_text(STUDY.replace("label", "name"))
    shipped = "base-length, cl-splats-released, clnerf-released, comp"
    for name, text in ((file, "Field required (rows.0.label)"), ("parts", shipped)):
        done = chronoscene("study", name, scene, "--out", tmp_path / "runs")
        assert done.exit_code == 2 and done.stderr.count("\n") == 1
        assert text in done.stderr
