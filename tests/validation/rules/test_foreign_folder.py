"""Scenes of other formats are checked as they would be converted."""

import shutil

import pytest

from chronoscene.convert import convert
from chronoscene.errors import ConfigError
from chronoscene.validation.other_formats import other_format
from chronoscene.validation.repair.fix import fix_scene
from chronoscene.validation.run import find_folders, validate_scene


@pytest.fixture
def studio(scene, tmp_path):
    """The good scene in nerfstudio's format."""
    return convert(scene.root, tmp_path / "studio", target="nerfstudio").out


def codes(report):
    return {f.code for f in report.findings}


def test_scene_of_another_format(studio):
    before = sorted(studio.rglob("*"))
    report = validate_scene(studio, decode=True)
    assert (report.name, report.path) == ("studio", studio)
    assert report.summary.images == 14 and len(report.summary.periods) == 2
    # It has no tracks: that is what the format cannot say.
    assert codes(report) == {"CS006", "CS507", "CS509", "CS514"}
    said = next(f for f in report.findings if f.code == "CS006")
    assert said.found == "one in nerfstudio"
    assert sorted(studio.rglob("*")) == before


def test_faults_of_a_scene_of_another_format(studio):
    shutil.copy(studio / "images/a001.png", studio / "images/b002.png")
    found = {(f.code, f.place) for f in validate_scene(studio).findings if f.severity == "error"}
    assert found == {("CS602", "images/a001.png"), ("CS514", "sparse/0/points3D.bin")}


def test_what_is_left_out_of_another_format(studio):
    (studio / "images/a000.png").unlink()
    (finding,) = [f for f in validate_scene(studio).findings if f.code == "CS008"]
    assert "1 frame" in finding.found


def test_scene_of_another_format_that_cannot_be_read(studio):
    (studio / "transforms.json").write_text('{"frames": [{"file_path": 3}]}')
    report = validate_scene(studio)
    (finding,) = report.findings
    assert (finding.code, finding.severity) == ("CS007", "error")
    assert "transforms.json" in finding.place
    assert {s.reason for s in report.skipped} == {"it cannot be read as nerfstudio"}


def test_folders_of_other_formats_are_found(scene, studio, tmp_path):
    (tmp_path / "notes").mkdir()
    shutil.rmtree(studio / "images")  # then transforms.json alone tells
    assert find_folders(tmp_path) == [scene.root, studio]


def test_a_model_in_its_place_is_of_our_format(scene):
    """Even where the folders of its images could be periods: the missing file is the fault."""
    scene.path("sparse/split.txt").unlink()
    shutil.move(scene.path("images"), scene.path("images_"))
    scene.path("images").mkdir()
    shutil.move(scene.path("images_"), scene.path("images/2016"))
    assert other_format(scene.root) is None
    assert "CS301" in codes(scene.validate())


def test_other_formats_are_not_corrected(studio, tmp_path):
    with pytest.raises(ConfigError, match="found one in nerfstudio; chronoscene convert"):
        fix_scene(studio, tmp_path / "fixed")
    assert not (tmp_path / "fixed").exists()
