"""Surveys of runs that were really trained, of a scene that has little to survey."""

import json
from dataclasses import replace

import pytest
from click.testing import CliRunner
from command_line import succeed

from chronoscene.cli import cli
from chronoscene.errors import CheckpointError
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.scene import WorldFrame

WORLD = WorldFrame("metre", "EPSG:32632", (680_000.0, 5_152_000.0, 0.0))


@pytest.mark.parametrize("method", ["chronogs", "4dgs"])
def test_a_trained_run(trained, tmp_path, monkeypatch, method):
    read = TrainedRun.scene
    monkeypatch.setattr(TrainedRun, "scene", lambda *args: replace(read(*args), world=WORLD))
    succeed("survey", trained[method], "--out", tmp_path / "out")
    summary = json.loads((tmp_path / "out/survey.json").read_text())
    assert [period["label"] for period in summary["periods"]] == ["spring", "autumn"]
    assert summary["coordinates"]["crs"] == "EPSG:32632"
    assert (tmp_path / "out/surface_spring_0.tif").is_file()


def test_a_run_without_a_model(trained, tmp_path):
    (tmp_path / "run").mkdir()
    for name in ("run.json", "source.json", "config.json", "rows.csv"):
        (tmp_path / "run" / name).write_bytes((trained["chronogs"] / name).read_bytes())
    result = CliRunner().invoke(
        cli, ["survey", str(tmp_path / "run"), "--out", str(tmp_path / "o")]
    )
    assert isinstance(result.exception, CheckpointError)
    assert "expected a run with a model, found no folder checkpoint" in str(result.exception)
