"""``chronoscene table`` and ``score``: formats, files, choices, what changed."""

import csv
import io
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

import chronoscene.cli.report.results as results_module
from chronoscene.cli import cli
from chronoscene.cli.options import split_list
from chronoscene.errors import CheckpointError, ConfigError, MetricUnavailableError
from chronoscene.harness.files.records import RunRecord, read_run, run_folders, write_run
from chronoscene.harness.score.scoring import Rescored
from chronoscene.metrics.registry import Scorers


@pytest.fixture
def runs(tmp_path):
    """Two seeds of one method, written by hand."""
    for seed in (0, 1):
        values = {"psnr": 20.0 + seed, "ssim": 0.5}
        record = RunRecord(
            method="m",
            strategy="joint",
            scene="plaza",
            seed=seed,
            aggregates={kind: dict(values) for kind in ("macro", "micro", "worst")},
            periods={"0": dict(values)},
            seconds=1.0,
            iterations=10,
            primitives=3,
            checkpoint_bytes=100,
            peak_memory_bytes=10**8,
            device="cpu",
            commit="abc",
            skipped={"lpips_vgg": "no weights"},
            title="M",
            preset="fast",
            method_version="1",
            config_hash="c",
            scene_hash="s",
            split_hash="p",
            period_labels={"0": "may"},
            parameters=1,
            warmup_seconds=0.0,
            setup_seconds=0.0,
            render_seconds=0.0,
            peak_device_memory_bytes=None,
            threads=1,
            max_width=1600,
            libraries={},
            started="2026-01-01T00:00:00+00:00",
            notices=[],
        )
        folder = tmp_path / "runs" / "plaza" / "m-joint-fast" / f"seed{seed}"
        folder.mkdir(parents=True)
        write_run(folder, record, [])
    return tmp_path / "runs"


def table(*arguments):
    result = CliRunner().invoke(cli, ["table", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


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
    assert found["psnr", "macro"] == 20.5 and found["iterations", ""] == 10
    assert [p.name for p in out.parent.iterdir()] == ["table.csv"]


def test_folders_add_up(runs):
    document = json.loads(table(runs, runs, "--format", "json"))
    assert {e["n"] for e in document["entries"]} == {4}


def test_a_region_has_tables_of_its_own(runs):
    for folder in run_folders(runs):
        run = read_run(folder)
        part = {"aggregates": run.aggregates, "periods": run.periods}
        write_run(
            folder, run.model_copy(update={"regions": {"changed": part}, "change_masks": "m"}), []
        )
    assert table(runs, "--region", "changed").count("plaza (changed)") >= 2
    with pytest.raises(ConfigError, match="--region invariant: expected runs"):
        table(runs, "--region", "invariant")


def test_wrong_input_is_told(runs, tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'psnr'"):
        table(runs, "--metric", "psn")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="run bench first"):
        table(tmp_path / "empty")
    assert CliRunner().invoke(cli, ["table", str(runs), "--format", "html"]).exit_code == 2


def test_lists():
    assert split_list("--x", "a, b,a") == ("a", "b")
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
        return CliRunner().invoke(cli, ["score", str(tmp_path)], catch_exceptions=False)

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


def test_a_run_that_cannot_be_scored_gives_status_1(score, tmp_path):
    result = score(
        Rescored(tmp_path / "s/m/seed0", [], [], "an image was edited"),
        Rescored(tmp_path / "s/m/seed1", [], []),
    )
    assert result.exit_code == 1
    assert "s/m/seed0: error: an image was edited" in result.output
    assert "s/m/seed1: unchanged" in result.output


def test_a_folder_without_runs(tmp_path):
    with pytest.raises(CheckpointError, match="run bench first"):
        CliRunner().invoke(cli, ["score", str(tmp_path)], catch_exceptions=False)


def test_weights_that_are_none(tmp_path):
    (tmp_path / "weights").mkdir()
    arguments = ["score", str(tmp_path), "--lpips-weights", str(tmp_path / "weights")]
    with pytest.raises(MetricUnavailableError, match="expected VGG16 and the LPIPS heads"):
        CliRunner().invoke(cli, arguments, catch_exceptions=False)
    missing = CliRunner().invoke(cli, [*arguments[:-1], str(Path(tmp_path) / "absent")])
    assert missing.exit_code == 2 and "does not exist" in missing.output


def test_metrics_and_truth_are_passed_on(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(results_module, "freeze_change_masks", lambda *a: asked.append(a))
    monkeypatch.setattr(
        results_module, "rescore", lambda runs, scorers, progress: asked.append(scorers) or []
    )
    arguments = ["score", str(tmp_path), "--metric", "ssim_cc,psnr", "--truth", str(tmp_path)]
    assert CliRunner().invoke(cli, arguments, catch_exceptions=False).exit_code == 0
    assert asked[0] == (tmp_path, tmp_path) and set(asked[1].functions) == {"psnr", "ssim_cc"}
