"""Searches: repeatable, resumable, and blind to test views."""

import csv
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from training_here import execute_here

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.tune.report import best_of
from chronoscene.harness.tune.search import tune
from chronoscene.methods import build_config, load_spec

pytest.importorskip("optuna")


@pytest.fixture
def lines():
    """Collect the lines that searches print."""
    return []


@pytest.fixture
def search(scene_folder, tmp_path, monkeypatch, lines):
    """Search in this process; returns the results."""
    monkeypatch.setattr("chronoscene.harness.train.worker.warm_up", lambda *args, **options: None)

    def run(
        out, trials=3, *, splits=1, execute=execute_here, method="toy_methods:TUNED", **changes
    ):
        fields = {"scenes": (scene_folder,), "methods": (method,), "runs": tmp_path / out}
        fields |= {"threads": 1, **changes}
        settings = bench_settings(**fields)
        return tune(settings, trials, lines.append, splits=splits, execute=execute)

    return run


def untimed(results):
    return [replace(result, seconds=0.0) for result in results]


def broken_copy(scene, folder):
    """The scene with test photos that nobody can decode."""
    shutil.copytree(scene, folder)
    for name in ("a/2.png", "b/1.png", "b/2.png"):
        (folder / "images" / name).write_bytes(b"no image")
    return folder


def test_equal_seeds_give_equal_trials_whatever_the_test_photos(search, scene_folder, tmp_path):
    first = search("first", 5)
    assert untimed(search("again", 5)) == untimed(first)
    blind = broken_copy(scene_folder, tmp_path / "broken/ring")
    assert untimed(search("blind", 5, scenes=(blind,))) == untimed(first)
    assert len({str(result.options) for result in first}) == 5
    other = search("other", 5, seeds=(1,))
    assert [r.options for r in other][1:] != [r.options for r in first][1:]


def test_a_method_of_the_package(search):
    options = {"method": "3dgs", "preset": "fast", "iterations": 4}
    first = search("first", **options)
    assert untimed(search("again", **options)) == untimed(first)
    assert [r.number for r in first if r.psnr is not None] == [0, 1, 2]


