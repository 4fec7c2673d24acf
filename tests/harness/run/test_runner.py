"""Whole benches: what is written, what is kept, what survives failures, kills and edits."""

import csv
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from filelock import FileLock

from chronoscene.errors import ConfigError, DiskFullError, MetricUnavailableError, SceneError
from chronoscene.harness.files import records
from chronoscene.harness.files.predictions import read_manifest
from chronoscene.harness.files.records import read_rows, read_run, run_folders
from chronoscene.harness.report.figures.comparison import draw_figures
from chronoscene.harness.report.summary import read_runs
from chronoscene.harness.report.tables import format_runs
from chronoscene.harness.run import runner
from chronoscene.harness.score.scoring import rescore
from chronoscene.harness.use.trained_run import open_run
from chronoscene.methods import load_spec
from chronoscene.metrics.registry import make_scorers

FIELDS = {
    "method",
    "strategy",
    "scene",
    "seed",
    "aggregates",
    "periods",
    "seconds",
    "iterations",
    "primitives",
    "checkpoint_bytes",
    "peak_memory_bytes",
    "device",
    "commit",
    "skipped",
}


def names(runs):
    return [str(p.relative_to(runs)) for p in run_folders(runs)]


def test_runs_lie_where_they_should(finished_bench):
    runs = finished_bench[0]
    assert names(runs) == [
        "ring/blind-pooled-balanced/seed0",
        "ring/mean-joint-balanced/seed0",
        "ring/mean-pooled-balanced/seed0",
        "ring/mean-separate-balanced/seed0",
    ]
    folder = runs / "ring/mean-joint-balanced/seed0"
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    assert files == [
        "checkpoint/model.json",
        "config.json",
        "curve.csv",
        "predictions/a/2.png.png",
        "predictions/b/1.png.png",
        "predictions/b/2.png.png",
        "predictions/manifest.json",
        "rows.csv",
        "run.json",
        "source.json",
    ]
    separate = runs / "ring/mean-separate-balanced/seed0/checkpoint"
    assert sorted(p.name for p in separate.iterdir()) == ["period-0", "period-1"]
    assert not [p for p in runs.rglob("*") if "partial" in p.name]


def test_results_are_one_list_with_the_agreed_fields(finished_bench):
    runs = finished_bench[0]
    found = json.loads((runs / "results.json").read_text())
    assert len(found) == 4
    for run in found:
        assert run.keys() >= FIELDS
        assert set(run["aggregates"]) == {"macro", "micro", "worst"}
        assert set(run["periods"]) == {"0", "1"}
        assert run["peak_memory_bytes"] > 50e6 and run["seconds"] > 0
        assert run["device"].startswith("cpu (") and "1 thread)" in run["device"]
        assert set(run["skipped"]) >= {"lpips_vgg"} or "lpips_vgg" in run["aggregates"]["macro"]


def test_strategies_show_in_the_numbers(finished_bench):
    runs = finished_bench[0]
    by_name = {p.parent.name: read_run(p) for p in run_folders(runs)}
    told, pooled = by_name["mean-joint-balanced"], by_name["mean-pooled-balanced"]
    separate, blind = by_name["mean-separate-balanced"], by_name["blind-pooled-balanced"]
    # Noise of at most 9 grey values around each period's colour: 33.7 dB; the mean of both colours
    # is some 60 grey values away.
    assert told.aggregates["worst"]["psnr"] > 33 and separate.aggregates["worst"]["psnr"] > 33
    assert pooled.aggregates["macro"]["psnr"] < 15
    assert blind.aggregates == pooled.aggregates
    assert told.primitives == separate.primitives == 2 and pooled.primitives == 1
    assert told.iterations == separate.iterations == 20
    assert blind.notices == ["blind takes no period: joint is run and recorded as pooled"]


def test_a_method_has_its_own_strategy_unless_another_is_asked_for(bench_here):
    own, _ = bench_here("MEAN", "CONTINUAL", iterations=4)
    asked, _ = bench_here("MEAN", "CONTINUAL", iterations=4, strategies=("pooled", "joint"))
    strategies = [[read_run(folder).strategy for folder in made.finished] for made in (own, asked)]
    assert strategies == [["joint", "sequential"], ["pooled", "joint", "pooled", "joint"]]


