"""``chronoscene table`` and ``score``: formats, files, choices, what changed."""

import csv
import errno
import io
import json
import os
from shutil import copytree, rmtree

import pytest
from command_line import invoke, succeed
from made_runs import record, rows_of, write_scored

import chronoscene.cli.report.results as results_module
from chronoscene.cli.options import split_list
from chronoscene.errors import CheckpointError, ConfigError, MetricUnavailableError
from chronoscene.harness.files.records import read_run, run_folders, write_run
from chronoscene.harness.score.scoring import Rescored
from chronoscene.metrics.registry import Scorers


@pytest.fixture
def runs(tmp_path):
    """Two seeds of one method, written by hand."""
    for seed in (0, 1):
        values = {"psnr": 20.0 + seed, "ssim": 0.5}
        run = record(
            "m",
            seed,
            aggregates={kind: dict(values) for kind in ("macro", "micro", "worst")},
            periods={"0": dict(values)},
            period_labels={"0": "may"},
        )
        folder = tmp_path / "runs" / "plaza" / "m-joint-fast" / f"seed{seed}"
        folder.mkdir(parents=True)
        write_run(folder, run, rows_of(run))
    return tmp_path / "runs"


def table(*arguments):
    return succeed("table", *arguments).stdout


def test_the_terminal_table(runs):
    lines = [line.strip() for line in table(runs).splitlines()]
    assert lines[0] == "plaza: macro means"
    first = lines.index("plaza: PSNR [dB] (psnr), higher is better")
    assert lines[first + 4].split("  ") == [
        "M (joint, fast)", "20.50 ± 0.71", "20.50 ± 0.71", "20.50 ± 0.71", "20.50 ± 0.71", "2"
    ]  # fmt: skip
    assert "absent: lpips_vgg: no weights" in lines


def test_metrics_may_be_listed_or_repeated(runs):
    both = table(runs, "--metric", "ssim,psnr")
    assert both == table(runs, "--metric", "psnr", "--metric", "ssim")
    assert "psnr" not in table(runs, "--metric", "ssim")


def test_published_rows_and_single_periods_are_options(runs):
    assert "nothing is published of plaza" in table(runs, "--published")
    assert "published" not in table(runs)
    assert table(runs, "--periods") == table(runs)  # it has one


def test_files_are_written_whole(runs, tmp_path):
    (tmp_path / "new").mkdir()
    out = tmp_path / "new" / "table.csv"
    assert table(runs, "--format", "csv", "--out", out) == ""
    lines = list(csv.DictReader(io.StringIO(out.read_text())))
    found = {(r["quantity"], r["column"]): float(r["mean"]) for r in lines}
    assert found["psnr", "macro"] == 20.5 and found["iterations", ""] == 100
    assert [p.name for p in out.parent.iterdir()] == ["table.csv"]


@pytest.mark.parametrize(
    ("other", "name", "difference"),
    [
        ({"max_width": 160}, "width 160", "--max-width (1600, 160)"),
        ({"scene_hash": "c" * 64}, "scene cccccc", "photos, poses or points (aaaaaa, cccccc)"),
        (
            {"scene_hash": "c" * 64, "split_hash": "d" * 64},
            "split dddddd",
            "test views (bbbbbb, dddddd)",
        ),
    ],
)
def test_what_cannot_be_compared_has_tables_of_its_own(tmp_path, other, name, difference):
    write_scored(tmp_path / "a", "3dgs")
    write_scored(tmp_path / "a", "4dgs")
    write_scored(tmp_path / "b", "3dgs", psnr=((30.0, 31.0), (32.0, 33.0)), **other)
    text = table(tmp_path / "a", tmp_path / "b")
    assert f"plaza [{name}]: PSNR [dB] (psnr), higher is better" in text
    assert f"plaza: runs with different {difference} are not compared, and stand apart" in text
    assert "mean of scenes" not in text
    document = json.loads(table(tmp_path / "a", tmp_path / "b", "--format", "json"))
    compared = [e for e in document["entries"] if e["difference"] is not None]
    assert {(e["method"], e["scene"].partition(" [")[0]) for e in compared} <= {
        ("3dgs", "plaza"),
        ("4dgs", "plaza"),
    }
    assert {e["scene"] for e in compared}.isdisjoint({f"plaza [{name}]"})


def test_copies_count_once(tmp_path):
    folder = write_scored(tmp_path / "runs")
    copytree(tmp_path / "runs", tmp_path / "backup")
    copytree(folder, folder.with_name("seed1"))
    document = json.loads(table(tmp_path / "runs", tmp_path / "backup", "--format", "json"))
    assert {e["n"] for e in document["entries"]} == {1}
    (note,) = [note for note in document["notes"] if note.startswith("copies of runs, not counted")]
    assert "seed1" in note and str(tmp_path / "backup") in note


def test_a_seed_with_two_results_is_refused(tmp_path):
    first, second = (write_scored(tmp_path / name, seconds=s) for name, s in (("a", 1), ("b", 2)))
    with pytest.raises(ConfigError) as error:
        table(tmp_path / "a", tmp_path / "b")
    for text in (str(first), str(second), "plaza: 3dgs joint fast seed 0 once"):
        assert text in str(error.value)


