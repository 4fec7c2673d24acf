"""Cameras as tensors."""

import numpy as np
import torch

from chronoscene.methods import View
from chronoscene.training.splatting import camera_centre_tensor, camera_tensors


def make_view():
    angle = 0.3
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [0.1, -0.2, 0.7]
    K = np.array([[262.0, 0, 140.8], [0, 261.0, 110.4], [0, 0, 1]])
    return View(K=K, width=320, height=240, cam_from_world=pose)


def test_batch_of_one_in_float32():
    view = make_view()
    viewmats, Ks = camera_tensors(view)
    assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
    assert viewmats.dtype == Ks.dtype == torch.float32
    np.testing.assert_allclose(viewmats[0].numpy(), view.cam_from_world, atol=1e-7)
    np.testing.assert_allclose(Ks[0].numpy(), view.K, rtol=1e-7)


def test_the_tensors_do_not_share_memory_with_the_view():
    view = make_view()
    viewmats, _ = camera_tensors(view)
    viewmats += 1
    assert view.cam_from_world[0, 2] == 0


def test_the_camera_sees_its_centre_at_the_origin():
    view = make_view()
    centre = camera_centre_tensor(view).double().numpy()
    seen = view.cam_from_world @ np.append(centre, 1.0)
    np.testing.assert_allclose(seen[:3], 0, atol=1e-7)