@pytest.mark.parametrize("failing", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_an_interrupted_search_goes_on_where_it_was(search, failing):
    """Before, and after, the run of a trial has its result."""
    whole = search("whole", 14)
    for after in (False, True):
        calls, out = [], f"interrupted-{after}"

        def interrupted(job, calls=calls, after=after):
            calls.append(job)
            failure = execute_here(job) if after or len(calls) != failing else None
            if len(calls) == failing:
                raise KeyboardInterrupt
            return failure

        with pytest.raises(KeyboardInterrupt):
            search(out, 14, execute=interrupted)
        search(out, 12)
        assert untimed(search(out, 14)) == untimed(whole)


def test_no_more_trials_than_asked_for_go_on(search):
    def interrupted(job):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search("out", 6, execute=interrupted, jobs=2)
    assert [result.number for result in search("out", 1)] == [0]
    assert [result.number for result in search("out", 3)] == [0, 1, 2]


def test_the_first_trial_is_the_preset_and_the_best_one_becomes_a_preset(
    search, bench_here, tmp_path
):
    results = search("out", 4)
    spec = load_spec("toy_methods:TUNED")
    start = build_config(spec, preset="balanced")
    assert results[0].options == {name: getattr(start, name) for name in spec.search}
    best, path = best_of(results), tmp_path / "out/preset.toml"
    assert best.psnr == max(result.psnr for result in results)
    written = tomllib.loads(path.read_text())
    assert written["base"] == "balanced" and written["method"] == "tuned"
    assert written["options"] == {
        name: value for name, value in best.options.items() if value != getattr(start, name)
    }
    tuning = written["tuning"]
    assert tuning["trials"] == 4 and tuning["failed"] == 0 and tuning["best_trial"] == best.number
    assert [scene["name"] for scene in tuning["scenes"]] == ["ring"]
    assert (tuning["validation_psnr"], tuning["validation_ssim"]) == (best.psnr, best.ssim)

    (folder,) = bench_here("toy_methods:TUNED", preset=str(path), validation=True)[0].finished
    assert folder.parent.name == "tuned-joint-preset-validation=true"
    macro = read_run(folder).aggregates["macro"]
    assert (macro["psnr"], macro["ssim"]) == (best.psnr, best.ssim)
    (again,) = bench_here("toy_methods:TUNED", preset=str(path), validation=True)[0].finished
    assert again == folder

    rows = list(csv.DictReader((tmp_path / "out/trials.csv").open()))
    assert [float(row["psnr"]) for row in rows] == [result.psnr for result in results]
    assert [float(row["ssim"]) for row in rows] == [result.ssim for result in results]
    kept = {p.name for p in (tmp_path / "out/trials").rglob("*") if p.is_file()}
    assert {"run.json", "results.json"} <= kept and not any("png" in name for name in kept)


def test_the_score_of_several_choices_of_views_is_their_mean(search, bench_here, tmp_path, lines):
    results = search("out", 3, splits=2)
    assert "ring: 2 of 5 training views are held back" in lines
    preset = tmp_path / "out/preset.toml"
    assert tomllib.loads(preset.read_text())["tuning"]["splits"] == 2
    macros = []
    for seed in range(2):
        options = {"preset": str(preset), "validation": True, "validation_seed": seed}
        outcome = bench_here("toy_methods:TUNED", runs=tmp_path / str(seed), **options)[0]
        macros.append(read_run(outcome.finished[0]).aggregates["macro"])
    assert macros[0] != macros[1]
    for name in ("psnr", "ssim"):
        assert getattr(best_of(results), name) == sum(macro[name] for macro in macros) / 2
    kept = [p.name for p in (tmp_path / "out/trials").rglob("*") if p.is_file()]
    assert kept.count("run.json") == 6 and not any("png" in name for name in kept)
    assert search("out", 3, splits=2) == results
    with pytest.raises(ConfigError, match="a search with splits 3, found one with splits 2"):
        search("out", 4, splits=3)


def test_failed_trials_count(search, tmp_path, lines):
    def failing(job):
        return job.failure("too bad") if "001" in str(job.folder) else execute_here(job)

    results = search("out", execute=failing)
    assert [result.failure for result in results] == ["", "too bad", ""]
    assert results[1].psnr is None and results[1].ssim is None
    assert best_of(results) is not results[1]
    assert f"trial 1 failed: too bad, in {tmp_path / 'out/trials/001'}" in lines
    assert search("out") == results
    with pytest.raises(ConfigError, match=r"expected a trial with a result, found none.*too bad"):
        search("none", 2, execute=lambda job: job.failure("too bad"))


def test_options_that_the_method_refuses_are_a_failed_trial(search, tmp_path):
    results = search("out", 8, method="toy_methods:EVEN")
    assert [result.number for result in results] == [*range(8)]
    odd = [result for result in results if result.options["ballast"] % 2]
    assert odd and odd == [result for result in results if result.failure]
    assert odd[0].failure.startswith("ballast: expected even, found ")
    rows = list(csv.DictReader((tmp_path / "out/trials.csv").open()))
    assert [row["failure"] for row in rows] == [result.failure for result in results]
    assert search("out", 8, method="toy_methods:EVEN") == results


def test_options_without_effect_in_the_preset_are_not_searched(search, lines):
    results = search("out", 4, method="toy_methods:IDLE")
    assert not any(result.failure for result in results)
    assert [*results[0].options] == ["rate", "sleep"]
    assert "ballast is not searched: it has no effect without a keel" in lines


def test_a_search_ends_where_the_method_refuses_everything(search, tmp_path):
    for trials in (22, 42):
        with pytest.raises(ConfigError, match=r"found 20 refusals in a row; .* expected none"):
            search("out", 99, method="toy_methods:NONE")
        assert len((tmp_path / "out/trials.csv").read_text().splitlines()) == trials


def test_views_that_masks_ignore_have_no_score(search, scene_folder, tmp_path):
    masked = Path(shutil.copytree(scene_folder, tmp_path / "masked"))
    for name in ("a/0.png", "b/3.png"):  # the validation views
        mask = masked / f"masks/{name}.png"
        mask.parent.mkdir(parents=True)
        Image.new("L", (24, 16)).save(mask)
    with pytest.raises(ConfigError, match=r"ended so: masked: the masks of all test views ignore"):
        search("out", 2, scenes=(masked,))
    with pytest.raises(ConfigError, match=r"ended so: masked: the masks of all test views ignore"):
        search("two", 2, scenes=(scene_folder, masked))


@pytest.mark.parametrize("name", ["photos", "ground_truth"])
def test_records_are_kept_whatever_the_name_of_the_scene(search, scene_folder, tmp_path, name):
    scene = Path(shutil.copytree(scene_folder, tmp_path / name))
    search("out", 2, scenes=(scene,), photo_memory=20_000)
    kept = [p.name for p in (tmp_path / "out/trials").rglob("*") if p.is_file()]
    assert kept.count("run.json") == 2
    assert not any(part in name for name in kept for part in ("png", "npz"))


def test_the_length_of_the_trials_is_not_that_of_what_is_found(search, tmp_path):
    file = tmp_path / "long.toml"
    file.write_text('method = "tuned"\nbase = "balanced"\n[options]\niterations = 33\n')
    search("out", 2, preset=str(file), iterations=5)
    written = tomllib.loads((tmp_path / "out/preset.toml").read_text())
    assert written["options"]["iterations"] == 33 and written["tuning"]["iterations"] == 5
    search("named", 2, iterations=5)
    written = tomllib.loads((tmp_path / "named/preset.toml").read_text())
    assert "iterations" not in written["options"]


@pytest.mark.slow
def test_several_trials_at_a_time(search):
    results = search("out", 3, execute=None, jobs=2)
    assert [result.number for result in results] == [0, 1, 2]
    assert not any(result.failure for result in results)


def test_another_search_in_the_same_folder_is_refused(search, scene_folder, tmp_path):
    search("out", 1)
    for changes, found in (
        ({"seeds": (1,)}, "a search with seed 1, found one with seed 0"),
        ({"iterations": 7}, "a search with iterations 7, found one with iterations 20"),
        ({"method": "3dgs"}, "a search with method 3dgs, found one with method tuned"),
    ):
        with pytest.raises(ConfigError, match=found):
            search("out", 2, **changes)


def test_what_is_missing_is_said(search, monkeypatch):
    advice = r'space, found none; add a search to its MethodSpec, such as search={"OPTION": Range\('
    with pytest.raises(ConfigError, match=advice):
        search("out", method="toy_methods:MEAN")
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"the package optuna.*install 'chronoscene"):
        search("out")
