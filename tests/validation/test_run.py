"""Finding scenes, running rules, and what happens when a rule itself fails."""

import hashlib
import random

import pytest
from fresh_process import loaded_by

from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.formats import read_scene
from chronoscene.validation.rule import SEVERITIES, Hit, Rule
from chronoscene.validation.run import find_folders, validate_scene


def make_rule(check, *, needs=(), severity="error", last=False):
    return Rule(
        "CS299", "made-up", severity, "What.", "do it", "bad", ("scene",), needs, last, check
    )


def test_good_scene(scene):
    report = scene.validate()
    assert [f.code for f in report.findings] == ["CS507"]
    assert (report.name, report.path) == ("scene", scene.root)
    assert report.summary.images == 18
    assert report.summary.points == 40
    assert report.summary.observations == 720
    assert [s.code for s in report.skipped] == ["CS206", "CS231", "CS604"]


def test_all_problems_are_collected(scene):
    scene.path("images/a000.png").unlink()
    scene.replace("sparse/split.txt", "a001.png 0", "a001.png x")
    scene.edit_fields("sparse/0/images.txt", 4, {5: "nan"})
    scene.edit_fields("sparse/0/points3D.txt", 0, {1: "inf"})
    codes = {f.code for f in scene.validate().findings}
    assert {"CS201", "CS304", "CS121", "CS502"} <= codes


def test_findings_are_sorted_by_severity_then_code(scene):
    scene.path("images/a000.png").unlink()
    scene.write("sparse/0/test.txt", "a003.png\nnobody\n")
    keys = [(SEVERITIES.index(f.severity), f.code) for f in scene.validate().findings]
    assert keys == sorted(keys)
    assert len({k[0] for k in keys}) == 3


def test_nothing_is_written(scene):
    def state():
        return {
            (str(p), p.stat().st_mtime_ns, p.is_file() and hashlib.sha256(p.read_bytes()).digest())
            for p in scene.root.rglob("*")
        }

    before = state()
    scene.validate(decode=True)
    assert state() == before


def test_one_damaged_file_does_not_hide_problems_in_others(scene):
    scene.write("sparse/0/points3D.txt", "broken\n")
    scene.path("images/a000.png").unlink()
    report = scene.validate()
    assert {f.code for f in report.findings} == {"CS103", "CS201"}
    reasons = {s.code: s.reason for s in report.skipped}
    assert reasons["CS502"] == "the points of the model cannot be read"


def test_rule_that_fails_becomes_a_finding(scene):
    def fails(raw):
        yield Hit("here", "a", "b")
        raise ZeroDivisionError("oh dear")

    report = validate_scene(scene.root, rules=[make_rule(fails, severity="info")])
    assert [(f.code, f.severity) for f in report.findings] == [
        ("CS000", "error"),
        ("CS299", "info"),
    ]
    failed = report.findings[0]
    assert (failed.place, failed.found) == ("rule CS299", "ZeroDivisionError: oh dear")
    assert "report this" in failed.remedy


def test_part_that_cannot_be_read_for_a_mistake_of_ours(scene, monkeypatch):
    def fails(folder):
        raise ZeroDivisionError("oh dear")

    monkeypatch.setattr("chronoscene.validation.folder.scene_folder.read_raw_model", fails)
    scene.path("sparse/split.txt").unlink()
    report = scene.validate()
    assert {f.code for f in report.findings} == {"CS000", "CS301"}
    assert report.summary.images is None


def test_remedy_of_the_rule_unless_the_hit_has_one(scene):
    def speaks(raw):
        yield Hit("here", "a", "b")
        yield Hit("there", "a", "b", "do that", count=7)

    report = validate_scene(scene.root, rules=[make_rule(speaks)])
    assert [(f.remedy, f.count) for f in report.findings] == [("do it", 1), ("do that", 7)]
    assert str(report.findings[0]) == "here: expected a, found b"


def test_rule_is_skipped_without_what_it_needs(scene):
    scene.write("sparse/0/images.txt", "broken\n")
    report = validate_scene(scene.root, rules=[make_rule(lambda raw: 1 / 0, needs=("images",))])
    assert not report.findings
    assert [s.reason for s in report.skipped] == ["the images of the model cannot be read"]


@pytest.mark.parametrize(("severity", "runs"), [("error", False), ("warning", True)])
def test_last_rule_runs_only_without_errors(scene, severity, runs):
    calls = []
    speaks = make_rule(lambda raw: [Hit("a", "b", "c")], severity=severity)
    last = make_rule(lambda raw: calls.append(raw) or [], last=True)
    validate_scene(scene.root, rules=[last, speaks])
    assert bool(calls) == runs