def test_a_seed_of_two_commits_is_not_two_seeds(tmp_path):
    write_scored(tmp_path / "a", commit="1" * 40)
    write_scored(tmp_path / "b", commit="2" * 40 + "-dirty")
    text = table(tmp_path / "a", tmp_path / "b")
    assert "3DGS (joint, fast) [code 1111111111]" in text
    assert "3DGS (joint, fast) [code 2222222222-dirty]" in text and "±" not in text


@pytest.mark.parametrize(
    ("claimed", "message"),
    [
        ("40.0", r"run.json: expected 23 as psnr, macro: the mean of rows.csv, found 40"),
        ('"NaN"', r"not a number \(aggregates.macro.psnr\)"),
    ],
)
def test_a_mean_that_is_not_that_of_the_views_is_refused(tmp_path, claimed, message):
    file = write_scored(tmp_path / "runs") / "run.json"
    text = file.read_text()
    file.write_text(text.replace('"psnr": 23.0', f'"psnr": {claimed}', 1))
    with pytest.raises(CheckpointError, match=message):
        table(tmp_path / "runs")


def test_a_mean_without_values_of_views_is_refused(tmp_path):
    rows = write_scored(tmp_path / "runs") / "rows.csv"
    rows.write_text(rows.read_text().splitlines()[0] + "\n")
    with pytest.raises(CheckpointError, match=r"expected nothing as psnr, macro: .*, found 2"):
        table(tmp_path / "runs")


def test_times_of_two_devices_are_in_two_columns(tmp_path):
    write_scored(tmp_path / "runs", "3dgs", seconds=7.0)
    write_scored(tmp_path / "runs", "4dgs", seconds=9.0, device="cuda (Test)")
    for i in (0, 1):
        write_scored(tmp_path / "runs", "gs-w", i, seconds=8.0, device=f"device {i}")
    lines = table(tmp_path / "runs", "--format", "markdown").splitlines()
    start = lines.index(next(line for line in lines if "macro means and cost" in line))
    head, _, *rows = [line.split(" | ") for line in lines[start:] if line.startswith("|")]
    columns = [i for i, name in enumerate(head) if "training [s]" in name]
    assert [head[i].split("] ")[1] for i in columns] == ["cpu (Test, 2 threads)", "cuda (Test)"]
    assert [[row[i] for i in columns] for row in rows] == [["7.0", "-"], ["-", "9.0"], ["-", "-"]]
    assert any("averaged, but for their times: GS-W (joint, fast)" in line for line in lines)


def test_efforts_that_differ_are_noted(tmp_path):
    for method, steps in (("3dgs", 100), ("4dgs", 2000)):
        write_scored(tmp_path / "runs", method, iterations=steps)
    said = "100 training steps: 3DGS (fast); 2,000 training steps: 4DGS (fast)"
    assert f"efforts differ, and a difference may be theirs: {said}" in table(tmp_path / "runs")


def test_names_and_columns_can_be_chosen(tmp_path):
    for method, psnr in (("3dgs", 20.0), ("4dgs", 10.0)):
        write_scored(tmp_path / "runs", method, psnr=((psnr, psnr),))
    renames = ("--rename", " (joint, fast)=", "--rename", "3DGS=Ours")
    columns = ("--columns", "macro,training")
    text = table(tmp_path / "runs", "--format", "latex", *renames, *columns)
    assert [line for line in text.splitlines() if line.endswith(r" \\")] == [
        *(r"method & macro \\", r"Ours & \textbf{20.00} \\", r"4DGS & 10.00 \\"),
        *(r"method & training [s] \\", r"Ours & 10.0 \\", r"4DGS & 10.0 \\"),
    ]


def test_columns_that_two_tables_have_are_shown_once(runs):
    rmtree(runs / "plaza" / "m-joint-fast" / "seed1")  # one table has the spread of seeds

    def titles(columns):
        lines = table(runs, "--columns", columns).splitlines()
        return [line for line in lines if line.startswith("plaza: ")]

    assert titles("PSNR,checkpoint") == ["plaza: macro means"]
    assert titles("PSNR,checkpoint,training") == [
        "plaza: macro means",
        "plaza: macro means and cost",
    ]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--rename", "5DGS=x"), "--rename 5DGS=x: expected a part of one of the names"),
        (("--rename", "3DGS=4DGS"), "names that still differ afterwards"),
        (("--rename", "3DGS"), "--rename: expected OLD=NEW"),
        (("--columns", "macros"), "--columns: expected one of .*macro"),
        (("--columns", "macro", "--format", "csv"), "--columns: expected no such option with csv"),
        (("--rename", "3DGS=x", "--format", "json"), "--rename: expected no such option with json"),
    ],
)
def test_names_and_columns_that_are_not_there_are_refused(tmp_path, option, message):
    for method in ("3dgs", "4dgs"):
        write_scored(tmp_path / "runs", method)
    with pytest.raises(ConfigError, match=message):
        table(tmp_path / "runs", *option)


