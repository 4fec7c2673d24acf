"""The kernel of visibility for a GPU against the same in plain torch."""

import numpy as np
import pytest
import torch
from gpu_kernels import DEVICE, MARKS, gpu_kernels

from chronoscene.anchors import visibility
from chronoscene.methods import View
from chronoscene.training.drawing import camera_numbers

pytestmark = MARKS


@pytest.mark.parametrize("extent", [0.0, 3.33])
@pytest.mark.parametrize("columns", [3, 6])
def test_the_same_anchors_are_visible(extent: float, columns: int) -> None:
    generator = np.random.default_rng(0)
    anchors = torch.from_numpy(generator.normal(0, 2, (3000, 3)).astype(np.float32))
    log_scales = torch.from_numpy(generator.normal(-3, 1, (3000, columns)).astype(np.float32))
    anchors[7], log_scales[9], log_scales[11] = torch.nan, torch.inf, 100.0
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    pose[2, 3] = 1.0
    view = View(np.array([[300.0, 0, 190], [0, 310, 140], [0, 0, 1]]), 400, 300, pose)
    expected = visibility._marked(anchors, log_scales, view, 0.01, extent)
    found = gpu_kernels("anchors.visibility_gpu").marked(
        anchors.to(DEVICE),
        log_scales.to(DEVICE),
        camera_numbers(view, DEVICE),
        size=(400, 300),
        depths=(0.01, visibility.FAR_PLANE),
        extent=extent,
        blur=visibility.EPS2D,
        slack=visibility._SLACK,
    )
    assert 100 < expected.sum() < 2000
    assert torch.equal(found.cpu(), expected)
