"""Depths of the sparse points in training views, by the observations of the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from chronoscene.harness.plan.parts import make_parts
from chronoscene.images.store import ImageStore
from chronoscene.scene import Points, Scene
from chronoscene.scene.cameras import project_points


@pytest.fixture
def scene(make_scene: Callable[..., Scene]) -> Scene:
    """The ring, four of whose points three images observe; the last two lie in one pixel."""
    made = make_scene()
    xyz = made.points.xyz[:4].copy()
    first = made.frames[0]
    centre = -first.cam_from_world[:3, :3].T @ first.cam_from_world[:3, 3]
    xyz[3] = centre + 1.3 * (xyz[2] - centre)
    seen = [0, 1, 2, 0, 1, 0, 3, 5, 0, 3, 4]
    points = Points(
        ids=np.arange(1, 5),
        xyz=xyz,
        rgb=np.zeros((4, 3), np.uint8),
        error=np.zeros(4),
        track_start=np.array([0, 3, 5, 8, 11]),
        track_frame=np.array(seen, np.int32),
        track_xy=np.zeros((11, 2)),
    )
    return replace(made, points=points)


def test_a_view_has_the_depths_of_what_it_observes(scene: Scene) -> None:
    store = ImageStore(scene)
    (part,) = make_parts(scene, store, "joint")
    to_training = part.train.training_from_world
    first = scene.frames[0]
    local = scene.points.xyz @ first.cam_from_world[:3, :3].T + first.cam_from_world[:3, 3]
    xy = np.floor(project_points(first.camera, local)).astype(int)
    assert (xy[2] == xy[3]).all() and local[2, 2] < local[3, 2]
    found = part.train.load_depths(0)
    expected = {xy[i, 1] * first.camera.width + xy[i, 0]: local[i, 2] for i in (0, 2)}
    assert dict(zip(found.pixels, found.depths, strict=True)) == pytest.approx(
        {pixel: to_training.scale * depth for pixel, depth in expected.items()}, rel=1e-6
    )
    names = [view.name for view in part.train.views]
    assert len(part.train.load_depths(names.index("b/3.png")).pixels) == 0
    # Of the points of a/1, which are the first two, only the first has three images.
    assert len(part.train.load_depths(names.index("a/1.png")).pixels) == 1


def test_pixels_that_do_not_count_have_none(scene: Scene) -> None:
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    pixels = part.train.load_depths(0).pixels
    mask = np.full((scene.frames[0].camera.height, scene.frames[0].camera.width), 255, np.uint8)
    mask.flat[pixels[0]] = 0
    path = scene.root / "mask.png"
    Image.fromarray(mask).save(path)
    masked = replace(scene, masks={scene.frames[0].name: path})
    (part,) = make_parts(masked, ImageStore(masked), "joint")
    np.testing.assert_array_equal(part.train.load_depths(0).pixels, pixels[1:])


def test_images_of_another_size_have_pixels_of_their_own(scene: Scene) -> None:
    whole, small = (
        make_parts(scene, ImageStore(scene, max_width=width), "joint")[0].train
        for width in (1600, 12)
    )
    (large, depths), (pixels, others) = whole.load_depths(0), small.load_depths(0)
    rows, columns = np.divmod(large, whole.views[0].width)
    halved = rows // 2 * small.views[0].width + columns // 2
    np.testing.assert_array_equal(pixels, np.sort(halved))
    np.testing.assert_allclose(np.sort(others), np.sort(depths), rtol=1e-6)