def test_half_of_each_photo_gives_the_appearance_and_the_other_is_scored(bench_here, tmp_path):
    whole, _ = bench_here("MEAN", iterations=4)
    half, _ = bench_here("MEAN", iterations=4, fit_half=True)
    (folder,) = half.finished
    assert folder.parent.name == "mean-joint-balanced-iterations=4,fit_half=true"
    run = read_run(folder)
    assert run.fitted == "left half"
    assert run.aggregates["macro"]["psnr"] > read_run(whole.finished[0]).aggregates["macro"]["psnr"]
    assert not any(again.changes for again in rescore(tmp_path / "runs", make_scorers()))
    for view in open_run(folder, plugin="toy_methods:MEAN").test_views():
        assert view.mask[:, 12:].all() and not view.mask[:, :12].any()
    with pytest.raises(ConfigError, match="fixed --fit-half: expected a method whose appearance"):
        bench_here("FIXED", fit_half=True)


def test_failures_stop_nobody_else(finished_bench):
    runs, outcome, said = finished_bench
    assert len(outcome.finished) == 2
    reasons = {f.method: f.reason for f in outcome.failures}
    assert reasons["raises"] == "RuntimeError: the toy is broken (see error.log)"
    assert "iteration 55: expected a finite loss and finite" in reasons["not-finite"]
    kept = runs / "ring/not-finite-joint-balanced/seed0/checkpoint/model.json"
    assert np.isfinite(json.loads(kept.read_text())["colors"]).all()
    assert reasons["killed"] == "the process ended with signal SIGKILL (out of memory?)"
    trace = runs / "ring/raises-joint-balanced/seed0/error.log"
    assert "the toy is broken" in trace.read_text()
    assert any(line.endswith(f"seed 0: {trace}") for line in said)
    assert any("blind takes no period" in line for line in said)
    assert len(records.read_failures(runs)) == 3


def test_rows_hold_every_view_and_metric(finished_bench):
    runs = finished_bench[0]
    with (runs / "rows.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    metrics = {"psnr", "ssim", "ssim_valid"}
    for folder in run_folders(runs):
        record, rows = read_run(folder), read_rows(folder)
        views = [e.view for e in read_manifest(folder / "predictions").images]
        assert {(r.view, r.metric) for r in rows} >= {(v, m) for v in views for m in metrics}
        mine = [line for line in lines if line["config_hash"] == record.config_hash]
        assert len(mine) == len(rows)
        assert {line["scene_hash"] for line in mine} == {record.scene_hash}
        assert [float(line["value"]) for line in mine] == [row.value for row in rows]


def test_curves_belong_to_models(finished_bench):
    path = finished_bench[0] / "ring/mean-separate-balanced/seed0/curve.csv"
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert list(lines[0]) == ["seconds", "iteration", "primitives", "psnr", "parameters", "model"]
    assert {line["model"] for line in lines} == {"period-0", "period-1"}
    assert max(int(line["iteration"]) for line in lines) == 10


def test_the_dataset_is_left_alone(scene_folder, finished_bench):
    files = {p.relative_to(scene_folder).parts[0] for p in scene_folder.rglob("*") if p.is_file()}
    assert files == {"images", "sparse"}


def test_finished_runs_are_kept_and_failed_ones_tried_again(bench_here, runs):
    folder = runs / "ring/mean-joint-balanced/seed0"
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.rglob("*") if p.is_file()}
    outcome, said = bench_here("MEAN", "RAISES", runs=runs)
    after = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.rglob("*") if p.is_file()}
    assert after == before
    assert outcome.skipped == 1 and outcome.finished == (folder,)
    assert "1 of 2 runs are finished and kept" in said
    assert [f.method for f in outcome.failures] == ["raises"]


