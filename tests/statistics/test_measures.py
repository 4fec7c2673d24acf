"""Tracks, errors, baselines, overlap and coverage against plain definitions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.data.skeletons.dataset import write_skeleton
from chronoscene.formats import read_scene
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.statistics.counts import count_scene
from chronoscene.statistics.measures import (
    measure_scene,
    period_coverage,
    period_overlap,
    reproject,
    robust_range,
)

PINHOLE = Camera(1, "PINHOLE", 64, 48, (50.0, 52.0, 30.0, 25.5))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    out = tmp_path_factory.mktemp("measures") / "place"
    write_skeleton(out, [(12, 250), (7, 120), (9, 300)], seed=5)
    return read_scene(out)


def looking_down(x: float, height: float = 10.0) -> np.ndarray:
    """A camera above (x, 0) that looks along -z."""
    rotation = np.diag([1.0, -1.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ [x, 0.0, height]
    return pose


def small_scene(camera: Camera, frames: list[tuple[float, int]], tracks: list[list[int]]) -> Scene:
    """Cameras in a row that see points on the ground; observations are all at (0, 0)."""
    flat = [frame for track in tracks for frame in track]
    return Scene(
        name="row",
        root=None,  # type: ignore[arg-type]
        images_root=None,  # type: ignore[arg-type]
        frames=tuple(
            Frame(f"{i}.png", i + 1, camera, looking_down(x), p, "test" if i == 0 else "train")
            for i, (x, p) in enumerate(frames)
        ),
        points=replace(
            Points.empty(),
            ids=np.arange(len(tracks)),
            xyz=np.column_stack([np.arange(len(tracks)), np.zeros((len(tracks), 2))]).astype(float),
            track_start=np.cumsum([0, *map(len, tracks)]),
            track_frame=np.array(flat, np.int32),
            track_xy=np.zeros((len(flat), 2)),
        ),
        periods=tuple(Period(i, str(i)) for i in range(1 + max(p for _, p in frames))),
        split_rule="rule",
        format="chronoscene",
    )


def test_everything_equals_plain_loops(scene: Scene) -> None:
    """The definitions spelt out observation by observation."""
    found = measure_scene(scene)
    points = scene.points
    tracks = [
        [
            (int(points.track_frame[k]), points.track_xy[k])
            for k in range(*points.track_start[i : i + 2])
        ]
        for i in range(len(points))
    ]
    centres = camera_centre(scene.frame_poses)
    for p, measured in enumerate(found.periods):
        mine = [j for j, f in enumerate(scene.frames) if f.period == p]
        lengths, errors, depths = [], [], {j: [] for j in mine}
        for xyz, track in zip(points.xyz, tracks, strict=True):
            own = [(j, xy) for j, xy in track if j in depths]
            lengths += [len(own)] if own else []
            for j, xy in own:
                local = scene.frames[j].cam_from_world @ [*xyz, 1.0]
                at = scene.frames[j].camera.K @ local[:3]
                errors.append(np.linalg.norm(at[:2] / at[2] - xy))
                depths[j].append(local[2])
        ratios = [
            min(np.linalg.norm(centres[j] - centres[k]) for k in mine if k != j)
            / np.median(depths[j])
            for j in mine
            if depths[j]
        ]
        assert measured.observations == sum(lengths)
        assert measured.points_seen == len(lengths)
        assert measured.track_mean == pytest.approx(np.mean(lengths))
        assert measured.track_median == np.median(lengths)
        assert measured.reprojection_error == pytest.approx(np.mean(errors))
        assert measured.baseline == pytest.approx(np.median(ratios))
    whole = found.whole
    assert whole.observations == len(points.track_frame)
    assert whole.track_mean == pytest.approx(np.mean([len(t) for t in tracks]))
    assert whole.track_median == np.median([len(t) for t in tracks])
    errors = np.repeat(points.error, np.diff(points.track_start))  # means of the tracks
    assert whole.reprojection_error == pytest.approx(errors.mean())
    assert found.counts == count_scene(scene)
    assert found.unit == "metre"


@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), max_size=30))
def test_overlap_equals_sets(rows: list[list[bool]]) -> None:
    seen = np.array(rows, bool).reshape(-1, 3)
    sets = [set(np.flatnonzero(column)) for column in seen.T]
    for a, row in enumerate(period_overlap(seen)):
        for b, share in enumerate(row):
            expected = len(sets[a] & sets[b]) / len(sets[a]) if sets[a] else None
            assert share == expected or share == pytest.approx(expected)


def test_baseline_of_a_row_of_cameras() -> None:
    frames = [(0.0, 0), (2.0, 0), (5.0, 0), (1.0, 1), (1.5, 1), (90.0, 2)]
    scene = small_scene(PINHOLE, frames, [[0, 1, 2, 3, 4, 5]])
    found = measure_scene(scene)
    # 10 above the ground: nearest at 2, 2 and 3; 0.5 and 0.5; none.
    assert [m.baseline for m in found.periods] == [0.2, 0.05, None]
    assert found.whole.baseline == 0.2


def test_cameras_in_one_place_have_no_baseline_between_them() -> None:
    scene = small_scene(PINHOLE, [(0.0, 0), (0.0, 0)], [[0, 1]])
    assert measure_scene(scene).whole.baseline == 0.0


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_coverage_is_that_of_the_cubes(scale: float) -> None:
    half = np.arange(4000) < 2000
    xyz = np.random.default_rng(0).uniform(0, 1, (4000, 3)) * [1.0, 1.0, 0.001] * scale
    xyz[half, 0] *= 0.5
    xyz[~half, 0] = 0.5 * scale + 0.5 * xyz[~half, 0]
    shares = period_coverage(xyz, np.column_stack([half, ~half, half | True]))
    assert shares[0] == pytest.approx(0.5, abs=0.03)
    assert shares[1] == pytest.approx(0.5, abs=0.03)
    assert shares[2] == 1.0


def test_points_at_the_far_end_fill_no_cube_of_their_own() -> None:
    xyz = np.zeros((1000, 3))
    xyz[:, 0] = np.repeat(np.linspace(0, 1, 101), 10)[:1000]
    xyz[-10:, 0] = 1.0
    last = xyz[:, 0] == 1.0
    assert period_coverage(xyz, np.column_stack([last, ~last])) == [0.02, 1.0]


@pytest.mark.parametrize("outliers", [20, 600])
def test_outliers_do_not_change_coverage(outliers: int) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 1, (5000, 3))
    seen = np.column_stack([xyz[:, 0] < 0.3, np.ones(5000, bool)])
    before = period_coverage(xyz, seen)
    xyz[:outliers] += rng.uniform(-1e5, 1e5, (outliers, 3))
    assert period_coverage(xyz, seen)[0] == pytest.approx(before[0], abs=0.02)


def test_coverage_without_points_and_of_one_point() -> None:
    assert period_coverage(np.zeros((0, 3)), np.zeros((0, 2), bool)) == [None, None]
    assert period_coverage(np.ones((1, 3)), np.array([[True, False]])) == [1.0, 0.0]
    assert period_coverage(np.full((1, 3), np.nan), np.array([[True, True]])) == [None, None]


def test_what_cannot_be_projected_is_left_out() -> None:
    scene = small_scene(PINHOLE, [(0.0, 0), (1.0, 0)], [[0, 1], [0], [1]])
    expected = reproject(scene).residual
    assert np.isfinite(expected).all()
    xyz = scene.points.xyz.copy()
    xyz[0, 2], xyz[1] = 20.0, np.nan  # above the cameras; nowhere
    broken = replace(scene, points=replace(scene.points, xyz=xyz))
    found = reproject(broken)
    assert np.isnan(found.residual[:3]).all() and found.residual[3] == expected[3]
    assert np.isnan(found.depth[:3]).all() and found.depth[3] == 10.0
    assert np.isnan(found.depth_of_frame[0]) and found.depth_of_frame[1] == 10.0
    measured = measure_scene(broken)
    assert measured.whole.observations == 4
    assert measured.whole.reprojection_error == pytest.approx(expected[3])


def test_a_scene_without_points_has_counts_and_nothing_to_measure() -> None:
    scene = replace(small_scene(PINHOLE, [(0.0, 0), (1.0, 1)], []), points=Points.empty())
    found = measure_scene(scene)
    for measured in (*found.periods, found.whole):
        assert measured.observations == 0
        assert measured.track_mean is measured.reprojection_error is measured.coverage is None
    assert found.overlap == found.in_view == ((None, None), (None, None))


def test_distortion_is_applied() -> None:
    radial = Camera(1, "SIMPLE_RADIAL", 64, 48, (50.0, 30.0, 25.5, -0.1))
    scene = small_scene(radial, [(0.0, 0)], [[0], [0], [0]])
    residual = reproject(scene).residual
    for i, x in enumerate((0.0, 0.1, 0.2)):  # depth 10, so x / z
        u = 50.0 * x * (1 - 0.1 * x * x) + 30.0
        assert residual[i] == pytest.approx(np.hypot(u, 25.5), abs=1e-9)


def test_real_scenes(shared_data) -> None:
    rendered = measure_scene(read_scene(shared_data / "plaza"))
    assert rendered.whole.reprojection_error < 1e-6  # observations are exact projections
    photos = read_scene(shared_data / "sheffield_scene")
    measured = measure_scene(photos).whole.reprojection_error
    lengths = np.diff(photos.points.track_start)
    stored = np.average(photos.points.error, weights=lengths)
    assert measured == pytest.approx(stored, rel=0.01)  # COLMAP's own number


@pytest.mark.parametrize("share", [0.0, 0.02, 0.06, 0.15])
def test_an_even_spread_is_inside_as_a_whole_and_outliers_are_not(share: float) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform([-50, -15, -3], [50, 15, 3], (20_000, 3))
    far = rng.random(len(place)) < share
    xyz = np.where(far[:, None], place * rng.uniform(5, 400, (len(place), 1)), place)
    low, high = robust_range(xyz)
    assert ((place >= low - 0.1) & (place <= high + 0.1)).all()
    assert (high - low <= 1.2 * np.ptp(place, axis=0) + 2).all()


def test_towers_of_a_flat_place_are_no_outliers() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([0, 0, 0], [100, 100, 0.2], (10_000, 3))
    xyz[:500, 2] = rng.uniform(0, 40, 500)
    assert robust_range(xyz)[1, 2] > 20


@given(
    st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=40),
    st.sampled_from([1e-6, 1.0, 1e3]),
)
def test_limits_are_in_order_and_within_the_cloud(places: list, scale: float) -> None:
    xyz = scale * np.array(places)
    low, high = robust_range(xyz)
    assert (low <= high).all()
    assert (low >= xyz.min(axis=0)).all() and (high <= xyz.max(axis=0)).all()


def test_a_choice_of_many_points_gives_the_same() -> None:
    xyz = np.random.default_rng(0).normal(size=(400_000, 3))
    np.testing.assert_allclose(robust_range(xyz), robust_range(xyz[:90_000]), atol=0.05)
