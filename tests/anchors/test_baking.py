"""Baked anchors: equal to what was decoded where nothing depends on the direction, else near it."""

import numpy as np
import pytest
import torch

from chronoscene.anchors.baking import bake
from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.anchors.model import AnchorLayout, AnchorModel
from chronoscene.methods import View
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene.geometry import look_at
from chronoscene.training.drawing import Splats, camera_centre_tensor, draw
from chronoscene.training.spherical_harmonics import evaluate

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])
WEIGHTS = torch.ones(1)


def ring(count, phase=0.0):
    """Views from above, all around the origin."""
    K = np.array([[60.0, 0.0, 24.0], [0.0, 60.0, 18.0], [0.0, 0.0, 1.0]])
    angles = phase + 2 * np.pi * np.arange(count) / count
    eyes = [np.array([2 * np.cos(a), 2 * np.sin(a), 1.0]) for a in angles]
    return [View(K, 48, 36, look_at(eye, np.zeros(3))) for eye in eyes]


def make_model(see_direction):
    """Anchors in a ball with features that are not zero, half of their Gaussians switched on."""
    layout = AnchorLayout(1, offsets=4, base_dim=8)
    rng = np.random.default_rng(0)
    anchors = rng.normal(size=(150, 3)).astype(np.float32) * 0.25
    config = AnchorConfig(feature_init="gaussian", feature_init_scale=1.0)
    model = AnchorModel.start(layout, config, anchors, torch.Generator().manual_seed(3))
    for head in set(HEADS) - set(see_direction):
        model.first_layer(head)[2].zero_()
    model.offsets.copy_(torch.from_numpy(rng.normal(size=(150, 4, 3)).astype(np.float32)))
    return model


def decoded(model, view):
    splats, _ = model.decode_active(WEIGHTS, *model.seen_from(view))
    return picture(splats, view)


def baked(cloud, view, terms=16):
    means, quats, scales, opacities, sh = (
        torch.from_numpy(getattr(cloud, name))
        for name in ("means", "quats", "scales", "opacities", "sh_coeffs")
    )
    degree = round(terms**0.5) - 1
    colors = evaluate(sh[:, 0], sh[:, 1:], means, camera_centre_tensor(view), degree)
    return picture(Splats(means, quats, scales, opacities, colors), view)


def picture(splats, view):
    raster = draw(splats, view, BACKGROUND, near_plane=0.01, antialiased=False)
    return raster.image[0].numpy().clip(0, 1)


def test_what_does_not_depend_on_the_direction_stays_as_it_is():
    model = make_model(())
    cloud = bake(model, WEIGHTS, ring(12))
    assert len(cloud) > 100
    for view in ring(5, phase=0.1):
        np.testing.assert_allclose(baked(cloud, view), decoded(model, view), atol=2e-3)


@pytest.mark.parametrize(("heads", "one_colour", "least"), [(("color",), 50, 55), (HEADS, 35, 33)])
def test_new_views_are_near_the_model(heads, one_colour, least):
    """In dB between the two; colours with one term each, and with all."""
    model = make_model(heads)
    cloud = bake(model, WEIGHTS, ring(30))
    views = ring(7, phase=0.05)
    found = [np.mean([psnr(baked(cloud, v, n), decoded(model, v)) for v in views]) for n in (1, 16)]
    assert found[0] < one_colour and found[1] > least, found


def test_large_views_give_what_small_ones_do():
    """Weights come from images of about 320 x 240 pixels, whatever the size of the views."""
    model = make_model(HEADS)
    large = [
        View(v.K * [[20], [20], [1]], 20 * v.width, 20 * v.height, v.cam_from_world)
        for v in ring(30)
    ]
    clouds = [bake(model, WEIGHTS, views) for views in (large, ring(30))]
    views = ring(7, phase=0.05)
    found = [np.mean([psnr(baked(c, v), decoded(model, v)) for v in views]) for c in clouds]
    assert found[0] > found[1] - 0.5, found


def test_what_no_view_shows_is_left_out():
    model = make_model(())
    views = ring(12)
    model.anchors[:50] += torch.tensor([0.0, 0.0, 40.0])
    cloud = bake(model, WEIGHTS, views)
    assert len(cloud) and cloud.means[:, 2].max() < 10


def test_the_result_does_not_depend_on_the_order_of_the_views():
    model = make_model(HEADS)
    first, second = (bake(model, WEIGHTS, ring(8)[::step]) for step in (1, -1))
    assert len(first) == len(second)
    np.testing.assert_allclose(first.opacities, second.opacities, rtol=1e-4)
    np.testing.assert_allclose(first.sh_coeffs, second.sh_coeffs, atol=1e-3)