@pytest.mark.parametrize("file", [records.RUN_FILE, records.ROWS_FILE])
def test_a_damaged_run_of_another_command_is_left_out(bench_here, tmp_path, file):
    toy, runs = "toy_methods:MEAN", tmp_path / "runs"
    (first,), (damaged,) = (bench_here(toy, seeds=(i,))[0].finished for i in (0, 1))
    (damaged / file).write_bytes(b"\xff")
    outcome, said = bench_here(toy, seeds=(2,))
    assert [run["seed"] for run in json.loads((runs / "results.json").read_text())] == [0, 2]
    assert len(outcome.finished) == 1 and first.is_dir()
    (notice,) = (line for line in said if line.startswith("left out of results.json: "))
    assert str(damaged / file) in notice


def test_other_settings_are_refused_or_replace(bench_here, runs):
    folder = runs / "ring/mean-joint-balanced/seed0"
    with pytest.raises(ConfigError, match=r"with device cpu, found .* with device auto;"):
        bench_here("MEAN", runs=runs, device="cpu")
    assert records.read_config(folder)["device"] == "auto"
    bench_here("MEAN", runs=runs, device="cpu", overwrite=True)
    assert records.read_config(folder)["device"] == "cpu"


def test_variants_lie_side_by_side_and_are_named_by_what_differs(bench_here):
    toy = "toy_methods:MEAN"
    outcome, _ = bench_here(toy, overrides={"rate": "0.5", "iterations": "20"})  # the defaults
    (plain,) = outcome.finished
    assert plain.parent.name == "mean-joint-balanced"
    changes = {"overrides": {"sleep": "0.001", "rate": "0.25"}, "separate_iterations": "each"}
    changes["strategies"] = ("joint", "separate")
    outcome, said = bench_here(toy, budget_seconds=0.05, iterations=3, **changes)
    folder, separate = outcome.finished
    variant = "iterations=3,rate=0.25,sleep=0.001,budget=0.05s"
    assert folder.parent.name == f"mean-joint-balanced-{variant}" and plain.is_dir()
    assert read_run(folder).variant == variant
    assert read_run(separate).variant == f"{variant},separate_iterations=each"
    assert f"[1/2] ring: mean joint balanced {variant} seed 0" in said
    table = format_runs([read_run(plain), read_run(folder)], [], "table")
    assert "Mean (joint, balanced) " in table
    assert "Mean (joint, balanced, iterations=3, rate=0.25, " in table


def test_two_commands_share_a_folder_run_by_run(bench_here, tmp_path, monkeypatch):
    toy, runs = "toy_methods:MEAN", tmp_path / "runs"
    other = FileLock(runs / records.LOCKS / "ring/mean-joint-balanced/seed0.lock")
    Path(other.lock_file).parent.mkdir(parents=True)
    other.acquire()

    def other_command(seconds):
        assert names(runs) == ["ring/mean-joint-balanced/seed1"]
        other.release()
        bench_here(toy)

    monkeypatch.setattr(runner, "time", SimpleNamespace(sleep=other_command))
    outcome, said = bench_here(toy, seeds=(0, 1))
    assert names(runs) == [f"ring/mean-joint-balanced/seed{i}" for i in (0, 1)]
    assert len(outcome.finished) == 2 and outcome.failures == ()
    assert [line for line in said if "command" in line] == [
        "waiting for another command, which has ring: mean joint balanced seed 0",
        "[2/2] ring: mean joint balanced seed 0: another command has finished it",
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"iterations": 5}, "--iterations: expected no --set iterations beside it"),
        ({"continue_to": 5}, "--continue-to: expected no --set iterations beside it"),
        ({"budget_seconds": 1.0}, "--set iterations: expected no --budget beside it"),
        ({"continue_to": 5, "budget_seconds": 1.0}, "no --set iterations and no --budget beside"),
    ],
)
def test_two_lengths_are_refused(bench, changes, message):
    with pytest.raises(ConfigError, match=message):
        bench("MEAN", overrides={"mean.iterations": "7"}, **changes)


def test_each_model_has_an_iteration(bench_here):
    outcome, _ = bench_here("MEAN", strategies=("separate", "sequential", "joint"), iterations=1)
    assert len(outcome.finished) == 1
    expected = "mean --iterations: expected at least one for each of 2 models or stages"
    assert all(failure.reason.startswith(expected) for failure in outcome.failures)


