"""Edits of scenes: what goes, what stays as it was, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from chronoscene.colmap.model import read_raw_model
from chronoscene.colmap.write import write_raw_model
from chronoscene.edit import Edits, apply, edit, read_for_edit
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import detect, read_scene
from chronoscene.scene import Period
from chronoscene.validation.run import validate_scene

NAMES = {f"{p}/{i:02d}.png": i_p for i_p, p in enumerate(("old", "mid", "new")) for i in range(6)}

LABELS = [
    {"id": 0, "label": "before", "date": "2016-05"},
    {"id": 1, "label": "during", "date": "2016-09-03"},
    {"id": 2, "label": "after"},
]


@pytest.fixture
def folder(make_scene_folder):
    """Three periods of six images with labels, dates, a mask, a world and a split."""
    root = make_scene_folder(NAMES, tests=["old/03.png", "mid/00.png", "new/01.png"])
    (root / "sparse/periods.json").write_text(json.dumps(LABELS))
    (root / "sparse/world.json").write_text('{"unit": "metre", "offset": [1, 2, 3]}')
    (root / "masks/new").mkdir(parents=True)
    Image.new("L", (64, 48), 255).save(root / "masks/new/02.png.png")
    return root


@pytest.fixture
def run(folder, tmp_path):
    """Edit the folder; check what every edit leaves alone; give the scenes before and after."""

    def edited(**edits):
        before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        scene = read_scene(folder)
        done = edit(scene, tmp_path / "out", Edits(**edits))
        assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
        again = read_scene(tmp_path / "out")
        assert [f.name for f in again.frames] == [f.name for f in done.scene.frames]
        assert again.world == scene.world
        new_names = edits.get("rename", {})
        new = {f.name: f for f in again.frames}
        for old in scene.frames:
            frame = new.get(new_names.get(old.name, old.name))
            if frame is not None:
                same = ("image_id", "camera", "split")
                assert all(getattr(frame, k) == getattr(old, k) for k in same)
                np.testing.assert_allclose(frame.cam_from_world, old.cam_from_world, atol=1e-13)
                assert again.image_path(frame).read_bytes() == scene.image_path(old).read_bytes()
        return scene, again

    return edited


def observations(scene):
    """Point id and pixels of every observation, by image."""
    ids = np.repeat(scene.points.ids, np.diff(scene.points.track_start)).tolist()
    names = [scene.frames[i].name for i in scene.points.track_frame]
    return set(zip(names, ids, map(tuple, scene.points.track_xy.tolist()), strict=True))


def test_a_photo_goes_with_its_observations(run, tmp_path):
    scene, new = run(drop=("old/02.png",))
    assert {f.name for f in scene.frames} - {f.name for f in new.frames} == {"old/02.png"}
    assert observations(new) == {o for o in observations(scene) if o[0] != "old/02.png"}
    assert new.periods == scene.periods
    assert not (tmp_path / "out/images/old/02.png").exists()
    errors = [f for f in validate_scene(tmp_path / "out").findings if f.severity == "error"]
    assert errors == []


def test_a_period_goes_and_the_others_are_numbered(run):
    scene, new = run(drop_periods=("before",))
    assert new.periods == (Period(0, "during", "2016-09-03"), Period(1, "after"))
    assert [f.period for f in new.frames] == [f.period - 1 for f in scene.frames if f.period]
    assert set(new.masks) == {"new/02.png"}


def test_periods_by_id_patterns_and_both(run):
    _, new = run(keep_periods=("0", "after"), keep=("*/0[0-3].png",), drop=("new/03.png",))
    names = [f.name for f in new.frames]
    assert names == [f"new/0{i}.png" for i in range(3)] + [f"old/0{i}.png" for i in range(4)]


def test_points_with_one_observation_left_go_and_points_without_any_stay(folder):
    scene = read_scene(folder)
    seen = np.ones(len(scene.points.track_frame), bool)
    seen[scene.points.track_start[-2] :] = False  # the last point is from another source
    first = slice(*scene.points.track_start[:2])
    seen[first] = scene.points.track_frame[first] != 0
    rank = np.arange(len(scene.frames), dtype=np.int32)
    scene = replace(scene, points=scene.points.select_observations(seen, rank))
    names = [frame.name for frame in scene.frames]
    done = apply(scene, Edits(keep=(names[0], names[1])))
    assert done.scene.points.ids.tolist() == scene.points.ids[1:].tolist()
    assert np.diff(done.scene.points.track_start).tolist() == [2] * (len(scene.points) - 2) + [0]
    assert done.points_unseen == 1


def test_crop(folder):
    scene = read_scene(folder)
    xyz = scene.points.xyz.copy()
    first = scene.points.track_start[0], scene.points.track_start[1]
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    middle = float(np.median(xyz[:, 0]))
    done = apply(scene, Edits(crop=(*low, middle, *high[1:])))
    assert set(done.scene.points.ids) == set(scene.points.ids[xyz[:, 0] <= middle])
    assert done.points_outside == int((xyz[:, 0] > middle).sum()) > 0
    assert done.images_dropped == 0
    # With the first point alone, an image that sees only others goes, one that sees none stays.
    track = scene.points.track_frame.copy()
    track[track == 5] = 4
    moved = np.flatnonzero(track[slice(*first)] == 3) + first[0]
    track[moved] = 4
    lonely = replace(scene, points=replace(scene.points, track_frame=track))
    done = apply(lonely, Edits(crop=(*xyz[0], *xyz[0])))
    gone = {f.name for f in scene.frames} - {f.name for f in done.scene.frames}
    assert scene.frames[3].name in gone and scene.frames[5].name not in gone
    assert done.images_outside == len(gone)


def test_labels_and_merged_periods(run):
    _, new = run(rename={"0": "2016", "during": "2016"})
    assert new.periods == (Period(0, "2016", "2016"), Period(1, "after"))
    assert {f.name.split("/")[0]: f.period for f in new.frames} == {"old": 0, "mid": 0, "new": 1}


def test_a_label_that_is_there_merges_too(run):
    _, new = run(rename={"after": "before"})
    assert new.periods == (Period(0, "before"), Period(1, "during", "2016-09-03"))


def test_an_image_gets_another_name_with_its_mask_and_tracks(run, tmp_path):
    scene, new = run(rename={"new/02.png": "a/first.png"})
    assert new.frames[0].name == "a/first.png"
    assert set(new.masks) == {"a/first.png"}
    moved = {(o[0].replace("new/02.png", "a/first.png"), *o[1:]) for o in observations(scene)}
    assert observations(new) == moved


def test_ids_as_labels_follow_the_numbers(make_scene_folder):
    scene = read_scene(make_scene_folder(NAMES))
    assert apply(scene, Edits(drop_periods=("0",))).scene.periods == (
        Period(0, "0"),
        Period(1, "1"),
    )
    assert apply(scene, Edits(rename={"0": "1"})).scene.periods == (
        Period(0, "0"),  # of 0 and 1
        Period(1, "1"),
    )


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ({"drop": ("old/2.png",)}, r"--drop: .* found 'old/2.png'; did you mean 'old/02.png'"),
        ({"drop": ("x*",)}, "--drop: expected the name of an image, found 'x"),
        ({"drop": ("00.png",)}, "which matches 'mid/00.png'"),
        ({"drop_periods": ("befor",)}, r"0 \(before\), .*found 'befor'; did you mean 'before'"),
        ({"rename": {"old/2.png": "x.png"}}, "a period or an image, .*did you mean 'old/02.png'"),
        ({"rename": {"before": " "}}, "expected a new name"),
        ({"rename": {"old/00.png": "old/01.png"}}, "distinct image names"),
        ({"rename": {"old/00.png": "../x.png"}}, "image names below images/"),
        ({"drop": ("*",)}, "expected an image that stays, found none"),
        ({"keep_periods": ("0",), "keep": ("new/*",)}, "expected an image that stays"),
        ({"crop": (1e6,) * 6}, "expected points in the box, found none of those between"),
    ],
)
def test_refusals(folder, tmp_path, edits, message):
    with pytest.raises((ConfigError, SceneError), match=message):
        edit(read_scene(folder), tmp_path / "out", Edits(**edits))
    assert not (tmp_path / "out").exists()


def test_images_because_of_which_a_scene_cannot_be_read(folder):
    raw = read_raw_model(folder / "sparse/0")
    quaternions = raw.images.quaternions.copy()
    quaternions[raw.images.names.index("old/02.png")] = np.nan
    for file in (folder / "sparse/0").glob("*.bin"):
        file.unlink()
    write_raw_model(
        folder / "sparse/0", raw.cameras, replace(raw.images, quaternions=quaternions), raw.points
    )
    split = folder / "sparse/split.txt"
    split.write_text(split.read_text().replace("new/05.png 2\n", ""))
    with pytest.raises(SceneError, match="a period for every registered image"):
        read_for_edit(detect(folder), Edits(drop=("old/02.png",)))
    edits = Edits(drop=("old/02.png", "new/05.png"), rename={"0": "x"})
    scene, left, unread, unseen = read_for_edit(detect(folder), edits)
    assert (len(scene.frames), unread, left) == (16, 2, Edits(rename={"0": "x"}))
    assert (len(scene.points), unseen) == (30, 0)


def test_what_is_left_is_the_same_whether_the_scene_could_be_read_or_not(make_scene_folder):
    folder = make_scene_folder(
        {f"{p}/{i:02d}.png": j for j, p in enumerate("ab") for i in range(9)}
    )
    model = folder / "sparse/0"
    raw = read_raw_model(model)
    for file in model.glob("*.bin"):
        file.unlink()
    start, points = raw.points.track_start, raw.points
    kept = np.concatenate([np.arange(start[i], start[i] + 2 + i % 2) for i in range(len(points))])
    points = replace(
        points,
        track_start=np.concatenate([[0], np.cumsum(2 + np.arange(len(points)) % 2)]),
        track_image=points.track_image[kept],
        track_keypoint=points.track_keypoint[kept],
    )
    write_raw_model(model, raw.cameras, raw.images, points)
    edits = Edits(drop=("a/00.png",))
    readable = apply(read_scene(folder), edits)
    translations = raw.images.translations.copy()
    translations[raw.images.names.index("a/00.png")] = np.nan
    images = replace(raw.images, translations=translations)
    write_raw_model(model, raw.cameras, images, points)
    scene, left, unread, unseen = read_for_edit(detect(folder), edits)
    done = apply(scene, left)
    assert (unread, unseen) == (readable.images_dropped, readable.points_unseen) and unseen > 0
    assert observations(done.scene) == observations(readable.scene)
    assert done.scene.points.ids.tolist() == readable.scene.points.ids.tolist()
    splits = [[(f.name, f.split) for f in d.scene.frames] for d in (done, readable)]
    assert splits[0] == splits[1]


def test_a_period_goes_with_the_only_image_that_cannot_be_read(make_scene_folder):
    folder = make_scene_folder({"a/0.png": 0, "a/1.png": 0, "b/0.png": 1, "c/0.png": 2})
    raw = read_raw_model(folder / "sparse/0")
    translations = raw.images.translations.copy()
    translations[raw.images.names.index("b/0.png")] = np.nan
    for file in (folder / "sparse/0").glob("*.bin"):
        file.unlink()
    images = replace(raw.images, translations=translations)
    write_raw_model(folder / "sparse/0", raw.cameras, images, raw.points)
    scene, left, *_ = read_for_edit(detect(folder), Edits(drop=("b/0.png",)))
    new = apply(scene, left).scene
    assert [(f.name, f.period) for f in new.frames] == [
        ("a/0.png", 0),
        ("a/1.png", 0),
        ("c/0.png", 1),
    ]
    with pytest.raises(ConfigError, match="expected an image that stays"):
        apply(*read_for_edit(detect(folder), Edits(drop=("*",)))[:2])
