"""Strategies for new splits."""

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats.chronoscene import read
from chronoscene.images.exif import capture_times
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.scene.split_making import (
    SplitSettings,
    choose_blocks,
    cut_into_blocks,
    hold_out_validation,
    latest,
    make_split,
)
from chronoscene.scene.splits import default_tests, split_hash

CAMERA = Camera(1, "PINHOLE", 64, 48, (50, 50, 32, 24))


def make_scene(periods, centres=None, root=None, names=None):
    """A scene of cameras at given places, all looking the same way."""
    centres = np.zeros((len(periods), 3)) if centres is None else np.asarray(centres)
    names = names or [f"{i:04d}.png" for i in range(len(periods))]
    frames = tuple(
        Frame(name, i + 1, CAMERA, pose_from_rotation_translation(np.eye(3), -c), p, "train")
        for i, (name, p, c) in enumerate(zip(names, periods, centres, strict=True))
    )
    table = tuple(Period(i, str(i)) for i in range(max(periods) + 1))
    return Scene("s", root, root, frames, Points.empty(), table, "x", "chronoscene")


def held_out(split):
    return {f.name for f in split.scene.select(split="test")}


@given(st.lists(st.integers(0, 2), min_size=2, max_size=60))
def test_stratified_without_seed_is_the_default_rule(periods):
    scene = make_scene([0, 1, 2, *periods, 0, 1])
    split = make_split(scene, SplitSettings("stratified"))
    assert held_out(split) == default_tests({f.name: f.period for f in scene.frames})


@given(st.integers(1, 80), st.floats(0.02, 0.6), st.one_of(st.none(), st.integers(0, 5)))
def test_stratified_takes_one_of_each_run(count, fraction, seed):
    scene = make_scene([0] * count + [1] * 5)
    tests = held_out(make_split(scene, SplitSettings("stratified", fraction, seed=seed)))
    taken = [i for i in range(count) if f"{i:04d}.png" in tests]
    expected = int(np.ceil(count * fraction - 1e-9))
    assert len(taken) == expected
    for run, index in enumerate(taken):
        assert int(run / fraction + 1e-9) <= index < max(1, int((run + 1) / fraction + 1e-9))


def test_stratified_offset_and_seed():
    scene = make_scene([0] * 24 + [1] * 16)
    shifted = held_out(make_split(scene, SplitSettings(offset=3)))
    assert shifted == {f"{i:04d}.png" for i in (3, 11, 19, 27, 35)}
    drawn = [held_out(make_split(scene, SplitSettings(seed=seed))) for seed in range(8)]
    assert drawn[0] == held_out(make_split(scene, SplitSettings(seed=0)))
    assert len(set(map(frozenset, drawn))) > 4


@pytest.mark.parametrize(
    ("settings", "place"),
    [
        ({"fraction": 0}, "--fraction"),
        ({"fraction": 1}, "--fraction"),
        ({"fraction": float("nan")}, "--fraction"),
        ({"offset": 8}, "--offset"),
        ({"offset": -1}, "--offset"),
        ({"offset": 3, "seed": 1}, "--offset"),
        ({"seed": -1}, "--seed"),
        ({"strategy": "blocked", "blocks": 1}, "--blocks"),
        ({"strategy": "blocked", "blocks": 100}, "--blocks"),
        ({"strategy": "stratified", "blocks": 4}, "--blocks"),
        ({"strategy": "blocked", "offset": 1}, "--offset"),
        ({"strategy": "date", "seed": 1}, "--seed"),
        ({"strategy": "stratified", "periods": (1,)}, "--period"),
        ({"strategy": "periods", "periods": (1,), "fraction": 0.5}, "--fraction"),
        ({"strategy": "none", "fraction": 0.5}, "--fraction"),
        ({"strategy": "periods"}, "--period"),
        ({"strategy": "periods", "periods": (0, 2)}, "--period"),
        ({"strategy": "periods", "periods": (0, 1)}, "split"),
    ],
)
def test_settings_that_are_refused(settings, place):
    with pytest.raises(ConfigError) as error:
        make_split(make_scene([0] * 10 + [1] * 10), SplitSettings(**settings))
    assert error.value.place == place


