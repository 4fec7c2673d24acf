"""Which anchors a view can see."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.anchors.visibility import projected_centres, visible_anchors
from chronoscene.methods import View
from chronoscene.rasterizer import NEAR_PLANE, rasterize
from chronoscene.training import devices
from chronoscene.training.drawing import camera_tensors


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_anchor_that_the_rasterizer_would_draw_is_decoded(seed: int) -> None:
    generator = np.random.default_rng(seed)
    anchors = torch.from_numpy(generator.normal(0.0, 3.0, (200, 3)).astype(np.float32))
    scales = generator.uniform(0.001, 1.0, (200, 6))
    log_scales = torch.from_numpy(np.log(scales).astype(np.float32))
    K = np.array([[30.0, 0, 17.3], [0, 32.0, 9.1], [0, 0, 1]])
    view = View(K=K, width=40, height=24, cam_from_world=np.eye(4))
    raster = rasterize(
        anchors,
        torch.tensor([[1.0, 0, 0, 0]]).expand(200, 4),
        log_scales[:, :3].exp(),
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
    assert set(drawn) <= set(visible.tolist())
    assert len(visible) - len(drawn) <= 10  # the two bounds round differently


def test_the_frustum_rule_asks_for_the_centre() -> None:
    K = np.array([[10.0, 0, 5], [0, 10.0, 5], [0, 0, 1]])
    view = View(K=K, width=10, height=10, cam_from_world=np.eye(4))
    anchors = torch.tensor([[0, 0, 1], [0.6, 0, 1], [0, 0, -1], [0, 0, 0.005]])
    log_scales = torch.full((4, 6), float(np.log(0.2)))
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
    anchors = torch.rand(9, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    count = len(anchors)
    rotations = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    tensors = (rotations, torch.full((count, 3), 0.1), torch.ones(count), torch.ones(count, 3))
    raster = rasterize(anchors, *tensors, *camera_tensors(view), 20, 16)
    np.testing.assert_allclose(
        projected_centres(anchors, view), raster.info.means2d[0].numpy(), atol=1e-4
    )


@pytest.mark.parametrize("by", ["radius", "frustum"])
def test_plain_torch_sees_what_the_kernel_sees(by: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both compute in float64; of 30,000 anchors none is so near an edge that rounding counts."""
    generator = torch.Generator().manual_seed(1)
    anchors = 3 * torch.randn(30_000, 3, generator=generator)
    log_scales = 6 * torch.rand(30_000, 6, generator=generator) - 6
    anchors[:3] = torch.tensor([[torch.nan, 0, 1], [0, torch.inf, 1], [0, 0, 0]])
    K = np.array([[30.0, 0, 17.3], [0, 32.0, 9.1], [0, 0, 1]])
    view = View(K=K, width=40, height=24, cam_from_world=np.eye(4))
    compiled = visible_anchors(anchors, log_scales, view, by=by, near_plane=NEAR_PLANE)
    monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)
    plain = visible_anchors(anchors, log_scales, view, by=by, near_plane=NEAR_PLANE)
    assert 1_000 < len(compiled) < 29_000
    assert torch.equal(plain, compiled)
