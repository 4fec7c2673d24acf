"""Choice of pairs, similarity of images, and held-out tracks."""

import numpy as np
import pytest

from chronoscene.registration.features import pairs as choice
from chronoscene.registration.features.holdout import build_tracks, eligible_tracks, first_at_place
from chronoscene.registration.features.pairs import (
    assign,
    global_descriptors,
    sequential_pairs,
    similar_pairs,
    spatial_pairs,
    visual_words,
    vlad,
)


def test_neighbours_in_space_are_found_in_every_period() -> None:
    line = np.array([[float(i), 0.0, 0.0] for i in range(50)])
    enu = np.concatenate([line, line + np.array([0.2, 0.0, 500.0])])  # heights of GPS are poor
    periods = np.repeat([0, 1], 50)
    pairs = spatial_pairs(enu, periods)
    for i in range(50):
        assert (i, 50 + i) in pairs
        assert i == 49 or (i, i + 1) in pairs
    assert (0, 49) not in pairs
    assert all(i < j for i, j in pairs)


def test_images_without_a_position_have_no_neighbours_in_space() -> None:
    enu = np.array([[0.0, 0, 0], [1, 0, 0], [np.nan] * 3])
    assert spatial_pairs(enu, np.zeros(3, np.int64)) == {(0, 1)}


def test_sequences_follow_time_within_periods() -> None:
    times = ["2020-01-01T10:00:09", "2020-01-01T10:00:01", None, None]
    images = [{"name": f"{i}", "taken": t} for i, t in enumerate(times)]
    assert sequential_pairs(images, np.array([0, 0, 1, 1])) == {(0, 1), (2, 3)}
    long = [{"name": f"{i:02}", "taken": None} for i in range(20)]
    pairs = sequential_pairs(long, np.zeros(20, np.int64))
    assert (0, 1) in pairs
    assert (0, 4) in pairs
    assert (0, 5) not in pairs


def test_similar_images_are_found_across_periods() -> None:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(30, 64))
    vectors = np.concatenate([places, places + 0.1 * rng.normal(size=(30, 64))]).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    pairs = similar_pairs(vectors, np.repeat([0, 1], 30))
    assert all((i, 30 + i) in pairs for i in range(30))
    assert len(pairs) < 60 * 59 / 4


def test_global_descriptors_tell_textures_apart() -> None:
    rng = np.random.default_rng(1)
    kinds = rng.normal(size=(4, 300, 128)).astype(np.float32)

    def image(kind: int) -> np.ndarray:
        chosen = kinds[kind][rng.permutation(300)[:200]]
        chosen = chosen + 0.1 * rng.normal(size=chosen.shape).astype(np.float32)
        return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True), np.float32)

    local = [image(k) for k in (0, 0, 1, 1, 2, 3)]
    words = visual_words(np.concatenate(local), rng)
    vectors = np.stack([vlad(d, words) for d in local])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-5)
    similarity = vectors @ vectors.T
    assert min(similarity[0, 1], similarity[2, 3]) > similarity[0, 2:].max() + 0.2
    assert not vlad(np.zeros((0, 128), np.float32), words).any()
    assert assign(words, words).tolist() == list(range(len(words)))


def test_words_are_learnt_from_a_sample_of_all_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where images have no features, or descriptors of another kind."""
    rng = np.random.default_rng(2)
    sizes = {"a": (60, 128), "none": (0, 128), "other": (7, 64), "b": (40, 128)}
    local = {name: rng.normal(size=size).astype(np.float32) for name, size in sizes.items()}
    monkeypatch.setattr(choice, "MAX_TRAINING", 80)
    monkeypatch.setattr(choice, "_local", lambda database, name: local[name])
    again = np.random.default_rng(0)
    every = np.concatenate([local["a"], local["b"]])
    words = visual_words(every[again.choice(100, 80, replace=False)], again)
    nothing = local["none"]
    expected = [vlad(d, words) for d in (local["a"], nothing, nothing, local["b"])]
    np.testing.assert_array_equal(global_descriptors("", list(local)), np.stack(expected))


KEYPOINTS = {
    i: np.random.default_rng(i).uniform(0, 99, (n, 2)) for i, n in ((1, 8), (2, 6), (5, 6))
}


@pytest.fixture
def matches() -> dict[tuple[int, int], np.ndarray]:
    """Images 1, 2 (period 0) and 5 (period 1); a track over all, one of a period, a wrong one."""
    return {
        (1, 2): np.array([[0, 0], [1, 1], [2, 3]]),
        (2, 5): np.array([[0, 4], [3, 5]]),
        (1, 5): np.array([[0, 4], [7, 5]]),  # keypoints 2 and 7 of image 1 meet in 5: wrong
    }


def test_matches_become_tracks(matches: dict[tuple[int, int], np.ndarray]) -> None:
    tracks = build_tracks(matches, KEYPOINTS)
    assert int(tracks.track.max()) + 1 == 3
    whole = tracks.of(1, np.array([0]))[0]
    mine = tracks.track == whole
    members = sorted(zip(tracks.image[mine], tracks.keypoint[mine], strict=True))
    assert members == [(1, 0), (2, 0), (5, 4)]
    assert tracks.of(1, np.array([3]))[0] == -1


def test_held_out_tracks_are_consistent_and_of_two_periods(
    matches: dict[tuple[int, int], np.ndarray],
) -> None:
    tracks = build_tracks(matches, KEYPOINTS)
    eligible = eligible_tracks(tracks, {1: 0, 2: 0, 5: 1})
    assert eligible.tolist() == [tracks.of(1, np.array([0]))[0]]
    assert len(eligible_tracks(tracks, {1: 0, 2: 0, 5: 0})) == 0


def test_no_matches_make_no_tracks() -> None:
    tracks = build_tracks({}, {1: np.zeros((3, 2)), 2: np.zeros((0, 2))})
    assert len(tracks.track) == 0
    assert len(eligible_tracks(tracks, {1: 0, 2: 1})) == 0


def test_keypoints_at_one_place_are_one(matches: dict[tuple[int, int], np.ndarray]) -> None:
    xy = np.array([[1.5, 2.0], [3.0, 4.0], [1.5, 2.0], [1.5, 2.5]])
    assert first_at_place(xy).tolist() == [0, 1, 0, 3]
    keypoints = {i: p.copy() for i, p in KEYPOINTS.items()}
    keypoints[1][4] = keypoints[1][0]  # the same place with another orientation
    tracks = build_tracks(matches | {(1, 2): np.array([[4, 0], [0, 0]])}, keypoints)
    assert tracks.of(1, np.array([4])) == tracks.of(1, np.array([0]))
    assert tracks.of(1, np.array([0]))[0] in eligible_tracks(tracks, {1: 0, 2: 0, 5: 1})
