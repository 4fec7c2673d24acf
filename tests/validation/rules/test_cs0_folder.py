import shutil

import pytest

from chronoscene.convert import convert
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.validation.repair.fix import fix_scene
from chronoscene.validation.run import find_folders, other_format, validate_scene


def test_no_images_folder(scene):
    scene.path("images").rename(scene.path("photos"))
    report = scene.expect("CS001", place="images", found="'photos', 'sparse'")
    assert report.summary.image_files == 0


def test_misplaced_model_is_read_all_the_same(scene):
    for stem in ("cameras", "images", "points3D"):
        scene.path(f"sparse/0/{stem}.txt").rename(scene.path(f"sparse/{stem}.txt"))
    scene.replace("sparse/images.txt", "a000.png", "a999.png")
    scene.replace("sparse/split.txt", "a000.png", "a999.png")
    also = {"CS201", "CS202"}  # the other rules have looked at it
    scene.expect("CS002", place="sparse/0", found="a model in sparse/", also=also)


def test_several_models(scene):
    shutil.copytree(scene.path("sparse/0"), scene.path("sparse/1"))
    scene.expect("CS003", place="sparse", found="also 'sparse/1'")


def test_empty_folders_beside_the_model_are_nothing(scene):
    scene.path("sparse/1").mkdir()
    assert "CS003" not in {f.code for f in scene.validate().findings}


def test_bad_periods_json(scene):
    scene.write("sparse/periods.json", '[{"id": 0}, {"id": 2}]')
    scene.expect("CS004", place="sparse/periods.json", found="other ids")


def test_good_side_files_are_silent(scene):
    scene.write("sparse/periods.json", '[{"id": 0, "label": "before"}, {"id": 1}]')
    scene.write("sparse/world.json", '{"unit": "metre"}')
    assert not {"CS004", "CS005"} & {f.code for f in scene.validate().findings}


def test_bad_world_json(scene):
    scene.write("sparse/world.json", '{"unit": "feet"}')
    scene.expect("CS005", place="sparse/world.json", found="'feet'")


def test_reader_has_the_last_word(scene, monkeypatch):
    def refuse(path):
        place = path / "sparse/0"
        raise SceneError(place, expected="a model", found="one it hates", todo="ask it why")

    monkeypatch.setattr(our_format, "read", refuse)
    report = scene.expect("CS009", place="sparse/0", found="one it hates")
    assert next(f for f in report.findings if f.code == "CS009").remedy == "ask it why"


def test_reader_is_not_asked_where_other_rules_found_errors(scene):
    scene.path("images/a000.png").unlink()
    report = scene.validate()
    assert ("CS009", "other rules found errors") in [(s.code, s.reason) for s in report.skipped]


def test_models_behind_a_gap_and_without_the_first_one(scene):
    shutil.copytree(scene.path("sparse/0"), scene.path("sparse/3"))
    scene.expect("CS003", found="also 'sparse/3'")
    shutil.rmtree(scene.path("sparse/0"))
    scene.expect("CS002", place="sparse/0", found="a model in sparse/3/", also={"CS321", "CS706"})


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
    assert said.found == "a scene in nerfstudio"
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
    assert {s.reason for s in report.skipped} == {"the folder cannot be read as nerfstudio"}


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
    with pytest.raises(ConfigError, match="found one in nerfstudio; convert it"):
        fix_scene(studio, tmp_path / "fixed")
    assert not (tmp_path / "fixed").exists()
