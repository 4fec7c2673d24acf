"""Cameras as tensors, what is random in a step, and what Gaussians add to a view."""

import numpy as np
import torch

from chronoscene.methods import View
from chronoscene.training.config import SplattingConfig
from chronoscene.training.drawing import (
    Chance,
    Splats,
    camera_centre_tensor,
    camera_tensors,
    draw,
    draw_in_training,
    opacity_factors,
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
    assert step_background(usual, config, Chance(0, 3, 0.5)) is usual
    config = SplattingConfig(random_background=True)
    colors = [
        step_background(usual, config, Chance(seed, draw, 0.5))
        for seed, draw in ((0, 3), (0, 3), (0, 4), (1, 3))
    ]
    assert torch.equal(colors[0], colors[1])
    assert not torch.equal(colors[0], colors[2]) and not torch.equal(colors[0], colors[3])
    many = torch.stack([step_background(usual, config, Chance(0, i, 0.5)) for i in range(300)])
    assert 0 <= many.min() < 0.05 and 0.95 < many.max() < 1


def test_a_growing_share_of_gaussians_is_left_out() -> None:
    opacities, config = torch.full((20_000,), 0.5), SplattingConfig(opacity_dropout=0.4)
    assert opacity_factors(opacities, SplattingConfig(), Chance(0, 3, 0.5)) is None
    assert opacity_factors(opacities, config, Chance(0, 1, 0.0)) is None
    for progress, share in ((0.5, 0.2), (1.0, 0.4), (1.5, 0.4)):
        factors = opacity_factors(opacities, config, Chance(0, 3, progress))
        assert factors is not None and abs((factors == 0).float().mean() - share) < 0.01
        np.testing.assert_allclose(factors[factors > 0], 1 / (1 - share), rtol=1e-6)
        assert abs(factors.mean() - 1) < 0.02
        again = opacity_factors(opacities, config, Chance(0, 3, progress))
        assert again is not None and torch.equal(factors, again)
        for other in (Chance(1, 3, progress), Chance(0, 4, progress)):
            changed = opacity_factors(opacities, config, other)
            assert changed is not None and not torch.equal(factors, changed)


def test_gaussians_left_out_are_not_drawn_and_learn_nothing() -> None:
    view, config = make_view(), SplattingConfig(opacity_dropout=0.5)
    chance = Chance(0, 2, 1.0)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(40, 3, generator=generator) * 0.2
    opacities = torch.full((40,), 0.4, requires_grad=True)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(40, 4)
    splats = Splats(means, quats, torch.full((40, 3), 0.05), opacities, torch.ones(40, 3))
    raster = draw_in_training(splats, view, torch.zeros(3), config, chance)
    raster.image.sum().backward()
    factors = opacity_factors(opacities, config, chance)
    assert factors is not None and opacities.grad is not None
    kept = factors > 0
    alone = Splats(*(value.detach()[kept] for value in splats))
    alone = alone._replace(opacities=alone.opacities * 2)
    wanted = draw_in_training(alone, view, torch.zeros(3), SplattingConfig(), chance)
    assert 5 < int(kept.sum()) < 35 and wanted.image.max() > 0.5
    torch.testing.assert_close(raster.image.detach(), wanted.image)
    assert not opacities.grad[~kept].any() and bool((opacities.grad[kept] != 0).all())


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
