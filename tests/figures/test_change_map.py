"""Top views of changes: what is drawn where, and how many panels."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from chronoscene.figures.canvas import rgb_of
from chronoscene.figures.change_map import COLORS, ChangePanel, draw_changes
from chronoscene.figures.cloud import Cloud
from chronoscene.harness.use.changes import CLASSES

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def cloud():
    up = np.array([[0.0, 0.0, 1.0]])
    xyz = np.random.default_rng(0).uniform([-20, -10, 0], [20, 10, 4], (3000, 3))
    rows = {"centres": 50 * up, "directions": -up, "tops": np.array([[0.0, 1.0, 0.0]])}
    period, camera_period = np.zeros(3000, int), np.zeros(1, int)
    return Cloud("place", "metre", ("0",), xyz, period, **rows, camera_period=camera_period)


def test_classes_have_their_colours_in_their_order():
    assert tuple(COLORS) == CLASSES


def test_changes_are_drawn_over_what_is_below_them(cloud, tmp_path):
    rng = np.random.default_rng(0)
    ground = rng.uniform([-20, -10, 0], [20, 10, 0], (200_000, 3))
    patch = rng.uniform([10, 5, 0], [12, 7, 0], (5000, 3))
    classes = np.repeat([0, CLASSES.index("new")], [len(ground), len(patch)])
    draw_changes(
        cloud,
        [ChangePanel("a $b_c$", np.concatenate([ground, patch]), classes)],
        tmp_path / "x.png",
        up=UP,
    )
    red, green, blue = np.moveaxis(
        np.asarray(Image.open(tmp_path / "x.png"), int)[100:, :, :3], 2, 0
    )
    new = np.argwhere(blue - red > 40)
    np.testing.assert_allclose(np.ptp(new, axis=0), 2 / 43 * 3.4 * 200, atol=4)  # 2 m of about 43
    assert len(new) > 0.9 * np.prod(np.ptp(new, axis=0) + 1)
    ground = np.argwhere((red - blue > 5) & (green < 235))
    above, right = (new.mean(axis=0) - ground.mean(axis=0)) * (-1, 1)
    np.testing.assert_allclose(right / above, 11 / 6, rtol=0.1)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_maps_are_seen_from_above_whatever_axis_is_up(cloud, tmp_path, axis, sign):
    """An L of changes, in a world that is turned with the scene and all but upright."""
    ell = np.concatenate([[[x, 0, 1] for x in range(6)], [[0, y, 1] for y in range(10)]])
    turn = np.zeros((3, 3))  # columns: where x, y and z of the cloud go
    turn[axis, 2] = sign
    turn[(axis + 1) % 3, 0 if sign > 0 else 1] = 1
    turn[(axis + 2) % 3, 1 if sign > 0 else 0] = 1
    assert np.linalg.det(turn) == 1  # no mirror
    turned = replace(cloud, xyz=cloud.xyz @ turn.T)
    panel = ChangePanel("", ell @ turn.T, np.full(len(ell), CLASSES.index("new")))
    up = turn @ [0.3, -0.2, 0.9]
    draw_changes(turned, [panel], tmp_path / "x.png", up=up)
    red, _, blue = np.moveaxis(np.asarray(Image.open(tmp_path / "x.png"), int)[100:, :, :3], 2, 0)
    rows, columns = np.nonzero(blue - red > 40)
    corner = (rows > rows.max() - 3) & (columns < columns.min() + 3)
    assert corner.any() and not ((rows < rows.max() - 3) & (columns > columns.min() + 3)).any()
    tall, wide = np.ptp(rows), np.ptp(columns)
    np.testing.assert_allclose(tall / wide, 9 / 5, rtol=0.05)


@pytest.mark.parametrize(
    ("panels", "shape"),
    [
        (1, (1, 1)),
        pytest.param(3, (1, 3), marks=pytest.mark.slow),
        (5, (2, 3)),
        pytest.param(10, (3, 4), marks=pytest.mark.slow),
    ],
)
def test_panels_in_rows(cloud, tmp_path, panels, shape):
    panel = ChangePanel("", cloud.xyz, np.zeros(3000, int))
    draw_changes(cloud, [panel] * panels, tmp_path / "x.png", up=UP)
    pixels = np.asarray(Image.open(tmp_path / "x.png").convert("RGB"))
    height, width = pixels.shape[:2]
    one = 3.55 * 200, height / shape[0]
    assert round(width / one[0]) == shape[1]
    assert 0.4 * one[0] < one[1] < one[0]
    shown = {tuple(color) for color in pixels[:150].reshape(-1, 3).tolist()}
    assert {tuple(rgb_of(color)) for color in COLORS.values()} <= shown  # the whole legend
    assert (pixels[:150, -10:] == 255).all()
