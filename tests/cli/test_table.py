"""``chronoscene table``: formats, files, choices."""

import csv
import io
import json

import pytest
from click.testing import CliRunner

from chronoscene.bench.results import RunRecord, write_run
from chronoscene.cli import cli
from chronoscene.cli.table import split_list
from chronoscene.errors import CheckpointError, ConfigError


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
    return result.output


def test_the_terminal_table(runs):
    lines = table(runs).splitlines()
    assert lines[0] == "plaza: PSNR [dB] (psnr), higher is better"
    assert lines[3].split("  ") == [
        "M (joint, fast)", "20.50 ± 0.71", "20.50 ± 0.71", "20.50 ± 0.71", "20.50 ± 0.71", "2"
    ]  # fmt: skip
    assert "absent: lpips_vgg: no weights" in lines


def test_metrics_may_be_listed_or_repeated(runs):
    both = table(runs, "--metric", "ssim,psnr")
    assert both == table(runs, "--metric", "psnr", "--metric", "ssim")
    assert "psnr" not in table(runs, "--metric", "ssim")


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


def test_wrong_input_is_told(runs, tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'psnr'"):
        table(runs, "--metric", "psn")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="run bench first"):
        table(tmp_path / "empty")
    assert CliRunner().invoke(cli, ["table", str(runs), "--format", "html"]).exit_code == 2


def test_lists():
    assert split_list("--x", "a, b,a") == ("a", "b")
    with pytest.raises(ConfigError, match="--x: expected names with commas"):
        split_list("--x", "a,")