def test_without_test_views_nothing_is_scored(scene_folder, bench_here, tmp_path):
    folder = Path(shutil.copytree(scene_folder, tmp_path / "ring"))
    (folder / "sparse/0/test.txt").write_text("")
    for strategies in (("joint",), ("separate",)):
        outcome, _ = bench_here("toy_methods:MEAN", scenes=(folder,), strategies=strategies)
    record, rows = read_run(outcome.finished[0]), read_rows(outcome.finished[0])
    assert record.render_seconds is None and record.drawn is None and rows == []
    assert draw_figures(tmp_path / "runs", read_runs([tmp_path / "runs"])[0]) == []
    table = format_runs([record], [], "table")
    metrics = "psnr, ssim, ssim_valid, lpips_vgg, lpips_vgg_3dgs"
    reason = "trained on all photos: there are no test views"
    assert f"absent: {metrics}, drawn per view, rendering [ms]: {reason}\n" in table


def test_seeds_overrides_and_budgets(bench_here):
    overrides = {"sleep": "0.01", "mean.rate": "0.25"}
    outcome, said = bench_here("MEAN", budget_seconds=0.4, seeds=(3,), overrides=overrides)
    (folder,) = outcome.finished
    record = read_run(folder)
    assert folder.name == "seed3" and record.seed == 3
    assert record.seconds >= 0.4 and 1 <= record.iterations <= 40  # each takes 0.01 or more
    (notice,) = record.notices
    assert "equal seeds do not give equal models" in notice and f"note: {notice}" in said
    assert notice in format_runs([record], [], "table")
    config = json.loads((folder / "config.json").read_text())["config"]
    assert config["method_config"]["rate"] == 0.25
    assert config["stop"] == {"iterations": None, "seconds": 0.4}


@pytest.mark.slow
def test_a_full_disk_ends_the_bench_and_leaves_nothing_half(bench, tmp_path):
    with pytest.raises(DiskFullError, match=r"balanced-iterations=1/seed0: expected space for"):
        bench("MEAN", "FULL_DISK", "BLIND", iterations=1)
    runs = tmp_path / "runs"
    assert names(runs) == ["ring/mean-joint-balanced-iterations=1/seed0"]
    assert not list(runs.rglob("*.partial")) and not list(runs.rglob("seed0/failed.json"))
    assert len(json.loads((runs / "results.json").read_text())) == 1


@pytest.mark.parametrize("strategy", ["separate", "sequential"])
def test_separate_models_and_stages_share_or_repeat(bench_here, strategy):
    each, said = bench_here(
        "MEAN", strategies=(strategy,), iterations=9, separate_iterations="each"
    )
    assert read_run(each.finished[0]).iterations == 18
    assert any(line.endswith("has all iterations and time") for line in said)