def test_a_region_has_tables_of_its_own(runs):
    for folder in run_folders(runs):
        run = read_run(folder)
        part = {"aggregates": run.aggregates, "periods": run.periods}
        run = run.model_copy(update={"regions": {"changed": part}, "change_masks": "m"})
        write_run(folder, run, rows_of(run))
    assert table(runs, "--region", "changed").count("plaza (changed)") >= 2
    with pytest.raises(ConfigError, match="--region invariant: expected runs"):
        table(runs, "--region", "invariant")


def test_a_metric_that_no_run_was_scored_by_is_said_to_be_absent(runs):
    assert "absent: flip: no value: chronoscene score RUNS --metric flip" in table(
        runs, "--metric", "flip"
    )
    assert "absent" not in table(runs, "--metric", "psnr")


def test_a_metric_that_is_not_installed_is_named(tmp_path):
    folder = write_scored(tmp_path / "runs")
    rows = (folder / "rows.csv").read_text()
    (folder / "rows.csv").write_text(rows.replace(",psnr,", ",mae,"))
    with pytest.raises(MetricUnavailableError, match="metrics that are installed, found 'mae'"):
        table(tmp_path / "runs")


def test_wrong_input_is_told(runs, tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'psnr'"):
        table(runs, "--metric", "psn")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="run bench first"):
        table(tmp_path / "empty")
    assert invoke("table", runs, "--format", "html").exit_code == 2


def test_lists():
    assert split_list("--x", "a, b,a") == ("a", "b")
    assert split_list("--x", "PSNR,LPIPS (VGG, 3DGS)") == ("PSNR", "LPIPS (VGG, 3DGS)")
    with pytest.raises(ConfigError, match="--x: expected names separated by commas"):
        split_list("--x", "a,")


@pytest.fixture
def score(monkeypatch, tmp_path):
    """Run the command on outcomes that are given."""

    def run(*outcomes, skipped=None):
        monkeypatch.setattr(
            results_module, "make_scorers", lambda names, lpips_weights: Scorers({}, skipped or {})
        )
        monkeypatch.setattr(
            results_module, "rescore", lambda runs, scorers, progress: list(outcomes)
        )
        return invoke("score", tmp_path)

    return run


def test_changes_are_told(score, tmp_path):
    result = score(
        Rescored(tmp_path / "s/m/seed0", [], []),
        Rescored(tmp_path / "s/m/seed1", ["psnr 20 -> 21 (macro)", "lpips_vgg new: 0.1"], []),
        Rescored(tmp_path / "s/m/seed2", [], ["lpips_vgg"]),
        skipped={"lpips_vgg": "no weights", "lpips_vgg_3dgs": "no weights"},
    )
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "s/m/seed0: unchanged",
        "s/m/seed1: psnr 20 -> 21 (macro); lpips_vgg new: 0.1",
        "s/m/seed2: unchanged",
        "s/m/seed2: lpips_vgg kept from an earlier scoring",
        "lpips_vgg, lpips_vgg_3dgs not computed: no weights",
    ]


def test_weights_that_no_metric_needs_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="--lpips-weights: expected no such option without LPIPS"):
        invoke("score", tmp_path, "--metric", "psnr,flip", "--lpips-weights", tmp_path)


def test_a_run_that_cannot_be_scored_gives_status_1(score, tmp_path):
    result = score(
        Rescored(tmp_path / "s/m/seed0", [], [], "an image was edited"),
        Rescored(tmp_path / "s/m/seed1", [], []),
    )
    assert result.exit_code == 1
    assert "s/m/seed0: error: an image was edited" in result.output
    assert "s/m/seed1: unchanged" in result.output


def test_runs_that_cannot_be_written_to_are_refused_before_scoring(score, monkeypatch, tmp_path):
    def read_only(**options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("chronoscene.cli.output.TemporaryFile", read_only)
    with pytest.raises(ConfigError, match=f"RUNS {tmp_path}: expected a place that can be written"):
        score(Rescored(tmp_path / "s/m/seed0", [], []))


def test_a_folder_without_runs(tmp_path):
    with pytest.raises(CheckpointError, match="run bench first"):
        invoke("score", tmp_path)


def test_weights_that_are_none(tmp_path):
    (tmp_path / "weights").mkdir()
    with pytest.raises(MetricUnavailableError, match="expected VGG16 and the LPIPS heads"):
        invoke("score", tmp_path, "--lpips-weights", tmp_path / "weights")
    missing = invoke("score", tmp_path, "--lpips-weights", tmp_path / "absent")
    assert missing.exit_code == 2 and "does not exist" in missing.output


def test_metrics_and_truth_are_passed_on(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(results_module, "freeze_change_masks", lambda *a: asked.append(a))
    monkeypatch.setattr(
        results_module, "rescore", lambda runs, scorers, progress: asked.append(scorers) or []
    )
    succeed("score", tmp_path, "--metric", "ssim_cc,psnr", "--truth", tmp_path)
    assert asked[0] == (tmp_path, tmp_path) and set(asked[1].functions) == {"psnr", "ssim_cc"}
