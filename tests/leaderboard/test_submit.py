"""Runs become entries, if their images are those that were scored."""

import json
import shutil
from dataclasses import replace
from threading import Thread

import pytest

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.records import read_rows, read_run, write_run
from chronoscene.harness.score.scoring import aggregate
from leaderboard.board import read_board
from leaderboard.entries import predictions_folder, read_entry
from leaderboard.submit import _copy_predictions, submit


def test_seeds_extend_an_entry_and_replace_themselves(make_run, enter, tmp_path):
    to = tmp_path / "entries"
    first = enter([make_run()], to)
    assert enter([make_run(seed=1)], to) == first
    assert enter([make_run(psnr=((30.0, 31.0, 32.0), (32.0, 33.0, 34.0)))], to) == first
    entry = read_entry(first[0])
    found = [(r.record.seed, r.record.periods["0"]["psnr"]) for r in entry.runs]
    assert found == [(0, 31.0), (1, 21.0)]


def test_an_entry_is_of_older_code_until_all_of_its_seeds_are_replaced(make_run, enter, tmp_path):
    runs, to = [make_run(seed=0), make_run(seed=1)], tmp_path / "entries"
    (path,) = enter(runs, to)
    path.write_text(path.read_text().replace('"outdated": false', '"outdated": true'))
    enter(runs[:1], to)
    assert read_entry(path).outdated
    enter(runs, to)
    assert not read_entry(path).outdated


def test_a_folder_of_runs_gives_an_entry_per_setting(make_run, enter, tmp_path):
    make_run(), make_run("chronogs"), make_run("chronogs", seed=1)
    make_run("4dgs", device="cuda (Test)")
    written = enter([tmp_path / "runs"], tmp_path / "entries")
    assert len({*written}) == 3
    assert sorted(len(read_entry(path).runs) for path in written) == [1, 1, 2]


def test_two_commands_at_a_time_add_both_of_their_runs(honest, tmp_path, monkeypatch):
    runs = [honest / f"runs/yard/3dgs-joint-fast/seed{i}" for i in (0, 1)]
    to, others = tmp_path / "entries", []

    def copy(source, place):
        if not others:  # the entries are read by now
            others.append(Thread(target=submit, args=[runs[1:], to]))
            others[0].start()
            others[0].join(2)
        return _copy_predictions(source, place)

    monkeypatch.setattr("leaderboard.submit._copy_predictions", copy)
    (path,) = submit(runs[:1], to)
    others[0].join()
    assert [run.record.seed for run in read_entry(path).runs] == [0, 1]


def test_options_with_several_values_are_entered(make_run, enter, tmp_path):
    """`as_typed` writes them so."""
    variant = "offset_lr=[0.01, 1e-05],sh_degree=2"
    (path,) = enter([make_run(variant=variant)], tmp_path / "entries")
    assert read_entry(path).runs[0].record.variant == variant
    with pytest.raises(ConfigError, match="variant is no list of options"):
        enter([make_run(variant="offset_lr=[1, 2] [code 1]")], tmp_path / "entries")


def test_devices_have_entries_of_their_own(make_run, enter, tmp_path):
    enter([make_run()], tmp_path / "entries")
    enter([make_run(device="cuda (Test)")], tmp_path / "entries")
    assert len(read_board(tmp_path / "entries").standings) == 2


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


def test_a_scene_that_only_has_the_name_of_a_known_one_is_refused(make_run, tmp_path):
    run = make_run(scene="demo")
    found = r"than demo has in scenes\.toml .*; .* a scene of yours must not be named like one in"
    with pytest.raises(ConfigError, match=rf"expected a finished run .*, found another .*{found}"):
        submit([run], tmp_path / "entries")
    assert not (tmp_path / "entries").exists()


def test_a_value_without_its_image_is_refused(make_run, tmp_path):
    run = make_run()
    manifest = run / "predictions/manifest.json"
    document = json.loads(manifest.read_text())
    del document["images"][0]
    manifest.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="other views in its rows than among its predictions"):
        submit([run], tmp_path / "entries")


def test_a_run_without_values_of_a_view_that_counts_is_refused(make_run, tmp_path):
    run = make_run()
    rows = [row for row in read_rows(run) if row.view != "1/view2.png"]
    record = read_run(run)
    record.aggregates, record.periods = aggregate(rows)
    write_run(run, record, rows)
    with pytest.raises(ConfigError, match=r"values of '1/view2\.png', whose photo .*found none;"):
        submit([run], tmp_path / "entries")


def test_images_of_another_program_are_refused(make_run, tmp_path):
    run = make_run(strategy="external", preset="images")
    with pytest.raises(ConfigError, match=r"images of another program .*: name the runs of bench"):
        submit([run], tmp_path / "entries")


def test_a_run_with_changed_means_is_refused(make_run, tmp_path):
    run = make_run()
    record = read_run(run)
    record.aggregates["macro"]["psnr"] = 99.0
    write_run(run, record, read_rows(run))
    with pytest.raises(ConfigError, match="the means are not those of the views"):
        submit([run], tmp_path / "entries")


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"expected a folder of runs.*run bench first"):
        submit([tmp_path], tmp_path / "entries")


def test_values_that_are_not_those_of_the_images_are_refused(honest, tmp_path):
    shutil.copytree(honest / "runs", tmp_path / "runs")
    run = tmp_path / "runs/yard/4dgs-joint-fast/seed0"
    record, rows = read_run(run), read_rows(run)
    rows = [replace(row, value=row.value + (row.metric == "psnr")) for row in rows]
    record.aggregates, record.periods = aggregate(rows)
    write_run(run, record, rows)
    text = r"seed0, seed 0: expected psnr 1\d\.\d* for '0/0.png', as its image has, found 1\d\.\d*;"
    with pytest.raises(ConfigError, match=text):
        submit([run], tmp_path / "entries")
    assert not (tmp_path / "entries").exists()


def test_predictions_are_copied_with_their_manifest(honest, tmp_path):
    run = honest / "runs/yard/3dgs-joint-fast/seed1"
    (path,) = submit([run], tmp_path / "entries")
    there = predictions_folder(path, 1)
    names = {file.relative_to(there) for file in there.rglob("*") if file.is_file()}
    assert {str(name) for name in names} == {
        "manifest.json",
        *(f"{i}/{k}.png.png" for i in (0, 1) for k in (0, 2)),
    }
    assert (there / "manifest.json").read_text() == (run / "predictions/manifest.json").read_text()
    assert len(read_board(tmp_path / "entries", [honest / "yard"]).standings) == 1
