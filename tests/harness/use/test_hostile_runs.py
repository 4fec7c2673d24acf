"""Runs of strangers: whatever a command does with them, nothing in them is executed."""

import hashlib
import json
import pickle
import shutil
import sys

import pytest
from click.testing import CliRunner

from chronoscene.cli import COMMANDS, cli
from chronoscene.errors import ChronoSceneError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.records import SOURCE_FILE, read_rows, read_run, write_run

OPENING = (
    "changes RUN --out OUT",
    "compare RUNS --periods 0:1",
    "compress RUN",
    "export RUN --period 0 --out OUT",
    "leakage RUN",
    "page RUN --out OUT",
    "render RUN --out OUT",
    "survey RUN --out OUT",
    "view RUN",
)
"""Commands that need the model of a run."""
READING = (
    "bench SCENE --method 3dgs-period --preset fast --iterations 12 --out RUNS",
    "compare RUNS --html OUT",
    "methods 3dgs-period --runs RUNS",
    "score RUNS",
    "submit RUNS --to OUT",
    "table RUNS",
    "tradeoff RUNS",
    "verify RUNS",
    "leaderboard ENTRIES --runs RUNS --out OUT",
)
"""Commands that read other files of runs."""
OTHERS = {
    *(
        "all",
        "check-method",
        "convert",
        "doctor",
        "download",
        "edit",
        "mark",
        "new-method",
        "register",
    ),
    *("score-images", "split", "stats", "study", "synth", "triangulate", "tune", "undistort"),
    "validate",
}
"""Commands that read no runs, or as ``bench`` does."""

CODE = "from pathlib import Path\nPath({mark!r}).touch()\n"


class Executed:
    """Makes a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return open, (str(self.mark), "w")


def test_every_command_is_tried_or_reads_no_runs():
    opening, reading = ({line.split()[0] for line in lines} for lines in (OPENING, READING))
    assert opening | reading | OTHERS == COMMANDS.keys()
    assert not (opening | reading) & OTHERS
    with_plugin = {
        name
        for name in COMMANDS
        if any(option.name == "plugin" for option in cli.get_command(None, name).params)
    }
    assert with_plugin == opening


@pytest.fixture
def stranger(trained, tmp_path, monkeypatch):
    """A folder of one run, with modules in it; the folder of the run is the current one."""
    runs, mark = tmp_path / "runs", tmp_path / "executed"
    run = runs / trained["3dgs-period"].relative_to(trained["3dgs-period"].parents[2])
    shutil.copytree(trained["3dgs-period"], run)
    truth = "ground_truth/ring"
    shutil.copytree(trained["3dgs-period"].parents[2] / truth, runs / truth)
    for name in ("foreign", "sitecustomize", "multiprocessing", "baselines"):
        (run / f"{name}.py").write_text(CODE.format(mark=str(mark)))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(run)
    return run, mark


def invoke(line, run, scene_folder, tmp_path):
    (tmp_path / "entries").mkdir()
    places = {"RUN": run, "RUNS": run.parents[2], "OUT": tmp_path / "out", "SCENE": scene_folder}
    places["ENTRIES"] = tmp_path / "entries"
    return CliRunner().invoke(cli, [str(places.get(word, word)) for word in line.split()])


@pytest.mark.parametrize("line", OPENING + READING)
def test_a_module_that_a_run_names_is_not_imported(stranger, scene_folder, tmp_path, line):
    run, mark = stranger
    source = json.loads((run / SOURCE_FILE).read_text())
    place = tmp_path / "r"  # messages cut long paths
    place.symlink_to(run)
    named = {"method": "foreign:SPEC", "plugin_path": str(place)}
    (run / SOURCE_FILE).write_text(json.dumps(source | named))
    result = invoke(line, run, scene_folder, tmp_path)
    assert not mark.exists()
    assert not isinstance(result.exception, ImportError) and "foreign" not in sys.modules
    if line in OPENING:
        assert isinstance(result.exception, ChronoSceneError)
        for told in ("3dgs-period", "foreign:SPEC", str(place), "--plugin module:SPEC"):
            assert told in str(result.exception)


@pytest.mark.parametrize("name", ["model.safetensors", "model.compressed"])
@pytest.mark.parametrize("line", OPENING)
def test_a_model_is_not_unpickled(stranger, scene_folder, tmp_path, line, name):
    run, mark = stranger
    folder = run / "checkpoint"
    (folder / "model.safetensors").unlink()
    (folder / name).write_bytes(pickle.dumps(Executed(mark)))
    described = json.loads((folder / "model.json").read_text())
    digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / "model.json").write_text(json.dumps(described | {"tensors_sha256": digest}))
    result = invoke(line, run, scene_folder, tmp_path)
    assert not mark.exists()
    assert isinstance(result.exception, ChronoSceneError)


@pytest.mark.parametrize("name", ["../../outside", "..", "/outside"])
def test_the_name_of_a_scene_leads_nowhere(stranger, tmp_path, name):
    """Photos and figures have their places by this name."""
    run, _ = stranger
    record = read_run(run)
    write_run(run, record.model_copy(update={"scene": name}), read_rows(run))
    (run.parents[2] / "ground_truth/ring").rename(tmp_path / "outside")
    result = invoke("compare RUNS", run, tmp_path, tmp_path)
    assert isinstance(result.exception, ChronoSceneError)
    place = ground_truth_folder(run.parents[2], name).resolve()
    assert place.parent == run.parents[2] / "ground_truth"
    assert {path.name for path in tmp_path.iterdir()} == {"entries", "outside", "runs"}
