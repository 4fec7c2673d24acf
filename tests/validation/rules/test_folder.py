import shutil

from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format


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
    scene.expect("CS002", place="sparse/0", found="one in sparse/", also=also)


def test_several_models(scene):
    shutil.copytree(scene.path("sparse/0"), scene.path("sparse/1"))
    scene.expect("CS003", place="sparse", found="'sparse/1' too")


def test_empty_folders_beside_the_model_are_nothing(scene):
    scene.path("sparse/1").mkdir()
    assert "CS003" not in {f.code for f in scene.validate().findings}


def test_bad_periods_json(scene):
    scene.write("sparse/periods.json", '[{"id": 0}, {"id": 2}]')
    scene.expect("CS004", place="sparse/periods.json", found="others")


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
    scene.expect("CS003", found="'sparse/3' too")
    shutil.rmtree(scene.path("sparse/0"))
    scene.expect("CS002", place="sparse/0", found="one in sparse/3/", also={"CS321", "CS706"})
