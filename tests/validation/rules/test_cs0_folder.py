import json
import shutil

import pytest
from PIL import Image

from chronoscene import formats
from chronoscene.colmap import raw_model
from chronoscene.convert import convert
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import neusc
from chronoscene.validation.repair.fix import check_fixable, fix_scene
from chronoscene.validation.run import ReadOptions, find_folders, other_format, validate_scene

ALONE = {"CS321", "CS706"}  # What is said of a scene without sparse/0/test.txt


def test_a_model_where_nobody_looks(scene):
    scene.path("out").mkdir()
    scene.path("sparse/0").rename(scene.path("out/model"))
    (finding,) = [f for f in scene.validate().findings if f.code == "CS101"]
    assert (finding.found, finding.remedy) == (
        "one in out/model",
        "copy the model in out/model to sparse/0",
    )


def test_a_part_of_a_project(project):
    for part in ("sparse/0", "sparse", "images", "images/2016"):
        todo = f"give the folder of the whole project, {project.root}$"
        with pytest.raises(SceneError, match=f"found a part of one; {todo}"):
            find_folders(project.path(part))


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


def test_a_misplaced_model_of_other_images(scene, tmp_path):
    scene.path("distorted/sparse").mkdir(parents=True)
    scene.path("sparse/0").rename(scene.path("distorted/sparse/0"))
    shutil.copytree(scene.path("images"), scene.path("input"))
    report = scene.expect("CS002", found="distorted/sparse/0/, of the images in input/", also=ALONE)
    (finding,) = [f for f in report.findings if f.code == "CS002"]
    assert finding.remedy == "move the model files to sparse/0/, and these images to images/"
    assert fix_scene(scene.root, tmp_path / "fixed") == []  # it would go with the wrong images
    message = r"sparse/0: expected the COLMAP model, found one in distorted/.*and the images to im"
    with pytest.raises(SceneError, match=message):
        our_format.read(scene.root)


def test_several_models(scene):
    shutil.copytree(scene.path("sparse/0"), scene.path("sparse/1"))
    scene.expect("CS003", place="sparse", found="also 'sparse/1'")


def test_empty_folders_beside_the_model_are_nothing(scene):
    scene.path("sparse/1").mkdir()
    assert "CS003" not in {f.code for f in scene.validate().findings}


def test_bad_periods_json(scene):
    scene.write("sparse/periods.json", '[{"id": 0}, {"id": 2}]')
    scene.expect("CS004", place="sparse/periods.json", found="0, 2")


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
    assert report.summary.images == 18 and len(report.summary.periods) == 2
    # It has no tracks: that is what the format cannot say.
    assert codes(report) == {"CS006", "CS503", "CS507", "CS509"}
    said = next(f for f in report.findings if f.code == "CS006")
    assert said.found == "a scene in nerfstudio"
    assert sorted(studio.rglob("*")) == before


def test_masks_of_a_scene_of_another_format(scene, tmp_path):
    scene.path("masks").mkdir()
    for name in scene.lines("sparse/0/test.txt"):
        Image.new("L", (9, 9)).save(scene.path(f"masks/{name}.png"))
    studio = convert(scene.root, tmp_path / "studio", target="nerfstudio").out
    assert {"CS242", "CS245"} <= codes(validate_scene(studio, decode=True))


def test_faults_of_a_scene_of_another_format(studio):
    shutil.copy(studio / "images/a001.png", studio / "images/b002.png")
    found = {(f.code, f.place) for f in validate_scene(studio).findings if f.severity == "error"}
    assert found == {("CS602", "images/a001.png")}


def test_what_is_left_out_of_another_format(studio):
    (studio / "images/a000.png").unlink()
    (finding,) = [f for f in validate_scene(studio).findings if f.code == "CS008"]
    assert "1 frame" in finding.found


@pytest.mark.parametrize(
    ("target", "rule"), [("cl-splats", "every 8th image of all"), ("neusc", "every 10th image")]
)
def test_a_list_of_test_images_that_is_not_read(scene, tmp_path, target, rule):
    other = convert(scene.root, tmp_path / target, target=target).out
    assert "CS008" not in codes(validate_scene(other))
    (other / "sparse/0").mkdir(parents=True, exist_ok=True)
    (other / "sparse/0/test.txt").write_text("a000.png\n")
    (finding,) = [f for f in validate_scene(other).findings if f.code == "CS008"]
    assert finding.found.startswith(f"sparse/0/test.txt is not read; split: {rule}")


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


