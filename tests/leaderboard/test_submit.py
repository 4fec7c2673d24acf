"""Runs become entries, if their images are those that were scored."""

import json

import pytest

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.records import read_rows, read_run, write_run
from leaderboard.entries import read_entries
from leaderboard.submit import submit


def test_seeds_extend_an_entry_and_replace_themselves(make_run, tmp_path):
    to = tmp_path / "entries"
    first = submit([make_run()], to)
    assert submit([make_run(seed=1)], to) == first
    assert submit([make_run(psnr=((30.0, 31.0), (32.0, 33.0)))], to) == first
    (entry,) = read_entries(to).values()
    assert [(r.seed, r.periods["0"]["psnr"]) for r in entry.records] == [(0, 30.5), (1, 21.0)]


def test_a_folder_of_runs_gives_an_entry_per_setting(make_run, tmp_path):
    make_run(), make_run("chronogs"), make_run("chronogs", seed=1)
    make_run("4dgs", device="cuda (Test)")
    written = submit([tmp_path / "runs"], tmp_path / "entries")
    assert len({*written}) == 3
    assert [len(entry.runs) for entry in read_entries(tmp_path / "entries").values()] == [1, 1, 2]


def test_devices_have_entries_of_their_own(make_run, tmp_path):
    submit([make_run()], tmp_path / "entries")
    submit([make_run(device="cuda (Test)")], tmp_path / "entries")
    assert len(read_entries(tmp_path / "entries")) == 2


def test_a_changed_prediction_is_refused_and_nothing_is_written(make_run, tmp_path):
    run = make_run()
    images = sorted((run / "predictions/0").glob("*.png"))
    images[0].write_bytes(images[1].read_bytes())
    with pytest.raises(CheckpointError, match=r"expected the file with SHA-256 .* another file"):
        submit([run], tmp_path / "entries")
    assert not (tmp_path / "entries").exists()


def test_predictions_of_another_scene_are_refused(make_run, tmp_path):
    run = make_run(scene_hash="f" * 64)
    with pytest.raises(ConfigError, match="predictions of another scene"):
        submit([run], tmp_path / "entries")


def test_a_value_without_its_image_is_refused(make_run, tmp_path):
    run = make_run()
    manifest = run / "predictions/manifest.json"
    document = json.loads(manifest.read_text())
    del document["images"][0]
    manifest.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="other views in its rows than among its predictions"):
        submit([run], tmp_path / "entries")


def test_a_run_with_changed_means_is_refused(make_run, tmp_path):
    run = make_run()
    record = read_run(run)
    record.aggregates["macro"]["psnr"] = 99.0
    write_run(run, record, read_rows(run))
    with pytest.raises(ConfigError, match="the means are not those of the views"):
        submit([run], tmp_path / "entries")


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="expected a finished run, found no such file"):
        submit([tmp_path], tmp_path / "entries")
