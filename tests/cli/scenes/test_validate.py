"""chronoscene validate: exit status, options, where the report goes."""

import json
import os
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner
from command_line import invoke, refused

from chronoscene.cli import cli
from chronoscene.cli.scenes.validate import _check
from chronoscene.errors import ConfigError

PERIODS = {f"{'ab'[p]}{i}.png": p for p in (0, 1) for i in range(7)}


def run(*arguments):
    """Exit status and standard output."""
    result = invoke("validate", *arguments)
    return result.exit_code, result.stdout


@pytest.fixture
def good(make_scene_folder) -> Path:
    return make_scene_folder(PERIODS, tests=["a3", "b3"])


@pytest.fixture
def warned(good) -> Path:
    (good / "sparse/0/test.txt").write_text("a3\nb3\nnobody\n")
    return good


@pytest.fixture
def broken(good) -> Path:
    (good / "images/a0.png").unlink()
    return good


def test_good_scene(good):
    status, text = run(good)
    assert status == 0
    assert text.startswith("scene: 14 images, 1 camera, 30 points, 2 periods (0: 6 + 1 test")
    assert "0 errors, 0 warnings" in text


def test_errors_make_status_1(broken):
    status, text = run(broken)
    assert status == 1
    assert "images/a0.png: expected an image, found nothing" in text


@pytest.mark.parametrize(("options", "expected"), [([], 0), (["--strict"], 1)])
def test_warnings_count_when_strict(warned, options, expected):
    status, text = run(warned, *options)
    assert status == expected
    assert "1 warning" in text


@pytest.fixture
def one_process(monkeypatch):
    """Scenes are checked here: starting processes takes longer than tiny scenes do."""
    monkeypatch.setattr(
        "chronoscene.cli.scenes.validate.map_parallel", lambda f, items, lost: map(f, items)
    )


def test_folder_of_scenes(make_scene_folder, tmp_path, one_process):
    for name in ("one", "two"):
        make_scene_folder(PERIODS, name=f"all/{name}", tests=["a3", "b3"])
    (tmp_path / "all/two/images/a0.png").unlink()
    status, text = run(tmp_path / "all")
    assert status == 1
    assert "2 scenes, 1 not valid" in text


def test_json(broken):
    status, text = run(broken, "--format", "json")
    document = json.loads(text)
    assert status == 1 and not document["valid"]
    assert document["scenes"][0]["findings"][0]["code"] == "CS201"


def test_out(broken, tmp_path):
    status, text = run(broken, "--format", "json", "--out", tmp_path / "report.json")
    assert (status, text) == (1, "")
    assert json.loads((tmp_path / "report.json").read_text())["counts"]["error"] == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.json", "scene"]


def test_reports_for_programs_and_people_beside_the_text(broken, tmp_path):
    status, text = run(broken, "--sarif", tmp_path / "r.sarif", "--html", tmp_path / "r.html")
    assert status == 1 and text.startswith("scene: ")
    assert json.loads((tmp_path / "r.sarif").read_text())["version"] == "2.1.0"
    assert "images/a0.png" in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(("form", "begin"), [("sarif", "{"), ("html", "<!doctype html>")])
def test_other_formats(broken, form, begin):
    status, text = run(broken, "--format", form)
    assert status == 1 and text.startswith(begin)


def test_out_has_no_colours(broken, tmp_path):
    run(broken, "--out", tmp_path / "report.txt")
    assert "\x1b" not in (tmp_path / "report.txt").read_text()


def test_lines_of_a_file_are_not_broken(broken, tmp_path, monkeypatch):
    expected = run(broken)[1]
    monkeypatch.setattr(
        "chronoscene.cli.scenes.validate.terminal_width", lambda out: None if out else 50
    )
    assert run(broken)[1] != expected
    run(broken, "--out", tmp_path / "report.txt")
    assert (tmp_path / "report.txt").read_text() == expected


@pytest.mark.parametrize("options", [[], ["--dataset-format", "chronoscene"]])
def test_periods_of_our_format_cannot_be_chosen(good, options):
    with pytest.raises(ConfigError, match="no such option for chronoscene"):
        run(good, "--period-by", "year", *options)


def test_ignore_makes_a_scene_valid(broken):
    status, text = run(broken, "--ignore", "CS201")
    assert status == 0
    assert "CS201" not in text


@pytest.mark.parametrize(
    "options", [["--select", "CS3,CS1"], ["--select", "CS3", "--select", "CS1"]]
)
def test_select(broken, options):
    assert run(broken, *options)[0] == 0
    assert run(broken, "--select", "image-missing")[0] == 1


