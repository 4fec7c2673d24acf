"""From models and held-out tracks to a registration."""

import json
from pathlib import Path

import numpy as np

from chronoscene.registration.features.correspondences import Matched
from chronoscene.registration.quality.rays import cross_matches
from chronoscene.registration.reconstruct.estimation import (
    connected_periods,
    read_held_out,
    reasons,
    without_twins,
)
from chronoscene.scene import Points


def make_points(tracks: list[list[tuple[int, float]]]) -> Points:
    """Points with tracks of frames and x coordinates."""
    flat = [observation for track in tracks for observation in track]
    count = len(tracks)
    return Points(
        ids=np.arange(1, count + 1),
        xyz=np.arange(3.0 * count).reshape(-1, 3),
        rgb=np.zeros((count, 3), np.uint8),
        error=np.zeros(count),
        track_start=np.cumsum([0, *map(len, tracks)]),
        track_frame=np.array([f for f, _ in flat], np.int32),
        track_xy=np.array([[x, 1.0] for _, x in flat]),
    )


def test_of_twins_the_longer_track_stays() -> None:
    twins = [[(0, 5.0), (1, 6.0)], [(0, 5.0), (1, 6.0), (2, 7.0)]]
    others = [[(0, 9.0), (1, 9.0)], [(1, 5.0), (2, 6.0)]]
    found = without_twins(make_points([*twins, *others]))
    assert found.ids.tolist() == [2, 3, 4]
    assert found.track_start.tolist() == [0, 3, 5, 7]
    assert found.track_frame.tolist() == [0, 1, 2, 0, 1, 1, 2]
    assert found.xyz[0].tolist() == [3.0, 4.0, 5.0]


def test_no_points_have_no_twins() -> None:
    assert len(without_twins(Points.empty())) == 0


def test_periods_are_connected_by_enough_matches() -> None:
    across = {"0-2": 3, "2-3": 5, "0-4": 2}
    matched = Matched({}, {}, across, dict.fromkeys(across, 100))
    assert connected_periods(matched, {0, 2, 3})  # no photo of period 1 can be used
    assert connected_periods(matched, {3})
    assert not connected_periods(matched, {0, 1, 2, 3})
    assert not connected_periods(matched, {0, 2, 4})


def test_held_out_tracks_of_two_periods_become_matches(tmp_path: Path) -> None:
    known = {7: "a/1", 8: "a/2", 9: "b/1", 11: "b/lost"}
    np.savez(
        tmp_path / "held.npz",
        track=np.array([0, 0, 0, 1, 1, 2, 2]),
        image=np.array([7, 9, 8, 7, 8, 9, 11]),
        xy=np.arange(14.0).reshape(7, 2),
        names=np.frombuffer(json.dumps(known).encode(), np.uint8),
    )
    names = ("a/1", "a/2", "b/1")
    periods = {"a/1": 0, "a/2": 0, "b/1": 1, "b/lost": 1}
    tracks = read_held_out(tmp_path / "held.npz", names, periods)
    assert tracks.start.tolist() == [0, 3]  # the second is of one period, the third of one image
    assert tracks.image.tolist() == [0, 1, 2]
    assert tracks.xy.tolist() == [[0.0, 1.0], [4.0, 5.0], [2.0, 3.0]]
    matches = cross_matches(tracks, np.array([0, 0, 1]))
    assert [(a.tolist(), b.tolist()) for a, b in matches] == [([0], [2]), ([1], [2])]


def test_photos_without_a_pose_have_reasons() -> None:
    missing = {"dark", "alone", "apart", "odd"}
    keypoints = {"there": 900, "dark": 12, "alone": 500, "apart": 800, "odd": 700}
    partners = {"alone": 0, "apart": 4, "odd": 3}
    found = reasons(missing, keypoints, partners, [["apart", "another"]])
    assert found == {
        "alone": "none of its 500 features are matched in any other photo",
        "apart": "in a submodel of 2 images that could not be placed; photos that show both it and "
        "the rest would connect it",
        "dark": "only 12 features: blurred, dark, or without texture",
        "odd": "matched with 3 photos, but too few of the matches agree on a pose; photos between "
        "this one and its neighbours, half a step apart, would connect it",
    }
