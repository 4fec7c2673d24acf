"""``chronoscene score``: what it says and which status it ends with."""

from pathlib import Path

import pytest
from click.testing import CliRunner

import chronoscene.cli.score as score_module
from chronoscene.bench.scoring import Rescored
from chronoscene.cli import cli
from chronoscene.errors import CheckpointError, MetricUnavailableError
from chronoscene.metrics.scorers import Scorers


@pytest.fixture
def score(monkeypatch, tmp_path):
    """Run the command on outcomes that are given."""

    def run(*outcomes, skipped=None):
        monkeypatch.setattr(
            score_module, "make_scorers", lambda lpips_weights: Scorers({}, skipped or {})
        )
        monkeypatch.setattr(score_module, "rescore", lambda runs, scorers, progress: list(outcomes))
        return CliRunner().invoke(cli, ["score", str(tmp_path)], catch_exceptions=False)

    return run


def test_changes_are_told(score, tmp_path):
    result = score(
        Rescored(tmp_path / "s/m/seed0", [], []),
        Rescored(tmp_path / "s/m/seed1", ["psnr 20 -> 21 (macro)", "lpips_vgg new: 0.1"], []),
        Rescored(tmp_path / "s/m/seed2", [], ["lpips_vgg"]),
        skipped={"lpips_vgg": "no weights"},
    )
    assert result.exit_code == 0
    assert result.output.splitlines() == [
        "s/m/seed0: unchanged",
        "s/m/seed1: psnr 20 -> 21 (macro); lpips_vgg new: 0.1",
        "s/m/seed2: unchanged",
        "s/m/seed2: lpips_vgg kept from an earlier scoring",
        "lpips_vgg not computed: no weights",
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
    with pytest.raises(MetricUnavailableError, match="vgg16"):
        CliRunner().invoke(cli, arguments, catch_exceptions=False)
    missing = CliRunner().invoke(cli, [*arguments[:-1], str(Path(tmp_path) / "absent")])
    assert missing.exit_code == 2 and "does not exist" in missing.output