def test_decode(good):
    assert "not checked (images are decoded only with --decode): CS206" in run(good)[1]
    status, text = run(good, "--decode")
    assert status == 0 and "not checked" not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/absent"], "expected a scene folder, found nothing"),
        (["{tmp}/empty"], "expected a scene (a folder with images/ and sparse/)"),
        (["{scene}", "--select", "CS999"], "--select: expected rule codes"),
        (["{scene}", "--out", "{tmp}/absent/report"], "No such file or directory"),
    ],
)
def test_nothing_to_read_or_wrong_usage_is_status_2(good, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    words = [a.format(tmp=tmp_path, scene=good) for a in arguments]
    error = refused("validate", *words)
    assert message in error and error.count("\n") == 1


def test_names_that_the_output_cannot_encode(good, monkeypatch):
    split = good / "sparse/split.txt"
    split.write_text(split.read_text() + "пусто.png 1\n", encoding="utf-8")
    result = CliRunner(charset="ascii").invoke(cli, ["validate", str(good)])
    assert result.exit_code == 0
    assert "\\u043f" in result.stdout


def test_fix_reports_what_it_did_and_what_remains(warned, tmp_path):
    (warned / "images/a0.png").unlink()
    result = invoke("validate", warned, "--fix", tmp_path / "fixed")
    assert result.exit_code == 1
    expected = "fixed: 2 corrections\n  also: 2 names in test.txt written in full\n  CS324: 1 line "
    assert expected in result.stderr
    assert "CS201" in result.stdout and "CS324" not in result.stdout
    assert (tmp_path / "fixed/sparse/0/test.txt").read_text() == "a3.png\nb3.png\n"


def test_fix_of_several_scenes(make_scene_folder, tmp_path, one_process):
    for name in ("one", "two"):
        make_scene_folder(PERIODS, name=f"all/{name}", tests=["a3", "b3"])
    status, text = run(tmp_path / "all", "--fix", tmp_path / "fixed")
    assert status == 0 and "2 scenes, 0 not valid" in text
    assert sorted(p.name for p in (tmp_path / "fixed").iterdir()) == ["one", "two"]


def test_no_copy_is_written_if_one_of_several_scenes_cannot_be(make_scene_folder, tmp_path):
    make_scene_folder(PERIODS, name="all/one", tests=["a3", "b3"])
    (tmp_path / "all/two").mkdir()
    (tmp_path / "all/two/transforms.json").write_text('{"frames": []}')
    with pytest.raises(ConfigError, match="found one in nerfstudio"):
        run(tmp_path / "all", "--fix", tmp_path / "fixed")
    assert not (tmp_path / "fixed").exists()


def test_fix_into_the_scene_is_refused(good):
    error = refused("validate", good, "--fix", good / "fixed")
    assert f"expected a place outside the scene, found one in {good}" in error


def test_explain():
    status, text = run("--explain", "pose-leak,CS201")
    assert status == 0
    what = "The file of a registered image is missing."
    assert text.startswith(f"error CS201 image-missing: {what}\n  for exam")
    assert "\nwarning CS605 pose-leak: A test image has the pose" in text
    assert text.count("  to do: ") == 2


def test_explain_nothing_that_is_there():
    assert "--explain: expected rule codes" in refused("validate", "--explain", "CS999")


@pytest.mark.parametrize("option", ["--out", "--sarif", "--html"])
def test_reports_are_not_written_into_a_scene(broken, option, monkeypatch):
    with pytest.raises(ConfigError, match=f"{option} .*: expected a place outside the scene"):
        run(broken, option, broken / "report")
    assert not (broken / "report").exists()


@pytest.mark.parametrize("option", ["--out", "--sarif", "--html"])
def test_places_of_reports_are_tried_first(broken, option, tmp_path, monkeypatch):
    monkeypatch.setattr("chronoscene.cli.scenes.validate.validate_scene", lambda *_, **__: 1 / 0)
    with pytest.raises(ConfigError, match=f"{option} .*found Is a directory"):
        run(broken, option, tmp_path)
    with pytest.raises(ConfigError, match=f"{option} .*found No such file"):
        run(broken, option, tmp_path / "absent/report")


def die_on_b(select, ignore, decode, options, path, **_):
    if path.name == "b":
        os.kill(os.getpid(), signal.SIGKILL)  # as a system does that is out of memory
    return _check(select, ignore, decode, options, path)


def test_a_check_that_dies_leaves_the_others(make_scene_folder, tmp_path, monkeypatch):
    for name in "abc":
        make_scene_folder(PERIODS, name=f"all/{name}", tests=["a3", "b3"])
    monkeypatch.setattr("chronoscene.cli.scenes.validate._check", die_on_b)
    status, text = run(tmp_path / "all", "--format", "json")
    scenes = {s["name"]: s for s in json.loads(text)["scenes"]}
    assert status == 1 and scenes.keys() == {"a", "b", "c"}
    assert [f["code"] for f in scenes["b"]["findings"]] == ["CS000"]
    assert scenes["c"]["summary"]["images"] == 14
