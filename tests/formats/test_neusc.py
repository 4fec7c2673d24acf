"""NeuSC / 5Pointz: dates, lists, grouping, and pickles that stay closed."""

from dataclasses import replace

import numpy as np
import pytest

from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import neusc, read_scene
from chronoscene.scene import Period

NAMES = [
    "2009-08-31_a.png",
    "2009-09-02_b.png",
    "2009-9-3_c.png",
    "2012-05-03_d.png",
    "2013-11-17_e.png",
    "none_f.png",
]


def test_years_are_periods_and_photos_without_date_are_left_out(pointz):
    folder = pointz(NAMES)
    scene = read_scene(folder)
    assert [(p.label, p.date) for p in scene.periods] == [
        ("2009", "2009"),
        ("2012", "2012"),
        ("2013", "2013"),
    ]
    assert [f.name for f in scene.frames] == NAMES[:5]
    assert [f.period for f in scene.frames] == [0, 0, 0, 1, 2]
    assert neusc.remarks(folder) == [
        "left out without a date, not in train.txt, or in trash.txt: 1 of 6 images"
    ]


@pytest.mark.parametrize(
    ("by", "periods", "labels"),
    [
        ("month", [0, 1, 1, 2, 3], ["2009-08", "2009-09", "2012-05", "2013-11"]),
        ("day", [0, 1, 2, 3, 4], ["2009-08-31", "2009-09-02", "2009-09-03", *NAMES]),
        ("gap:1", [0, 1, 1, 2, 3], ["2009-08-31", "2009-09-02 to 2009-09-03"]),
        ("gap:2", [0, 0, 0, 1, 2], ["2009-08-31 to 2009-09-03", "2012-05-03", "2013-11-17"]),
        ("count:1", [0, 0, 0, 0, 0], ["2009-08-31 to 2013-11-17"]),
        ("count:2", [0, 0, 0, 1, 1], ["2009-08-31 to 2009-09-03", "2012-05-03 to 2013-11-17"]),
    ],
)
def test_groupings(pointz, by, periods, labels):
    scene = read_scene(pointz(NAMES), period_by=by)
    assert [f.period for f in scene.frames] == periods
    count = min(len(labels), len(scene.periods), 3 if by == "day" else 9)
    assert [p.label for p in scene.periods][:count] == labels[:count]


@pytest.mark.parametrize("by", ["decade", "gap:", "gap:-1", "gap:nan", "count:0", "count:x"])
def test_groupings_that_do_not_exist(pointz, by):
    with pytest.raises(ConfigError, match="one of year, month, day, gap:DAYS, count:N"):
        read_scene(pointz(NAMES), period_by=by)


def test_more_periods_than_dates(pointz):
    with pytest.raises(ConfigError, match="at most 5 periods, found 6"):
        read_scene(pointz(NAMES), period_by="count:6")


def test_lists(pointz):
    folder = pointz(NAMES, train=[NAMES[3], NAMES[0], NAMES[4], "2010-01-01_lost.png"])
    (folder / "trash.txt").write_text(f"{NAMES[4]}\n")
    scene = read_scene(folder)
    assert [(f.name, f.split) for f in scene.frames] == [(NAMES[0], "train"), (NAMES[3], "test")]


def test_what_lists_say_beyond_the_scene_is_remarked_upon(pointz):
    folder = pointz(NAMES, train=[*NAMES, "2010-01-01_lost.png"])
    for place in ("", "annots"):
        (folder / place / "trash.txt").write_text(f"{NAMES[1]}\n")
    remarks = neusc.remarks(folder)
    assert "train.txt has 1 names that match no registered image" in remarks
    assert "trash.txt beside annots/ is not read, as there is one in it" in remarks


def test_every_10th_of_the_list_is_for_testing(pointz):
    names = [f"2010-01-{i + 1:02d}_x.png" for i in range(12)]
    scene = read_scene(pointz(names, train=names[::-1]))
    assert [f.name for f in scene.select(split="test")] == [names[1], names[11]]


