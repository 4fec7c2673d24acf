"""Sparse points: exact projections of surface points that the views really see."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from chronoscene.synth import preset
from chronoscene.synth.sparse_points import MAX_ALBEDO_CHANGE


@pytest.fixture(scope="module")
def observations(made):  # type: ignore[no-untyped-def]
    """Point, frame and pixel of every observation."""
    points = made.scene.points
    rows = np.repeat(np.arange(len(points)), np.diff(points.track_start))
    return rows, points.track_frame, points.track_xy


def sight_rays(frame, xy):  # type: ignore[no-untyped-def]
    """Rays through pixels, from the camera file alone. [n, 6]"""
    pose = np.linalg.inv(frame.cam_from_world)
    local = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(frame.camera.K).T
    rays = np.empty((len(xy), 6), np.float32)
    rays[:, :3], rays[:, 3:] = pose[:3, 3], local @ pose[:3, :3].T
    return rays


def test_number_and_length_of_tracks(made) -> None:  # type: ignore[no-untyped-def]
    points = made.scene.points
    assert len(points) == made.settings.points
    assert np.diff(points.track_start).min() >= 3
    assert (points.error == 0).all()


def test_observations_are_exact_projections(made, observations) -> None:  # type: ignore[no-untyped-def]
    rows, frames, xy = observations
    worst = 0.0
    for i, frame in enumerate(made.scene.frames):
        mine = frames == i
        x = made.scene.points.xyz[rows[mine]]
        local = x @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
        pixel = (local @ frame.camera.K.T)[:, :2] / local[:, 2:]
        if mine.any():
            worst = max(worst, np.abs(pixel - xy[mine]).max())
    assert worst < 1e-8


def test_tracks_use_training_views_once_each(made, observations) -> None:  # type: ignore[no-untyped-def]
    rows, frames, _ = observations
    train = np.array([f.split == "train" for f in made.scene.frames])
    assert train[frames].all()
    assert len(np.unique(np.stack([rows, frames]), axis=1).T) == len(rows)


def test_every_observation_is_seen_again(made, observations, renderers) -> None:  # type: ignore[no-untyped-def]
    """A ray through the observed pixel ends at the point; occluded points would be nearer."""
    rows, frames, xy = observations
    for i, frame in enumerate(made.scene.frames):
        mine = frames == i
        if not mine.any():
            continue
        hits = renderers[frame.period].surfaces.cast(sight_rays(frame, xy[mine]))
        x = made.scene.points.xyz[rows[mine]]
        depth = x @ frame.cam_from_world[2, :3] + frame.cam_from_world[2, 3]
        # Rays are single precision: a grazing one may slip past the edge that it should meet.
        wrong = np.abs(hits.t - depth) > 1e-3 * depth + 2e-3
        assert wrong.mean() <= 0.01, frame.name


def test_tracks_join_periods_only_where_nothing_changed(made, observations, renderers) -> None:  # type: ignore[no-untyped-def]
    rows, frames, _ = observations
    period = np.array([f.period for f in made.scene.frames])[frames]
    albedo = np.zeros((len(rows), 3))
    element = np.zeros(len(rows), int)
    for i, frame in enumerate(made.scene.frames):
        mine = np.flatnonzero(frames == i)
        if len(mine):
            renderer = renderers[frame.period]
            near = renderer.surface_near(made.scene.points.xyz[rows[mine]])
            element[mine] = renderer.elements_of(near)
            albedo[mine] = renderer.albedo_on(made.scene.points.xyz[rows[mine]], near)
    joined = 0
    for point in np.unique(rows[period == 0]):
        mine = rows == point
        if len(set(period[mine])) < 2:
            continue
        joined += 1
        spread = albedo[mine].max(axis=0) - albedo[mine].min(axis=0)
        # At an edge the nearest triangle may be the neighbour's in one of the periods.
        if len(set(element[mine])) == 1:
            assert spread.max() <= MAX_ALBEDO_CHANGE + 1e-9
    assert joined > 0.2 * len(made.scene.points)


def test_colours_are_means_of_the_observed_pixels(made, observations) -> None:  # type: ignore[no-untyped-def]
    rows, frames, xy = observations
    images = [cv2.imread(str(made.scene.image_path(f)))[..., ::-1] for f in made.scene.frames]
    for point in range(0, len(made.scene.points), 97):
        mine = rows == point
        cells = np.floor(xy[mine]).astype(int)
        values = [images[f][y, x] for f, (x, y) in zip(frames[mine], cells, strict=True)]
        mean = np.mean(np.array(values, float), axis=0)
        np.testing.assert_allclose(made.scene.points.rgb[point], mean, atol=0.51)


@pytest.mark.slow
def test_noise_is_reported_as_error(tmp_path) -> None:  # type: ignore[no-untyped-def]
    from chronoscene.formats import chronoscene as scene_format
    from chronoscene.synth import generate

    settings = preset("tiny", width=48, height=36, views=5, points=150, noise=0.7)
    generate(tmp_path / "noisy", settings)
    points = scene_format.read(tmp_path / "noisy").points
    # The mean length of a Gaussian step in the plane is sigma * sqrt(pi / 2).
    assert np.mean(points.error) == pytest.approx(0.7 * np.sqrt(np.pi / 2), rel=0.15)
    assert (points.track_xy >= 0).all() and (points.track_xy < [48, 36]).all()
