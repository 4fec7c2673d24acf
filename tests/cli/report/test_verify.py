"""``chronoscene verify``: table, findings, exit status, entries of the leaderboard."""

import json
from functools import partial

import pytest
from command_line import invoke
from made_runs import write_scored

from chronoscene.harness.files.provenance import config_hash
from chronoscene.harness.files.records import CONFIG_FILE, read_run, write_run, write_summary
from chronoscene.harness.score.scoring import rescore
from chronoscene.metrics.registry import Scorers, make_scorers
from leaderboard.submit import submit


@pytest.fixture
def runs(tmp_path):
    """Two seeds with true scores of images of noise, and the entry that was made of the first."""
    runs = tmp_path / "runs"
    for seed in (0, 1):
        folder = write_scored(runs, seed=seed, scene="square", checkpoint_bytes=None)
        record = read_run(folder)
        names = ("method", "preset", "strategy", "max_width")
        config = {name: getattr(record, name) for name in names} | {"method_config": {}}
        hashed = config_hash(config)
        document = {"config": config, "config_hash": hashed, "scene": record.scene}
        document |= {"scene_hash": record.scene_hash, "seed": seed}
        (folder / CONFIG_FILE).write_text(json.dumps(document))
        write_run(folder, record.model_copy(update={"config_hash": hashed}), [])
    rescore(runs, make_scorers(["psnr", "ssim"]))
    submit([runs / "square/3dgs-joint-fast/seed0"], tmp_path / "entries")
    return runs


verify = partial(invoke, "verify")


def test_good_runs(runs):
    result = verify(runs)
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines() if "seed" in line]
    assert [row[1:] for row in rows] == [["6", "2", "0", "ok"]] * 2


def test_an_edited_score_ends_with_status_1_and_the_place(runs):
    path = runs / "results.json"
    document = json.loads(path.read_text())
    document[1]["aggregates"]["micro"]["ssim"] += 1e-4
    path.write_text(json.dumps(document))
    result = verify(runs)
    assert result.exit_code == 1
    (line,) = [line for line in result.stdout.splitlines() if "differs: " in line]
    assert line.startswith(f"{runs}/square/3dgs-joint-fast/seed1: differs: results.json: ")
    assert "aggregates.micro.ssim" in line


def test_entries_beside_their_runs(runs, tmp_path):
    entries = tmp_path / "entries"
    other = write_scored(tmp_path / "others", "4dgs", scene="square")
    rescore(tmp_path / "others", make_scorers(["psnr"]))
    submit([other], entries)
    result = verify(runs, "--entries", entries)
    assert result.exit_code == 0, result.output
    assert "not checked: no run of it in RUNS" in result.stdout
    (path,) = entries.rglob("3dgs*.json")
    document = json.loads(path.read_text())
    document["runs"][0]["views"][0]["sha256"] = "0" * 64
    path.write_text(json.dumps(document))
    result = verify(runs, "--entries", entries)
    assert (
        result.exit_code == 1 and f"{path}: seed 0: differs: sha256: 0/view0.png" in result.stdout
    )
    path.write_text("no JSON")
    result = verify(runs, "--entries", entries)
    assert result.exit_code == 1 and f"{path}: differs: " in result.stdout


def test_an_entry_with_other_values(runs, tmp_path, monkeypatch):
    """Its means are those of its views, so only its run can tell."""
    entries = tmp_path / "entries"
    folder = runs / "square/3dgs-joint-fast/seed0"
    kept = {name: (folder / name).read_bytes() for name in ("run.json", "rows.csv")}
    rescore(runs, Scorers({"psnr": lambda *images: 40.0}, {}))
    monkeypatch.setattr("leaderboard.submit.check_values", lambda *_: None)
    submit([folder], entries)
    for name, data in kept.items():
        (folder / name).write_bytes(data)
    write_summary(runs)
    result = verify(folder, "--entries", entries)
    assert result.exit_code == 1
    assert "differs: views: 0/view0.png.psnr: expected " in result.stdout