def test_texts_of_findings_are_printable(scene):
    def speaks(raw):
        yield Hit("a\nb", "c\x1b[31m", "d\udcff", "e\0")

    (finding,) = validate_scene(scene.root, rules=[make_rule(speaks)]).findings
    assert (finding.place, finding.expected) == ("a\\nb", "c\\x1b[31m")
    assert (finding.found, finding.remedy) == ("d\\udcff", "e\\x00")


def test_find_one_scene(scene):
    assert find_folders(scene.root) == [scene.root]


def test_find_scenes_in_a_folder(scene, tmp_path):
    (tmp_path / "another/images").mkdir(parents=True)
    (tmp_path / "notes").mkdir()
    assert find_folders(tmp_path) == [tmp_path / "another", scene.root]


def test_no_scene_at_all(tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(SceneError, match="expected a scene"):
        find_folders(tmp_path)
    with pytest.raises(SceneError, match="found nothing; check the path"):
        find_folders(tmp_path / "absent")
    (tmp_path / "file").write_text("x")
    with pytest.raises(SceneError, match="found a file"):
        find_folders(tmp_path / "file")


@pytest.mark.parametrize("place", ["dense", "dense/0"])
def test_a_model_that_other_commands_find_is_found(scene, tmp_path, place):
    """As COLMAP leaves it: undistorted, with the images beside it."""
    project = tmp_path / "project"
    (project / place).mkdir(parents=True)
    scene.path("images").rename(project / place / "images")
    scene.path("sparse/0").rename(project / place / "sparse")
    assert find_folders(project) == [project]
    findings = {f.code: f for f in validate_scene(project).findings}
    assert f"a model in {place}/sparse/" in findings["CS002"].found
    assert "--period-by" in findings["CS301"].remedy


def test_empty_scene_folder_gives_findings(tmp_path):
    (tmp_path / "images").mkdir()
    codes = {f.code for f in validate_scene(tmp_path).findings}
    assert codes == {"CS101", "CS301", "CS321"}


@pytest.mark.parametrize("form", ["text", "binary", "rigs"])
def test_random_damage_gives_findings_never_an_exception(scene, form):
    """And whatever the reader refuses has an error; and no rule fails."""
    if form != "text":
        scene.to_binary(classic=form == "binary")
    files = sorted(p for p in scene.path("sparse").rglob("*") if p.is_file())
    rng = random.Random(11)
    for _ in range(25):
        path = rng.choice(files)
        good = path.read_bytes()
        data = bytearray(good)
        for _ in range(rng.choice([1, 2, 20])):
            data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.choice([len(data), rng.randrange(len(data))])])
        findings = scene.validate().findings
        assert "CS000" not in {f.code for f in findings}, findings
        if not any(f.severity == "error" for f in findings):
            read_scene(scene.root)
        path.write_bytes(good)


def test_what_the_reader_refuses_has_an_error(scene):
    scene.replace("sparse/split.txt", "a001.png 0\n", "")
    with pytest.raises(ChronoSceneError):
        read_scene(scene.root)
    assert scene.validate().count("error")


def test_too_many_periods_for_a_table_of_points(scene, monkeypatch):
    monkeypatch.setattr("chronoscene.validation.folder.scene_folder.MAX_CELLS", 79)
    report = scene.validate()
    assert not report.findings
    skipped = {s.code for s in report.skipped if "too many periods" in s.reason}
    assert skipped == {"CS506", "CS507", "CS508"}


def test_each_image_a_period_of_its_own(scene):
    lines = [
        f"{name} {i}"
        for i, name in enumerate(sorted(p.name for p in scene.path("images").iterdir()))
    ]
    scene.write("sparse/split.txt", lines)
    assert "CS000" not in {f.code for f in scene.validate().findings}


def test_torch_is_not_imported():
    code = (
        "import chronoscene.cli.scenes.validate\n"
        "import chronoscene.validation.rules as r; r.all_rules()"
    )
    assert not loaded_by(code) & {"torch", "numba", "cv2", "pandas", "matplotlib"}


@pytest.mark.parametrize("name", ["plaza", "sheffield_scene"])
def test_good_real_scenes_have_no_error_and_no_warning(shared_data, name):
    report = validate_scene(shared_data / name, decode=True)
    assert [str(f) for f in report.findings if f.severity != "info"] == []
    assert not report.skipped