def flights(count=60, periods=3, seed=0):
    """Every period flies over the same square, with places of its own."""
    rng = np.random.default_rng(seed)
    centres = np.c_[rng.uniform(0, 100, (count * periods, 2)), rng.normal(50, 0.1, count * periods)]
    return make_scene(np.repeat(np.arange(periods), count).tolist(), centres)


@pytest.mark.parametrize("seed", range(5))
def test_blocks_are_the_same_in_all_periods(seed):
    """No training camera of any period is inside of the box of a test block."""
    scene = flights()
    split = make_split(scene, SplitSettings("blocked", 0.25, seed=seed, blocks=8))
    centres = camera_centre(scene.frame_poses)
    block = cut_into_blocks(centres, 8)
    is_test = np.array([f.split == "test" for f in split.scene.frames])
    assert len(set(block[is_test])) == 2 and not set(block[is_test]) & set(block[~is_test])
    for b in set(block[is_test]):
        low, high = centres[block == b].min(axis=0), centres[block == b].max(axis=0)
        inside = ((centres >= low) & (centres <= high)).all(axis=1)
        assert is_test[inside].all()
    for period in range(3):
        assert split.scene.select(split="test", period=period)
        assert split.scene.select(split="train", period=period)


def test_blocks_that_all_hold_a_whole_period_are_refused():
    centres = 50.0 * np.repeat(np.arange(3), 2)[:, None] + np.arange(3)
    with pytest.raises(ConfigError, match="found 3 blocks, each with all images of a period"):
        make_split(make_scene([0, 0, 1, 1, 2, 2], centres), SplitSettings("blocked", blocks=3))


@pytest.mark.parametrize("fraction", [0.05, 0.125, 0.3, 0.5, 0.6, 0.8, 0.9])
def test_blocks_hold_out_the_share_that_was_asked_for(fraction):
    scene = make_split(flights(40, 2), SplitSettings("blocked", fraction=fraction)).scene
    assert len(scene.select(split="test")) / 80 == pytest.approx(fraction, abs=0.05)


def test_blocked_test_views_are_farther_from_training_views():
    scene = flights(count=200)
    blocked = make_split(scene, SplitSettings("blocked", 0.125, seed=1))
    stratified = make_split(scene, SplitSettings("stratified", 0.125))
    assert blocked.nearest[0] > 2 * stratified.nearest[0]
    assert len(held_out(blocked)) == pytest.approx(len(held_out(stratified)), abs=2)


def test_distances_count_training_cameras_of_other_periods():
    """The test camera of period 0 is 1 from its neighbour in time, 5 from that of its period."""
    centres = [[0, 0, 0], [5, 0, 0], [0, 1, 0], [9, 1, 0]]
    split = make_split(make_scene([0, 0, 1, 1], centres), SplitSettings(fraction=0.3))
    assert held_out(split) == {"0000.png", "0002.png"}
    assert split.nearest == pytest.approx((np.median([5, np.hypot(5, 1)]), 5))
    assert split.nearest_same_period == pytest.approx((7, 5))


def put_images(root, taken):
    """Images with a date of capture in their EXIF block; None for none."""
    for name, when in taken.items():
        exif = Image.Exif()
        if when is not None:
            exif.get_ifd(0x8769)[0x9003] = when.strftime("%Y:%m:%d %H:%M:%S")
        Image.new("RGB", (4, 4)).save(root / name, exif=exif)


def times_of(scene):
    return capture_times(scene.images_root, [f.name for f in scene.frames])


def test_of_two_days_as_near_to_the_fraction_the_later_one_begins_the_test(tmp_path):
    days = (1, 2, 2, 3)
    taken = {f"{i}.jpg": datetime(2020, 1, day, 8 + i) for i, day in enumerate(days)}
    put_images(tmp_path, taken)
    scene = make_scene([0] * 4, root=tmp_path, names=list(taken))
    assert latest(scene, SplitSettings("date", 0.5), times_of(scene)) == {"3.jpg"}


