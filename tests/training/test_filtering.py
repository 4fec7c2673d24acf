"""Gaussians that were trained with the antialiasing filter, drawn without it."""

from dataclasses import replace

import numpy as np
import torch

from chronoscene.methods import View
from chronoscene.rasterizer.reference import filter_factors
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.drawing import Splats, draw
from chronoscene.training.filtering import adapt_to_plain

NEAR_PLANE = 0.01


def make_cloud(count=200):
    rng = np.random.default_rng(0)
    return GaussianCloud(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=np.exp(rng.normal(-4.5, 0.5, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.3, 0.9, count).astype(np.float32),
        sh_coeffs=np.zeros((count, 16, 3), np.float32),
    )


def make_view(distance):
    pose = np.eye(4)
    pose[2, 3] = distance
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    return View(K, 64, 48, pose)


def image(cloud, view, antialiased):
    tensors = list(cloud.tensors().values())[:4]
    splats = Splats(*tensors, torch.ones(len(cloud), 3))
    black = torch.zeros(3)
    return draw(splats, view, black, near_plane=NEAR_PLANE, antialiased=antialiased).image[0]


def test_adapted_gaussians_look_without_the_filter_as_before_with_it():
    cloud, views = make_cloud(), [make_view(d) for d in (3.0, 4.0, 5.0)]
    adapted = adapt_to_plain(cloud, views, NEAR_PLANE, torch.device("cpu"))
    for view in views:
        wanted = image(cloud, view, antialiased=True)
        before = (image(cloud, view, antialiased=False) - wanted).square().mean()
        after = (image(adapted, view, antialiased=False) - wanted).square().mean()
        assert after < 0.1 * before


def test_one_view_gives_its_own_factor_and_unseen_gaussians_stay():
    cloud, view = make_cloud(2), make_view(4.0)
    cloud = replace(cloud, means=np.array([[0, 0, 0], [0, 0, -9]], np.float32))
    adapted = adapt_to_plain(cloud, [view], NEAR_PLANE, torch.device("cpu"))
    shape = list(cloud.tensors().values())[:3]
    pose, K = (torch.tensor(m, dtype=torch.float32) for m in (view.cam_from_world, view.K))
    factor = filter_factors(*shape, pose, K, view.width, view.height)[0]
    assert adapted.opacities[0] == np.float32(cloud.opacities[0] * factor)
    assert adapted.opacities[1] == cloud.opacities[1]
