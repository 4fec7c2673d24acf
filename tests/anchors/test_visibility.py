"""Which anchors a view can see."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.anchors.visibility import projected_centres, visible_anchors
from chronoscene.methods import View
from chronoscene.rasterizer import NEAR_PLANE, rasterize
from chronoscene.training.splatting import camera_tensors


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_anchor_that_the_rasterizer_would_draw_is_decoded(seed: int) -> None:
    generator = np.random.default_rng(seed)
    anchors = generator.normal(0.0, 3.0, (200, 3)).astype(np.float32)
    log_scales = np.log(generator.uniform(0.001, 1.0, (200, 6))).astype(np.float32)
    K = np.array([[30.0, 0, 17.3], [0, 32.0, 9.1], [0, 0, 1]])
    view = View(K=K, width=40, height=24, cam_from_world=np.eye(4))
    raster = rasterize(
        torch.from_numpy(anchors),
        torch.tensor([[1.0, 0, 0, 0]]).expand(200, 4),
        torch.from_numpy(np.exp(log_scales[:, :3])),
        torch.full((200,), 0.999),
        torch.ones(200, 1),
        torch.eye(4)[None],
        torch.from_numpy(K.astype(np.float32))[None],
        40,
        24,
        backend="reference",
    )
    drawn = np.flatnonzero((raster.info.radii[0] > 0).all(dim=1).numpy())
    visible = visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE)
    assert set(drawn) <= set(visible)
    assert len(visible) - len(drawn) <= 10  # the two bounds round differently


def test_the_frustum_rule_asks_for_the_centre() -> None:
    K = np.array([[10.0, 0, 5], [0, 10.0, 5], [0, 0, 1]])
    view = View(K=K, width=10, height=10, cam_from_world=np.eye(4))
    anchors = np.array([[0, 0, 1], [0.6, 0, 1], [0, 0, -1], [0, 0, 0.005]], np.float32)
    log_scales = np.full((4, 6), np.log(0.2), np.float32)
    np.testing.assert_array_equal(
        visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE), [0, 1]
    )
    np.testing.assert_array_equal(
        visible_anchors(anchors, log_scales, view, near_plane=NEAR_PLANE, by="frustum"), [0]
    )


def test_projected_centres_are_those_of_the_rasterizer() -> None:
    angle = 0.3
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[2, 3] = 2.0
    view = View(np.array([[30.0, 0, 9], [0, 20.0, 8], [0, 0, 1]]), 20, 16, pose)
    anchors = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3)).astype(np.float32)
    count = len(anchors)
    rotations = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    tensors = (rotations, torch.full((count, 3), 0.1), torch.ones(count), torch.ones(count, 3))
    raster = rasterize(torch.from_numpy(anchors), *tensors, *camera_tensors(view), 20, 16)
    np.testing.assert_allclose(
        projected_centres(anchors, view), raster.info.means2d[0].numpy(), atol=1e-4
    )
