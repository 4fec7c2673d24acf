"""chronoscene split: files written, source left alone, errors."""

import json
from functools import partial

import pytest
from command_line import invoke, refused

from chronoscene.errors import ConfigError
from chronoscene.formats import read_scene
from chronoscene.scene.splits import split_hash

PERIODS = {f"{'ab'[p]}/{i:02d}.png": p for p in (0, 1) for i in range(16)}


@pytest.fixture
def scene(make_scene_folder):
    return make_scene_folder(PERIODS)


run = partial(invoke, "split")


def snapshot(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_writes_the_list_and_what_made_it(scene, tmp_path):
    before = snapshot(scene)
    out = tmp_path / "lists/test.txt"
    result = run(scene, out, "--every", 4, "--offset", 1)
    assert result.exit_code == 0
    names = out.read_text().splitlines()
    assert names == [f"{f}/{i:02d}.png" for f in "ab" for i in (1, 5, 9, 13)]
    record = json.loads((tmp_path / "lists/test.json").read_text())
    assert (record["strategy"], record["fraction"], record["offset"]) == ("stratified", 0.25, 1)
    assert f"split hash {record['split_hash']}" in result.stdout
    assert "  period 0: 12 train, 4 test\n  period 1: 12 train, 4 test\n" in result.stdout
    assert snapshot(scene) == before


def test_the_list_makes_the_split_that_the_hash_names(scene, tmp_path):
    run(scene, tmp_path / "t.txt", "--strategy", "blocked", "--blocks", 4, "--fraction", 0.25)
    (scene / "sparse/0/test.txt").write_bytes((tmp_path / "t.txt").read_bytes())
    record = json.loads((tmp_path / "t.json").read_text())
    assert split_hash(read_scene(scene)) == record["split_hash"]


@pytest.mark.parametrize("option", [("--every", 8), ("--fraction", 0.125)])
@pytest.mark.parametrize("strategy", [("periods", "--period", 1), ("none",)])
def test_a_share_is_refused_where_it_has_no_effect(scene, tmp_path, option, strategy):
    message = f"{option[0]}: expected no such option with --strategy {strategy[0]}"
    with pytest.raises(ConfigError, match=message):
        run(scene, tmp_path / "t.txt", "--strategy", *strategy, *option)


def test_scene_out(scene, tmp_path):
    result = run(scene, "--scene-out", tmp_path / "new", "--seed", 1)
    assert result.exit_code == 0
    new = read_scene(tmp_path / "new")
    record = json.loads((tmp_path / "new/sparse/0/test.json").read_text())
    assert split_hash(new) == record["split_hash"] and new.split_rule == "sparse/0/test.txt"
    assert (tmp_path / "new/images/a/00.png").samefile(scene / "images/a/00.png")


@pytest.mark.parametrize("period", [1, "after the works"])
def test_whole_periods_are_remarked_upon(scene, tmp_path, period):
    labels = [{"id": 0}, {"id": 1, "label": "after the works"}]
    (scene / "sparse/periods.json").write_text(json.dumps(labels))
    result = run(scene, tmp_path / "t.txt", "--strategy", "periods", "--period", period)
    assert json.loads((tmp_path / "t.json").read_text())["periods"] == [1]
    assert "note: period 0 has no test images\n" in result.stdout
    assert "note: period 1 has no train images\n" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{scene}"], "give a file OUT, or --scene-out"),
        (["{scene}", "{tmp}/o", "--every", "4", "--fraction", "0.1"], "not both"),
        (["{scene}", "{tmp}/o", "--every", "1"], "2 or more is needed"),
        (["{scene}", "{scene}/sparse/0/test.txt"], "OUT {scene}/sparse/0/test.txt: expected a"),
        (["{scene}", ""], "the name of a file is needed"),
        (["{scene}", "--scene-out", "{scene}/new"], "--scene-out {scene}/new: expected a place"),
        (["{scene}", "{tmp}/there.txt"], "expected a new file, found an existing one"),
        (["{scene}", "{tmp}/other.txt"], "other.json: expected a new file"),
        (["{scene}", "{tmp}/there.txt/o"], "expected a file that can be written"),
        (
            ["{scene}", "{tmp}/o", "--strategy", "date"],
            "expected a date of capture for every image",
        ),
        (["{scene}", "{tmp}/o", "--fraction", "2"], "--fraction: expected a number between 0 and"),
        (["{tmp}/nowhere", "{tmp}/o"], "expected a scene folder, found nothing"),
    ],
)
def test_errors(scene, tmp_path, arguments, message):
    (tmp_path / "there.txt").write_text("mine")
    (tmp_path / "other.json").write_text("mine")
    before = snapshot(tmp_path)
    words = [a.format(tmp=tmp_path, scene=scene) for a in arguments]
    error = refused("split", *words)
    assert message.format(scene=scene) in error and "Traceback" not in error
    assert snapshot(tmp_path) == before


def test_a_list_that_its_record_would_replace_is_refused(scene, tmp_path):
    error = refused("split", scene, tmp_path / "a.json")
    assert "expected a name for the list that does not end in .json" in error
    assert not (tmp_path / "a.json").exists()


@pytest.mark.parametrize("strategy", [[], ["--seed", 3], ["--strategy", "blocked", "--seed", 3]])
def test_the_order_in_files_does_not_matter(make_scene_folder, tmp_path, strategy):
    scene = make_scene_folder(PERIODS, form="text")
    assert run(scene, tmp_path / "one.txt", *strategy).exit_code == 0
    images, split = scene / "sparse/0/images.txt", scene / "sparse/split.txt"
    lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
    pairs = list(zip(lines[0::2], lines[1::2], strict=True))
    images.write_text("".join(f"{a}\n{b}\n" for a, b in reversed(pairs)))
    split.write_text("\n".join(reversed(split.read_text().splitlines())))
    assert run(scene, tmp_path / "two.txt", *strategy).exit_code == 0
    assert (tmp_path / "one.txt").read_text() == (tmp_path / "two.txt").read_text()
    assert (tmp_path / "one.json").read_text() == (tmp_path / "two.json").read_text()


def test_scene_out_names_what_is_left_out(scene, tmp_path):
    (scene / "gt").mkdir()
    note = "note: not part of the format, and not converted: gt/\n"
    assert note in run(scene, "--scene-out", tmp_path / "new").stderr
    assert note not in run(scene, tmp_path / "test.txt").stderr


def test_scene_out_has_the_records_of_a_registration(scene, tmp_path):
    for name in ("georeference.json", "registration.json"):
        (scene / name).write_text(f"{name} of register")
    result = run(scene, "--scene-out", tmp_path / "new")
    assert "not converted" not in result.stderr
    for name in ("georeference.json", "registration.json"):
        assert (tmp_path / "new" / name).read_text() == f"{name} of register"
