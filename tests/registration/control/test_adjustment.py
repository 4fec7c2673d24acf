"""Adjustment with ground control: weights, a wrong point, and how well it says poses are known."""

from typing import Any

import numpy as np
import pytest

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.control.adjustment import adjust_with_control
from chronoscene.registration.control.precision import standard_deviations

SIDE = 40.0


def make_model(photos: int = 6, tie_points: int = 60, seed: int = 0) -> Any:
    """Photos of a hilly square from 40 m, and their points, without noise."""
    rng = np.random.default_rng(seed)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=1000, height=800, params=[900, 500, 400, -0.02]
    )
    model.add_camera_with_trivial_rig(camera)
    for i in range(1, photos + 1):
        centre = np.array([*rng.uniform(-12, 12, 2), 40.0])
        down = np.diag([1.0, -1.0, -1.0]) @ _turn(rng.normal(0, 0.15, 3))
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i)
        pose = pycolmap.Rigid3d(np.column_stack([down, -down @ centre]))
        model.add_image_with_trivial_frame(image, pose)
    points = np.column_stack([rng.uniform(-15, 15, (tie_points, 2)), rng.uniform(0, 6, tie_points)])
    for xyz in points:
        clicks = project(model, xyz)
        track = pycolmap.Track()
        for name, x, y in clicks:
            image_id = int(name[:-4])
            observed = model.images[image_id].points2D
            observed.append(pycolmap.Point2D(np.array([x, y])))
            track.add_element(image_id, len(observed) - 1)
        if len(clicks) > 1:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return model


def _turn(vector: np.ndarray) -> np.ndarray:
    return pycolmap.Rotation3d(np.asarray(vector, np.float64)).matrix()


def project(model: Any, xyz: np.ndarray) -> list[list[Any]]:
    """Name and pixels in each image that sees a place."""
    found = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        xy = camera.img_from_cam(image.cam_from_world() * xyz)
        if xy is not None and 0 < xy[0] < camera.width and 0 < xy[1] < camera.height:
            found.append([str(image.name), *xy.tolist()])
    return found


def make_control(model: Any, count: int, seed: int = 1) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-12, 12, (count, 2)), rng.uniform(0, 6, count)])
    return [
        {"name": f"g{i}", "xyz": p.tolist(), "sigma": [0.02] * 3, "clicks": project(model, p)}
        for i, p in enumerate(places)
    ]


def disturb(model: Any, noise: float, seed: int) -> None:
    """Move everything a little, and give all observations noise."""
    rng = np.random.default_rng(seed)
    sim = np.column_stack([1.01 * _turn(rng.normal(0, 0.01, 3)), rng.normal(0, 0.3, 3)])
    model.transform(pycolmap.Sim3d(sim))
    for image in model.images.values():
        for observed in image.points2D:
            observed.xy = observed.xy + rng.normal(0, noise, 2)


def centres(model: Any) -> np.ndarray:
    return np.array([model.images[i].projection_center() for i in sorted(model.images)])


def test_the_frame_is_that_of_the_control() -> None:
    model = make_model()
    truth, control = centres(model), make_control(model, 6)
    disturb(model, 0.0, 0)
    assert np.abs(centres(model) - truth).max() > 0.2
    adjust_with_control(model, control)
    assert np.abs(centres(model) - truth).max() < 1e-3
    assert len(model.images) == 6  # what stood in for the coordinates is gone
    assert len(model.cameras) == 1


def test_a_rough_point_moves_nothing_and_a_wrong_one_little() -> None:
    model = make_model()
    truth, control = centres(model), make_control(model, 7)
    control[0]["xyz"][2] += 1.0
    control[0]["sigma"] = [1.0] * 3
    disturb(model, 0.3, 2)
    other = pycolmap.Reconstruction(model)
    adjust_with_control(model, control)
    rough = np.abs(centres(model) - truth).max()
    control[0]["sigma"] = [0.02] * 3  # now it is a gross error: 50 standard deviations
    adjust_with_control(other, control)
    assert rough < 0.15
    assert np.abs(centres(other) - truth).max() < 0.2


def test_accuracy_counts_by_axis() -> None:
    model = make_model(tie_points=0)
    control = make_control(model, 6)
    for point in control:
        point["sigma"] = [0.01, 0.01, 1.0]
        point["xyz"][2] += 0.5 if point["name"] == "g3" else 0.0
    ids = adjust_with_control(model, control, constant_cameras=True)
    found = model.points3D[ids["g3"]].xyz - control[3]["xyz"]
    assert abs(found[2] + 0.5) < 0.1  # the photos know better
    assert np.abs(found[:2]).max() < 0.02


@pytest.mark.parametrize("tie_points", [0, 40])
def test_standard_deviations_are_those_of_many_draws(tie_points: int) -> None:
    """The errors of repeated adjustments, in units of the deviations that each of them states."""
    ratios = []
    for seed in range(12):
        model = make_model(photos=3, tie_points=tie_points)
        truth, control = centres(model), make_control(model, 5)
        rng = np.random.default_rng(100 + seed)
        for point in control:
            point["xyz"] = (np.array(point["xyz"]) + rng.normal(0, 0.05, 3)).tolist()
            point["sigma"] = [0.05] * 3
            for click in point["clicks"]:
                click[1:] = (np.array(click[1:]) + rng.normal(0, 1, 2)).tolist()
        for image in model.images.values():
            for observed in image.points2D:
                observed.xy = observed.xy + rng.normal(0, 1, 2)
        ids = adjust_with_control(model, control, constant_cameras=True)
        poses, places = standard_deviations(model, control, ids)
        stated = np.array([poses[f"{i}.jpg"][0] for i in sorted(model.images)])
        ratios.append((centres(model) - truth) / stated)
        assert set(places) == {c["name"] for c in control}
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_what_is_not_determined_has_no_deviations() -> None:
    model = make_model(photos=2, tie_points=0)
    control = make_control(model, 2)
    ids = adjust_with_control(model, control, constant_cameras=True)
    assert standard_deviations(model, control, ids) == ({}, {})