def test_a_list_of_periods_in_a_wrong_place_is_of_our_format(project):
    """Even where the folders of its images could be periods: the file is meant to count."""
    assert other_format(project.root).name == "colmap-folders"
    project.write("split.txt", "")
    assert other_format(project.root) is None
    assert "CS301" in codes(project.validate())


@pytest.fixture
def project(scene):
    """The good scene as a COLMAP project: no split.txt, images in ``2016/`` and ``2023/``."""
    for letter, year in (("a", "2016"), ("b", "2023")):
        scene.path(f"images/{year}").mkdir()
        for image in sorted(scene.path("images").glob(f"{letter}*")):
            image.rename(image.parent / year / image.name)
            for place in ("sparse/0/images.txt", "sparse/0/test.txt"):
                if image.name in scene.path(place).read_text():
                    scene.replace(place, image.name, f"{year}/{image.name}")
    scene.path("sparse/split.txt").unlink()
    return scene


def test_colmap_project(project):
    report = project.validate(decode=True)
    assert codes(report) == {"CS006", "CS507"}
    (said,) = [f for f in report.findings if f.code == "CS006"]
    assert said.found == "a scene in colmap-folders, with the periods '2016', '2023'"
    assert [(p.label, p.images, p.test) for p in report.summary.periods] == [
        ("2016", 9, 3),
        ("2023", 9, 3),
    ]
    assert {s.reason for s in report.skipped} == {
        "sparse/split.txt is no part of a COLMAP project",
        "the released code does not read colmap-folders",
    }


def test_faults_of_a_colmap_project_are_all_found_where_they_are(project):
    shutil.copy(project.path("images/2016/a001.png"), project.path("images/2023/b002.png"))
    project.path("images/2016/a000.png").unlink()
    project.write("sparse/0/points3D.txt", "broken\n")
    project.write("sparse/0/test.txt", "2016/a003.png\nnobody\n")
    found = {(f.code, f.place) for f in project.validate().findings}
    assert found == {
        ("CS006", "."),
        ("CS103", "sparse/0/points3D.txt:1"),
        ("CS201", "images/2016/a000.png"),
        ("CS324", "sparse/0/test.txt:2"),
        ("CS404", "sparse/0/test.txt"),
        ("CS602", "images/2016/a001.png"),
    }


def test_the_model_of_a_project_may_be_where_its_program_left_it(project):
    model = project.path("colmap/sparse/0")
    model.parent.mkdir(parents=True)
    project.path("sparse/0").rename(model)
    report = project.validate()
    said = {f.code: f.found for f in report.findings}
    assert said.keys() == {"CS006", "CS321", "CS507"}
    assert said["CS006"].endswith(
        "; the model is read from colmap/sparse/0, the images from images"
    )


def test_the_reader_of_a_project_has_the_last_word(project, monkeypatch):
    def refuse(path, **_):
        raise SceneError(path / "images", expected="better ones", found="these", todo="go")

    monkeypatch.setattr("chronoscene.formats.colmap_folders.read", refuse)
    (said,) = [f for f in project.validate().findings if f.severity == "error"]
    assert (said.code, said.place, said.found) == ("CS009", "images", "these")


def test_images_of_a_project_outside_of_its_periods(project):
    project.replace("sparse/0/images.txt", "2016/a000.png", "a000.png")
    errors = {f.code: f for f in project.validate().findings if f.severity == "error"}
    assert errors.keys() == {"CS007", "CS201"}  # and no word of split.txt
    assert (errors["CS007"].place, errors["CS007"].found) == ("images", "'a000.png'")


def test_dates_that_contradict_the_folders_of_a_project(project):
    for i in range(9):
        image, exif = project.path(f"images/2023/b00{i}.png"), Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = "2016:05:03 12:00:00"
        exif[0x8769] = 0
        pixels = Image.open(image)
        pixels.save(image, exif=exif)
    (said,) = [f for f in project.validate().findings if f.code == "CS221"]
    assert said.place == "images"
    assert (said.expected[-10:], said.found) == ("2016-05-03", "2023")


