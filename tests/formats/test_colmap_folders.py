"""Plain COLMAP, one folder of images per period."""

import dataclasses
import shutil
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import colmap_folders, detect, find_scenes, read_scene
from chronoscene.formats.shared.colmap_layout import period_folders
from chronoscene.formats.shared.grouping import natural_key, read_table
from chronoscene.scene import Period

DATED = ["2016/a.png", "2016/b.png", "2023-04/a.png", "2023-04/c/d.png"]


def test_periods_are_the_first_folders_in_natural_order(colmap_folder):
    names = [f"t{i}/{j}.png" for i in (1, 2, 10) for j in range(2)]
    scene = read_scene(colmap_folder(names))
    assert [p.label for p in scene.periods] == ["t1", "t2", "t10"]
    assert {f.name: f.period for f in scene.frames}["t10/0.png"] == 2


def test_folders_that_are_dates_are_dates(colmap_folder):
    scene = read_scene(colmap_folder(DATED))
    assert scene.periods == (Period(0, "2016", "2016"), Period(1, "2023-04", "2023-04"))
    assert scene.frames[3].name == "2023-04/c/d.png" and scene.frames[3].period == 1


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_every_form_of_a_model(colmap_folder, form):
    assert len(read_scene(colmap_folder(DATED, form=form)).points) == 30


def test_model_directly_in_sparse(colmap_folder):
    folder = colmap_folder(DATED)
    for file in (folder / "sparse/0").iterdir():
        file.rename(folder / "sparse" / file.name)
    (folder / "sparse/0").rmdir()
    assert detect(folder).name == "colmap-folders"
    assert len(read_scene(folder).frames) == 4


def test_a_test_list_counts(colmap_folder):
    folder = colmap_folder(DATED, tests=["2016/b", "2023-04/a.png"])
    tests = [f.name for f in read_scene(folder).select(split="test")]
    assert tests == ["2016/b.png", "2023-04/a.png"]


def test_images_without_folders_are_refused_with_the_way_out(colmap_folder):
    with pytest.raises(
        SceneError, match=r"every image in a folder of its period.*--period-by tabl"
    ):
        read_scene(colmap_folder(["a.png", "b.png"]), format="colmap-folders")


def test_periods_from_a_table(colmap_folder, tmp_path):
    folder, table = colmap_folder(["a.png", "b.png", "c.png"]), tmp_path / "periods.csv"
    table.write_text("file,period,note\nc,2016,x\na.png,2023,\nb.png,2016,\nlost.png,1,\n")
    scene = read_scene(folder, format="colmap-folders", period_by=f"table:{table}")
    assert [f.period for f in scene.frames] == [1, 0, 0]
    assert [p.date for p in scene.periods] == ["2016", "2023"]


def test_a_table_finds_names_in_another_unicode_form(colmap_folder, tmp_path):
    names = [unicodedata.normalize("NFD", name) for name in ("pläne.png", "straße.png")]
    folder, table = colmap_folder(names), tmp_path / "periods.csv"
    table.write_text("file,period\npläne.png,2023\nstraße,2016\n", encoding="utf-8")
    scene = read_scene(folder, format="colmap-folders", period_by=f"table:{table}")
    assert {f.name: f.period for f in scene.frames} == dict(zip(names, (1, 0), strict=True))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,date\na.png,1\n", "expected the columns file and period"),
        ("", "expected the columns file and period"),
        ("file;period\na.png;1\n", "found file;period; separate the columns by commas"),
        ("file,period\na.png,1\n", "a period of every image, found none of 1 of 2: 'b.png'; add"),
        (
            "file,period\na.png,1\nb.png,2\na,2\n",
            r"periods.csv:4: expected one period of 'a', found '1' and '2'; keep one",
        ),
    ],
)
def test_tables_that_are_refused(colmap_folder, tmp_path, text, message):
    folder, table = colmap_folder(["a.png", "b.png"]), tmp_path / "periods.csv"
    table.write_text(text)
    with pytest.raises(SceneError, match=message):
        read_scene(folder, format="colmap-folders", period_by=f"table:{table}")