def test_tracks_stay_with_their_images(pointz):
    scene = read_scene(pointz(NAMES))
    points = scene.points
    assert points.track_frame.max() < len(scene.frames) == 5
    assert points.track_start[-1] == len(points.track_xy) == len(points.track_frame)
    xyz = np.repeat(points.xyz, np.diff(points.track_start), axis=0)
    for frame, xy, point in zip(points.track_frame, points.track_xy, xyz, strict=True):
        f = scene.frames[frame]
        pixel = f.camera.K @ (f.cam_from_world[:3, :3] @ point + f.cam_from_world[:3, 3])
        np.testing.assert_allclose(pixel[:2] / pixel[2], xy, atol=1e-6)


def test_pickles_are_never_loaded(pointz, tmp_path):
    folder = pointz(NAMES)
    read_scene(folder)
    assert neusc.remarks(folder)
    assert not (tmp_path / "exploded").exists()
    import pickle

    pickle.loads((folder / "annots/cam_dict.pkl").read_bytes())  # what loading it would have done
    assert (tmp_path / "exploded").exists()


@pytest.mark.parametrize("name", ["2009-02-30_x.png", "IMG_1.png", "20090101_x.png"])
def test_names_without_a_date_are_refused(pointz, name):
    with pytest.raises(SceneError, match='begins with a date as in "2012-05-03_"'):
        read_scene(pointz([*NAMES, name]))


def test_lists_that_leave_nothing(pointz):
    with pytest.raises(SceneError, match=r"none left by train\.txt and trash\.txt"):
        read_scene(pointz(NAMES, train=["17", "18"]))


def test_other_undistorted_models_are_not_of_this_format(pointz):
    folder = pointz(["a.png", "b.png"])
    assert not neusc.matches(folder)
    (folder / "dense/images/a.png").rename(folder / "dense/images/none_a.png")
    assert neusc.matches(folder)


def test_written_scenes_keep_what_the_years_say(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder({"a.png": 0, "x/b.png": 0, "c.png": 1, "d.png": 1}))
    table = (Period(0, "spring", "2016-04"), Period(1, "autumn", "2018-10-03"))
    out = neusc.write(replace(scene, periods=table), tmp_path / "out")
    names = ["2016-04-01_a.png", "2016-04-01_x_b.png", "2018-10-03_c.png", "2018-10-03_d.png"]
    assert (out / "annots/train.txt").read_text().split() == names
    again = read_scene(out)
    assert (again.format, again.periods) == ("neusc", table)
    assert [frame.name for frame in again.frames] == names
    assert [frame.name for frame in again.select(split="test")] == names[:1]
    assert [p.label for p in read_scene(out, period_by="month").periods] == ["2016-04", "2018-10"]
    second = neusc.write(again, tmp_path / "second")
    assert [frame.name for frame in read_scene(second).frames] == names


def test_days_that_folders_begin_with_go_to_the_files(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder({"2016-04-03_spring/a.png": 0, "2018-10-03_b/a.png": 1}))
    table = (Period(0, "spring", "2016-04-03"), Period(1, "autumn", "2018-10-03"))
    again = read_scene(neusc.write(replace(scene, periods=table), tmp_path / "out"))
    assert (again.format, again.periods) == ("neusc", table)
    assert [(frame.name, frame.period) for frame in again.frames] == [
        ("2016-04-03_2016-04-03_spring_a.png", 0),
        ("2018-10-03_2018-10-03_b_a.png", 1),
    ]


@pytest.mark.parametrize("dates", [(None, None), ("2016-04", "2016-09"), ("2018", "2016")])
def test_periods_without_years_of_their_own_are_numbered(make_scene_folder, tmp_path, dates):
    scene = read_scene(make_scene_folder())
    table = tuple(Period(i, label, dates[i]) for i, label in enumerate("ab"))
    scene = replace(scene, periods=table)
    assert any("they become the years 1, 2" in lost for lost in neusc.losses(scene))
    again = read_scene(neusc.write(scene, tmp_path / "out"))
    assert {frame.name[:11] for frame in again.frames} == {"0001-01-01_", "0002-01-01_"}
    assert again.periods == table