def test_projects_whose_test_images_their_format_chooses(project, tmp_path):
    street = project.root.rename(tmp_path / "street")  # a name of WAT, which has no test.txt
    assert [p.test for p in validate_scene(street).summary.periods] == [3, 3]
    (street / "sparse/0/test.txt").write_text("")
    report = validate_scene(street, options=ReadOptions("wat"))
    assert [(p.images, p.test) for p in report.summary.periods] == [(9, 2), (9, 2)]
    assert codes(report) == {"CS006", "CS008", "CS507"}
    (street / "sparse/0/test.txt").unlink()
    report = validate_scene(street)
    assert [(p.images, p.test) for p in report.summary.periods] == [(9, 2), (9, 2)]
    assert codes(report) == {"CS006", "CS507"}


def test_a_project_of_two_formats(project, tmp_path):
    (project.path("images/2016")).rename(project.path("images/t10"))
    (project.path("images/2023")).rename(project.path("images/t2"))
    for old, new in (("2016/", "t10/"), ("2023/", "t2/")):
        project.replace("sparse/0/images.txt", old, new)
    project.path("sparse/0/test.txt").unlink()
    street = project.root.rename(tmp_path / "street")
    (said,) = [f for f in validate_scene(street).findings if f.code in ("CS007", "CS301")]
    assert (said.code, said.found) == ("CS007", "marks of colmap-folders and wat")
    for format, labels in (("wat", "'t10', 't2'"), ("colmap-folders", "'t2', 't10'")):
        report = validate_scene(street, options=ReadOptions(format))
        assert labels in next(f.found for f in report.findings if f.code == "CS006")


def test_what_the_user_says_of_a_project(scene, tmp_path):
    """Flat folders have the periods that a table names; and a format has only its own rules."""
    scene.path("sparse/split.txt").unlink()
    names = [p.name for p in scene.path("images").iterdir()]
    table = tmp_path / "periods.csv"
    table.write_text("file,period\n" + "".join(f"{n},{n[0]}\n" for n in names))
    report = validate_scene(scene.root, options=ReadOptions(period_by=f"table:{table}"))
    assert codes(report) == {"CS006", "CS507"}
    table.write_text("file,period\na000.png,1\n")
    report = validate_scene(scene.root, options=ReadOptions(period_by=f"table:{table}"))
    (said,) = [f for f in report.findings if f.severity == "error"]
    assert (said.code, said.place) == ("CS007", str(table))
    with pytest.raises(ConfigError, match="one of folder, year"):
        validate_scene(scene.root, options=ReadOptions(period_by="decade"))
    with pytest.raises(ConfigError, match="no such option for wat"):
        validate_scene(scene.root, options=ReadOptions("wat", "year"))


def test_projects_are_corrected(project, tmp_path):
    project.path("sparse/0").rename(project.path("sparse/1"))
    repairs = fix_scene(project.root, tmp_path / "fixed")
    assert [r.code for r in repairs] == ["CS002", ""]
    copy = validate_scene(tmp_path / "fixed")
    assert not copy.count("error") and other_format(copy.path).name == "colmap-folders"


def test_other_formats_are_not_corrected(studio, project):
    with pytest.raises(ConfigError, match="found one in nerfstudio; convert it"):
        check_fixable(studio, ReadOptions())
    check_fixable(project.root, ReadOptions())


def test_the_model_of_a_project_is_looked_for_once(project, monkeypatch):
    looked, find = [], raw_model.find_model

    def find_model(folder):
        looked.append(folder)
        return find(folder)

    for module in (raw_model, formats, our_format, neusc):
        monkeypatch.setattr(module, "find_model", find_model)
    report = project.validate()
    assert not report.count("error") and "CS006" in codes(report)
    assert looked == [project.root]


def test_labels_and_dates_of_a_project_are_those_of_their_file(project):
    periods = [{"id": 0, "label": "before", "date": "2023"}, {"id": 1, "date": "2016-09"}]
    project.write("sparse/periods.json", json.dumps(periods))
    report = project.validate()
    assert [p.label for p in report.summary.periods] == ["before", None]
    (said,) = [f for f in report.findings if f.code == "CS227"]
    assert (said.place, said.found) == ("sparse/periods.json (period 1)", "2016-09")
    project.write("sparse/periods.json", "[]")
    (said,) = [f for f in project.validate().findings if f.severity == "error"]
    assert (said.code, said.place) == ("CS009", "sparse/periods.json")