def test_a_table_that_is_not_there(colmap_folder, tmp_path):
    folder = colmap_folder(["a.png", "b.png"])
    for name, found in (("nope.csv", "nothing; check the path"), ("", "a folder; name a file")):
        with pytest.raises(SceneError, match=f"{name}: expected a text file, found {found}$"):
            read_scene(folder, period_by=f"table:{tmp_path / name}")


def test_unknown_grouping_names_those_that_there_are(colmap_folder):
    with pytest.raises(ConfigError, match=r"one of folder, year, .*, table:FILE, found 'decade'"):
        read_scene(colmap_folder(DATED), period_by="decade")


def test_no_model_and_no_images(colmap_folder):
    folder = colmap_folder(DATED)
    (folder / "images").rename(folder / "photos")
    with pytest.raises(SceneError, match="found no folder images/"):
        read_scene(folder, format="colmap-folders")
    (folder / "photos").rename(folder / "images")
    (folder / "sparse/0/points3D.bin").unlink()
    with pytest.raises(SceneError, match=r"expected a COLMAP model: .*, found cameras.bin, fr"):
        read_scene(folder, format="colmap-folders")
    shutil.rmtree(folder / "sparse/0")
    with pytest.raises(SceneError, match="found no model"):
        read_scene(folder, format="colmap-folders")


def test_a_model_without_images_is_refused(colmap_folder):
    folder = colmap_folder(DATED, form="text", points=0)
    (folder / "sparse/0/images.txt").write_text("")
    (folder / "sparse/0/frames.txt").unlink()
    (folder / "sparse/0/rigs.txt").unlink()
    with pytest.raises(SceneError, match="expected registered images, found none"):
        read_scene(folder)


def test_writing_puts_images_into_folders_of_their_periods(make_scene_folder, tmp_path):
    names = {"0/a.png": 0, "a.png": 0, "b.png": 1, "sub/a.png": 1}
    scene = read_scene(make_scene_folder(names))
    out = colmap_folders.write(scene, tmp_path / "out")
    again = read_scene(out)
    assert [f.name for f in again.frames] == ["0/0/a.png", "0/a.png", "1/b.png", "1/sub/a.png"]
    assert [f.period for f in again.frames] == [0, 0, 1, 1]
    for old, new in zip(scene.frames, again.frames, strict=True):
        assert again.image_path(new).read_bytes() == scene.image_path(old).read_bytes()


def test_tracks_follow_frames_that_change_places(make_scene_folder, tmp_path):
    """In name order, b comes after a; as folders of their periods, before it."""
    scene = read_scene(make_scene_folder({"a.png": 1, "b.png": 0}))
    again = read_scene(colmap_folders.write(scene, tmp_path / "out"))
    assert [f.name for f in again.frames] == ["0/b.png", "1/a.png"]

    def observations(scene, names):
        start = scene.points.track_start
        return {
            (pid, names[scene.points.track_frame[j]], *scene.points.track_xy[j])
            for i, pid in enumerate(scene.points.ids.tolist())
            for j in range(start[i], start[i + 1])
        }

    old = observations(scene, [f.name for f in scene.frames])
    assert observations(again, ["b.png", "a.png"]) == old


@pytest.mark.parametrize(
    ("labels", "folders"),
    [
        (["2016", "2023"], ["2016", "2023"]),
        (["before", "after"], ["0_before", "1_after"]),
        (["same", "same"], ["0_same", "1_same"]),
        (["../x", "y"], ["0_..-x", "1_y"]),
        (["a/b", "c "], ["0_a-b", "1_c-"]),
        ([".", ".."], ["0_.", "1_.."]),
    ],
)
def test_folders_are_in_the_order_of_the_periods_and_safe(labels, folders):
    periods = tuple(Period(i, label) for i, label in enumerate(labels))
    assert period_folders(periods) == folders