def test_last_hours_of_a_day(tmp_path):
    taken = {f"{i}.jpg": datetime(2020, 1, 1, 20 - i) for i in range(8)}
    put_images(tmp_path, taken)
    scene = make_scene([0] * 8, root=tmp_path, names=list(taken))
    split = make_split(scene, SplitSettings("date", 0.25), times_of(scene))
    assert held_out(split) == {"0.jpg", "1.jpg"}


def test_last_days_of_each_period(tmp_path):
    taken = {f"a{i}.jpg": datetime(2020, 1, 1 + i // 3, 8 + i) for i in range(9)}
    taken |= {f"b{i}.jpg": datetime(2021, 1, 1, 20 - i) for i in range(4)}
    put_images(tmp_path, taken)
    scene = make_scene([0] * 9 + [1] * 4, root=tmp_path, names=list(taken))
    assert latest(scene, SplitSettings("date", 0.25), times_of(scene)) == {
        "a6.jpg",
        "a7.jpg",
        "a8.jpg",
        "b0.jpg",
    }
    many = latest(scene, SplitSettings("date", 0.6), times_of(scene))
    assert {name for name in many if name[0] == "a"} == {f"a{i}.jpg" for i in range(3, 9)}


def test_dates_in_file_names(tmp_path):
    names = ["2009-08-31_a.jpg", "20090901_b.jpg", "c.jpg"]
    put_images(tmp_path, dict.fromkeys(names[:2]) | {"c.jpg": datetime(2009, 9, 3)})
    scene = make_scene([0] * 3, root=tmp_path, names=names)
    assert latest(scene, SplitSettings("date", 0.3), times_of(scene)) == {"c.jpg"}


@pytest.mark.parametrize("name", ["IMG_1.jpg", "2009-13-01.jpg", "202001011.jpg"])
def test_images_without_a_date_are_named(tmp_path, name):
    put_images(tmp_path, {"2009-08-31_a.jpg": None, name: None})
    scene = make_scene([0, 0], root=tmp_path, names=["2009-08-31_a.jpg", name])
    message = f"found none for 1 of 2 images, '{name}' for example; choose another strategy"
    with pytest.raises(SceneError) as error:
        make_split(scene, SplitSettings("date"), times_of(scene))
    assert message in str(error.value)


def test_whole_periods():
    scene = make_scene([0, 1, 2, 1])
    split = make_split(scene, SplitSettings("periods", periods=(1,)))
    assert held_out(split) == {"0001.png", "0003.png"}
    assert split.nearest_same_period is None


def test_hash_and_record():
    scene = make_scene([0] * 8 + [1] * 8)
    split = make_split(scene, SplitSettings(seed=3))
    assert split.hash == split_hash(split.scene) != split_hash(scene)
    record = split.record()
    assert record["split_hash"] == split.hash
    assert (record["strategy"], record["seed"], record["fraction"]) == ("stratified", 3, 0.125)
    assert [(c["id"], c["train"], c["test"]) for c in record["counts"]] == [(0, 7, 1), (1, 7, 1)]
    assert make_split(scene, SplitSettings("blocked")).record()["seed"] == 0


def test_frames_keep_all_but_their_split():
    scene = make_scene([0] * 8 + [1] * 8)
    new = make_split(scene, SplitSettings("stratified")).scene
    for a, b in zip(scene.frames, new.frames, strict=True):
        assert (a.name, a.camera, a.period, a.image_id) == (b.name, b.camera, b.period, b.image_id)
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)


@given(
    st.integers(1, 60).flatmap(
        lambda n: st.tuples(
            st.lists(st.tuples(*[st.floats(-100, 100)] * 3), min_size=n, max_size=n),
            st.integers(1, n),
        )
    )
)
def test_blocks_have_equally_many_cameras(case):
    places, count = np.array(case[0]), case[1]
    sizes = np.bincount(cut_into_blocks(places, count), minlength=count)
    assert len(sizes) == count and sizes.sum() == len(places)
    assert sizes.min() >= 1
    assert sizes.max() <= 2 * len(places) / count + 2


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), min_size=3, max_size=40),
    st.integers(1, 5),
    st.integers(0, 99),
)
def test_every_period_keeps_training_images(pairs, wanted, seed):
    used = sorted({b for b, _ in pairs})
    block = np.array([used.index(b) for b, _ in pairs])
    periods = np.array([p for _, p in pairs])
    chosen = choose_blocks(block, periods, wanted=wanted, seed=seed)
    is_test = np.isin(block, list(chosen))
    assert set(periods[~is_test]) == set(periods)


