"""Cameras as tensors, backgrounds, and what Gaussians add to a view."""

import numpy as np
import torch

from chronoscene.methods import View
from chronoscene.training.config import SplattingConfig
from chronoscene.training.drawing import (
    Splats,
    camera_centre_tensor,
    camera_tensors,
    draw,
    step_background,
    weights_in,
)


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


def test_a_random_background_follows_from_the_seed_and_the_step() -> None:
    usual = torch.tensor([1.0, 0.0, 0.5])
    config = SplattingConfig()
    assert step_background(usual, config, seed=0, number=3) is usual
    config = SplattingConfig(random_background=True)
    colors = [
        step_background(usual, config, seed=seed, number=number)
        for seed, number in ((0, 3), (0, 3), (0, 4), (1, 3))
    ]
    assert torch.equal(colors[0], colors[1])
    assert not torch.equal(colors[0], colors[2]) and not torch.equal(colors[0], colors[3])
    many = torch.stack(
        [step_background(usual, config, seed=0, number=number) for number in range(300)]
    )
    assert 0 <= many.min() < 0.05 and 0.95 < many.max() < 1


def test_weights_in_a_region_are_what_is_drawn_there():
    """The image of white Gaussians is the sum of their weights."""
    view = make_view()
    means = torch.tensor([[0.0, 0.1, 0.5], [0.1, 0.0, 0.6], [0.0, 0.0, -5.0]])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    splats = Splats(means, quats, torch.full((3, 3), 0.05), torch.full((3,), 0.8), torch.ones(3, 3))
    pixels = torch.zeros(240, 320, 3)
    pixels[..., 0] = 1.0
    pixels[:, :170, 1] = 1.0
    weights = weights_in(splats, view, pixels, near_plane=0.01)
    image = draw(splats, view, torch.zeros(3), near_plane=0.01).image[0]
    assert weights.shape == (3, 3) and not weights[2].any() and not weights[:, 2].any()
    np.testing.assert_allclose(weights[:, 0].sum(), image[..., 0].sum(), rtol=1e-4)
    np.testing.assert_allclose(weights[:, 1].sum(), image[:, :170, 0].sum(), rtol=1e-4)
    assert 0 < weights[0, 1] < weights[0, 0]