@given(st.lists(st.text(max_size=8), min_size=1, max_size=12))
def test_any_labels_become_folders_in_order(labels):
    periods = tuple(Period(i, label) for i, label in enumerate(labels))
    folders = period_folders(periods)
    assert sorted(set(folders), key=natural_key) == folders
    for folder in folders:
        assert folder not in ("", ".", "..") and folder == folder.strip()
        assert "/" not in folder and "\n" not in folder and "\r" not in folder


def test_folders_that_differ_in_zeros_have_one_order(colmap_folder):
    names = [f"{folder}/a.png" for folder in ("t1", "t01", "t001")]
    assert [p.label for p in read_scene(colmap_folder(names)).periods] == ["t001", "t01", "t1"]


def test_images_without_periods_are_refused_with_the_way_out(colmap_folder):
    folder = colmap_folder(["a.png", "b.png"])
    with pytest.raises(SceneError, match=r"--period-by year, month or day .* sparse/split\.txt"):
        read_scene(folder)


def test_written_labels_are_read_again(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    named = dataclasses.replace(scene, periods=(Period(0, "2016-09"), Period(1, "2023")))
    again = read_scene(colmap_folders.write(named, tmp_path / "out"))
    assert [p.label for p in again.periods] == ["2016-09", "2023"]


def test_lines_of_a_table_are_counted_as_an_editor_does(tmp_path):
    text = '\n\nperiod, file\n \n2016,a.png\n\n2017, "b.png"\n'
    (tmp_path / "t.csv").write_text(text)
    rows = read_table(tmp_path / "t.csv")
    assert rows == [
        (f"{tmp_path}/t.csv:5", "a.png", "2016"),
        (f"{tmp_path}/t.csv:7", "b.png", "2017"),
    ]


def move_model(folder, place, images="images"):
    """Put the model of a folder, and perhaps its images, where another program leaves them."""
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    (folder / "sparse/0").rename(folder / place)
    if not any((folder / "sparse").iterdir()):
        (folder / "sparse").rmdir()
    (folder / images).parent.mkdir(parents=True, exist_ok=True)
    (folder / "images").rename(folder / images)


@pytest.mark.parametrize(
    ("place", "images"),
    [
        ("sparse/1", "images"),
        ("colmap/sparse/0", "images"),
        ("distorted/sparse/0", "input"),
        ("distorted/sparse/0", "images"),
        ("dense/sparse", "dense/images"),
        ("dense/0/sparse", "dense/0/images"),
        ("reconstruction", "images"),
        ("reconstruction/0", "images"),
        ("sfm", "images"),
    ],
)
def test_models_are_found_where_programs_leave_them(colmap_folder, place, images):
    folder = colmap_folder(DATED)
    old = read_scene(folder)
    assert detect(folder, format=old.format).notes == []
    move_model(folder, place, images)
    scene = read_scene(folder)
    assert scene.format == "colmap-folders" and scene.periods == old.periods
    assert scene.image_path(scene.frames[0]).is_file()
    said = f"the model is read from {place}, the images from {images}"
    assert detect(folder, format=scene.format).notes == [said]
    assert [scene.path for scene in find_scenes(folder.parent)] == [folder]


def test_the_usual_place_wins(colmap_folder):
    folder = colmap_folder(DATED)
    for place in ("distorted/sparse/0", "dense/sparse"):
        shutil.copytree(folder / "sparse/0", folder / place)
    (folder / "sparse/0/points3D.bin").unlink()
    with pytest.raises(SceneError, match=r"sparse/0: expected a COLMAP model: cameras, images and"):
        read_scene(folder)  # and is not replaced in silence by another model


def test_a_model_of_nerfstudio_is_not_read_in_its_stead(nerfstudio_folder, colmap_folder):
    folder = nerfstudio_folder(DATED)
    shutil.copytree(colmap_folder(DATED) / "sparse", folder / "colmap/sparse")
    assert detect(folder).name == "nerfstudio"
    assert read_scene(folder, format="colmap-folders").num_periods == 2


def test_projects_are_named_where_a_part_of_one_is_given(colmap_folder):
    folder = colmap_folder(DATED)
    for part in ("sparse/0", "sparse", "images/2016"):
        with pytest.raises(SceneError, match=f"; give the folder of the whole project, {folder}$"):
            read_scene(folder / part)


def test_a_model_where_nobody_looks_is_named(colmap_folder):
    folder = colmap_folder(DATED)
    move_model(folder, "out/model")
    with pytest.raises(SceneError, match=r"; copy the COLMAP model in out/model to sparse/0$"):
        read_scene(folder)
    (folder / "sparse").mkdir()
    (folder / "out/model").rename(folder / "sparse/0")
    (folder / "images").rename(folder / "photos")
    todo = r"; copy the images of the COLMAP model in sparse/0 to images/ in this folder$"
    with pytest.raises(SceneError, match=todo):
        read_scene(folder)


def dated_folder(colmap_folder, dates):
    """A project with photos of these dates, None for none, directly in ``images/``."""
    names = [f"{i}.jpg" for i in range(len(dates))]
    folder = colmap_folder(names)
    for name, taken in zip(names, dates, strict=True):
        exif = Image.Exif()
        if taken:
            exif.get_ifd(0x8769)[0x9003] = f"{taken} 12:00:00"
            exif[0x8769] = 0
        Image.new("RGB", (64, 48)).save(folder / "images" / name, exif=exif)
    return folder


DAYS = ["2016:05:03", "2016:05:04", "2016:09:01", "2023:04:17"]


@pytest.mark.parametrize(
    ("by", "periods", "labels"),
    [
        ("year", [0, 0, 0, 1], ["2016", "2023"]),
        ("month", [0, 0, 1, 2], ["2016-05", "2016-09", "2023-04"]),
        ("day", [0, 1, 2, 3], ["2016-05-03", "2016-05-04", "2016-09-01", "2023-04-17"]),
        ("count:2", [0, 0, 0, 1], ["2016-05-03 to 2016-09-01", "2023-04-17"]),
    ],
)
def test_periods_from_the_dates_of_photos(colmap_folder, by, periods, labels):
    folder = dated_folder(colmap_folder, DAYS)
    scene = read_scene(folder, period_by=by)
    assert [f.period for f in scene.frames] == periods
    assert [p.label for p in scene.periods] == labels
    (scene,) = find_scenes(folder.parent, period_by=by)
    assert scene.path == folder


def test_dates_in_file_names_count_too(colmap_folder):
    scene = read_scene(colmap_folder(["a/20160503_1.png", "a/2023-04-17.png"]), period_by="year")
    assert [p.label for p in scene.periods] == ["2016", "2023"]


def test_photos_without_a_date_are_named(colmap_folder):
    folder = dated_folder(colmap_folder, [*DAYS, None, None, None, None])
    found = r"found none for 4 of 8: '4.jpg', '5.jpg', '6.jpg' and 1 more; .*--period-by table:FILE"
    with pytest.raises(SceneError, match=found):
        read_scene(folder, period_by="year")
    (folder / "images/5.jpg").unlink()
    with pytest.raises(SceneError, match=r"expected a file for every .*none for '5.jpg'; copy"):
        read_scene(folder, period_by="year")


def test_a_format_that_is_named_counts_more_than_marks(make_scene_folder):
    folder = make_scene_folder({"2016/a.png": 0, "2016/b.png": 1, "2023/a.png": 1})
    assert [f.period for f in read_scene(folder).frames] == [0, 1, 1]
    scene = read_scene(folder, format="colmap-folders")
    assert [f.period for f in scene.frames] == [0, 0, 1]