def test_periods_of_one_image_can_only_be_held_out_whole(make_scene_folder):
    scene = read(make_scene_folder({"a.png": 0, "b.png": 1}))
    with pytest.raises(ConfigError, match=r"found none left; hold out whole periods \(--strat"):
        make_split(scene, SplitSettings())
    assert make_split(scene, SplitSettings("periods", periods=(1,))).hash


def test_no_image_is_held_out_if_asked_for():
    new = make_split(make_scene([0, 0, 1]), SplitSettings("none"))
    assert {frame.split for frame in new.scene.frames} == {"train"} and new.nearest is None


def observed(scene):
    """Points by name, with the names of the frames that see them and where."""
    points, found = scene.points, {}
    for i, name in enumerate(points.ids.tolist()):
        rows = range(*points.track_start[i : i + 2])
        found[name] = [
            (scene.frames[points.track_frame[r]].name, *points.track_xy[r]) for r in rows
        ]
    return found


@given(
    st.lists(st.tuples(st.integers(0, 2), st.booleans()), max_size=40),
    st.lists(st.lists(st.integers(0, 48), unique=True, max_size=6), max_size=12),
    st.integers(0, 3),
)
@example([(0, True)], [[], []], 0)
def test_validation_knows_the_training_views_alone(drawn, tracks, seed):
    """Whole blocks of them are scored, and nothing of the test views is left."""
    drawn = [*((p, False) for p in (0, 1, 2) * 2), *drawn]
    rng = np.random.default_rng(len(drawn))
    scene = make_scene([p for p, _ in drawn], rng.normal(size=(len(drawn), 3)))
    frames = [
        replace(f, split="test" if test else "train")
        for f, (_, test) in zip(scene.frames, drawn, strict=True)
    ]
    tracks = [sorted(i % len(frames) for i in track) for track in tracks]
    lengths = [len(track) for track in tracks]
    points = Points(
        ids=np.arange(len(tracks)),
        xyz=rng.normal(size=(len(tracks), 3)),
        rgb=np.zeros((len(tracks), 3), np.uint8),
        error=np.zeros(len(tracks)),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_frame=np.array([i for track in tracks for i in track], np.int32),
        track_xy=rng.normal(size=(sum(lengths), 2)),
    )
    masks = {f.name: scene.images_root for f in frames[::2]}
    scene = replace(scene.with_frames(frames), points=points, masks=masks)
    found = hold_out_validation(scene, seed)

    names = {f.name for f in scene.select(split="train")}
    assert [f.name for f in found.frames] == sorted(names)
    assert found.masks.keys() == masks.keys() & names
    before = {name: [o for o in seen if o[0] in names] for name, seen in observed(scene).items()}
    # Where no point has a track, they come from a laser scan, which has seen no test view either.
    scanned = not any(tracks)
    assert observed(found) == {name: seen for name, seen in before.items() if seen or scanned}
    assert found.select(split="test")
    assert all(found.select(split="train", period=p) for p in range(3))
    kept = [f for f in frames if f.split == "train"]
    centres = camera_centre(np.stack([f.cam_from_world for f in kept]))
    block = cut_into_blocks(centres, min(len(kept), 16))
    tests = {b for f, b in zip(found.frames, block.tolist(), strict=True) if f.split == "test"}
    trains = {b for f, b in zip(found.frames, block.tolist(), strict=True) if f.split == "train"}
    assert not tests & trains


@pytest.mark.parametrize(
    ("splits", "found"),
    [
        ("test train train", "found none in period 0"),
        ("train test test", "found none in period 1"),
        ("train train test", "found 2 training images in 2 periods"),
    ],
)
def test_validation_needs_training_views_in_each_period(splits, found):
    scene = make_scene([0, 1, 1])
    frames = [replace(f, split=s) for f, s in zip(scene.frames, splits.split(), strict=True)]
    with pytest.raises(SceneError, match=f"validation: expected .*{found}"):
        hold_out_validation(scene.with_frames(frames))