def test_a_preset_file_means_its_iterations_as_the_preset_that_it_starts_from(bench_here, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('method = "dated"\nbase = "balanced"\n[options]\niterations = 9\n')
    own, _ = bench_here("DATED", strategies=("separate",), preset=str(file))
    assert read_run(own.finished[0]).iterations == 18 and read_run(own.finished[0]).variant == ""


def test_presets_may_mean_their_iterations_for_each_period(bench_here):
    """Two periods: 18 steps, of which each model or stage of one period does 9."""
    strategies = ("joint", "separate", "sequential", "pooled")
    each, said = bench_here("DATED", strategies=strategies, iterations=9)
    assert [read_run(folder).iterations for folder in each.finished] == [18, 18, 18, 9]
    assert {read_run(folder).variant for folder in each.finished} == {"iterations=9"}
    assert any(line.endswith("once for each period") for line in said)
    total, _ = bench_here("DATED", strategies=strategies, iterations=9, separate_iterations="total")
    assert [read_run(folder).iterations for folder in total.finished] == [9] * 4
    variant = "iterations=9,separate_iterations=total"
    assert {read_run(folder).variant for folder in total.finished} == {variant}
    hashes = [read_run(folder).config_hash for folder in (*each.finished, *total.finished)]
    assert len(set(hashes)) == 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "best"}, "expected one of balanced, slow"),
        ({"overrides": {"rates": "1"}}, "did you mean 'rate'"),
        ({"overrides": {"chronogs.rate": "1"}}, "use the name of a method that is run"),
        ({"device": "cuda"}, "mean --device: expected one of cpu"),
        ({"overrides": {"iterations": "0"}}, "expected a positive number"),
        ({"strategies": ("mixed",)}, "expected one of joint, pooled, separate"),
        ({"strategies": ("sequential",), "methods": ("toy_methods:FIXED",)}, "without extend"),
        ({"strategies": ("sequential",), "methods": ("toy_programs:PROGRAM",)}, "without extend"),
        ({"strategies": ("sequential",), "keep_training": True}, "--keep-training, --continue-to"),
        ({"separate_iterations": "each"}, "expected strategy separate or sequential.*found joint"),
    ],
)
def test_wrong_settings_end_before_anything_is_trained(bench, tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        bench("MEAN", **changes)
    assert not list(tmp_path.glob("runs/ring/*"))


def test_wrong_weights_end_before_anything_is_trained(bench, tmp_path):
    (tmp_path / "w").mkdir()
    with pytest.raises(MetricUnavailableError, match="expected VGG16 and the LPIPS heads"):
        bench("MEAN", lpips_weights=tmp_path / "w")


def test_methods_of_one_name_are_not_taken_for_each_other(bench_here, monkeypatch):
    monkeypatch.setattr("toy_methods.COPY", load_spec("toy_methods:MEAN"), raising=False)
    with pytest.raises(ConfigError, match=r"toy_methods:COPY: expected .*'mean', that of toy_meth"):
        bench_here("MEAN", "COPY")
    bench_here("MEAN")
    with pytest.raises(ConfigError, match=r"a run of toy_methods:COPY, found a finished one of "):
        bench_here("COPY")
    assert bench_here("COPY", overwrite=True)[0].skipped == 0
    assert bench_here("COPY")[0].skipped == 1


def test_a_finished_run_that_kept_no_training_is_named(bench_here):
    (folder,) = bench_here("MEAN")[0].finished
    note = f"note: {folder} has its model alone: delete it to keep a training there"
    assert note in bench_here("MEAN", keep_training=True)[1]
    shutil.rmtree(folder)
    assert note not in bench_here("MEAN", keep_training=True)[1]
    assert note not in bench_here("MEAN", keep_training=True)[1]


def test_scenes_of_one_name_are_refused(bench, scene_folder, tmp_path):
    other = Path(shutil.copytree(scene_folder, tmp_path / "copy" / "ring"))
    with pytest.raises(ConfigError, match="'ring', the name of"):
        bench("MEAN", scenes=(scene_folder, other))


def test_another_evaluation_size_needs_another_folder(bench, runs):
    with pytest.raises(ConfigError, match="expected --max-width 12, found --max-width 1600"):
        bench("BLIND", runs=runs, seeds=(7,), max_width=12)


def test_a_scene_that_is_none(bench, tmp_path):
    with pytest.raises(SceneError, match="expected a scene"):
        bench("MEAN", scenes=(tmp_path,))


def test_images_are_trained_and_scored_at_the_evaluation_size(bench_here):
    outcome, _ = bench_here("MEAN", max_width=12)
    assert outcome.failures == ()
    (folder,) = outcome.finished
    assert {(e.width, e.height) for e in read_manifest(folder / "predictions").images} == {(12, 8)}
    assert "ssim_valid" in read_run(folder).skipped


@pytest.mark.slow
def test_memory_is_that_of_the_run_alone(bench):
    """A worker does not inherit the peak of a big parent, and its own arrays count."""
    parent = np.ones(1_000_000_000, np.uint8)
    light, _ = bench("MEAN")
    heavy, _ = bench("MEAN", overrides={"ballast": "300000000"})
    low, high = (read_run(o.finished[0]).peak_memory_bytes for o in (light, heavy))
    assert parent.all()
    assert 290e6 < high - low < 400e6
