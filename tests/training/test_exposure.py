"""Exposure compensation: gradients, whose transform is whose, and what is left of it in a model."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from baselines.gaussian_splatting.method import GaussianSplatting
from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.scene.similarity import Sim3
from chronoscene.training.config import SplattingConfig
from chronoscene.training.exposure import LEARNING_RATE, Exposure, exposed, of_period, transformed
from chronoscene.training.spherical_harmonics import basis

SIZE = 32


@dataclass
class Views:
    """As much of a training set as `Exposure` looks at."""

    views: list
    num_periods: int


def views_of(periods, num_periods):
    cameras = (np.eye(3), SIZE, SIZE, np.eye(4))
    views = [TrainingView(*cameras, f"{i}.png", p) for i, p in enumerate(periods)]
    return Views(views, num_periods)


def learn(exposure, image, number, gain, steps=200):
    for i in range(steps):
        error = exposure.apply(image, number) - gain * image
        error.square().mean().backward()
        exposure.step(i / steps)


def test_gradients_are_those_of_the_definition():
    generator = torch.Generator().manual_seed(0)
    image, grad = (torch.randn(37, 23, 3, generator=generator) for _ in range(2))
    transform = torch.randn(3, 4, generator=generator)
    plain = [x.double().requires_grad_() for x in (image, transform)]
    expected = plain[0] @ plain[1][:, :3].T + plain[1][:, 3]
    expected.backward(grad.double())
    ours = [x.clone().requires_grad_() for x in (image, transform)]
    found = transformed(*ours)
    found.backward(grad)
    np.testing.assert_allclose(found.detach(), expected.detach(), rtol=1e-5, atol=1e-5)
    for mine, theirs in zip(ours, plain, strict=True):
        np.testing.assert_allclose(mine.grad, theirs.grad, rtol=1e-5, atol=1e-4)


def test_spherical_harmonics_with_an_exposure_give_its_colours():
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator))
    sh_coeffs = 0.2 * torch.randn(50, 16, 3, generator=generator)
    transform = torch.randn(3, 4, generator=generator)

    def colors(coeffs):
        return (basis(directions, 3)[..., None] * coeffs).sum(1) + 0.5

    found = colors(torch.from_numpy(exposed(sh_coeffs.numpy(), transform.numpy())))
    expected = transformed(colors(sh_coeffs)[None], transform)[0]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_bits_do_not_depend_on_the_threads():
    generator = torch.Generator().manual_seed(0)
    image, grad = (torch.randn(300, 400, 3, generator=generator) for _ in range(2))
    found = []
    for threads in (1, set_threads()):
        set_threads(threads)
        leaves = [image.clone().requires_grad_(), torch.eye(3, 4).requires_grad_()]
        out = transformed(*leaves)
        out.backward(grad)
        found.append([out.detach(), *(leaf.grad for leaf in leaves)])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_images_start_as_they_are_and_without_the_option_stay_so():
    image = torch.rand(4, 5, 3)
    for kind in ("image", "period"):
        exposure = Exposure(kind, views_of([0, 1, 1], 2), "cpu")
        assert torch.equal(exposure.apply(image, 2), image)
    none = Exposure("none", views_of([0, 1, 1], 2), "cpu")
    assert none.apply(image, 2) is image and none.by_period() is None


def test_the_first_step_is_as_long_as_the_learning_rate():
    exposure = Exposure("image", views_of([0], 1), "cpu")
    learn(exposure, torch.rand(8, 8, 3), 0, 2.0, steps=1)
    moved = exposure.by_period()[0] - torch.eye(3, 4)
    np.testing.assert_allclose(moved, LEARNING_RATE[0], rtol=1e-3)


def test_each_image_learns_its_own_and_its_period_has_the_mean():
    image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    exposure = Exposure("image", views_of([0, 2, 2], 4), "cpu")
    learn(exposure, image, 1, 1.3)
    one = exposure.apply(image, 1).detach()
    assert (one - 1.3 * image).abs().mean() < 0.01
    assert torch.equal(exposure.apply(image, 2), image), "no step was on this image"
    periods = exposure.by_period()
    identity = torch.eye(3, 4)
    assert torch.equal(periods[0], identity) and torch.equal(periods[1], identity)
    mean = transformed(image, periods[2])
    np.testing.assert_allclose(mean, (one + image) / 2, atol=1e-6)


def test_images_of_a_period_learn_together():
    image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    exposure = Exposure("period", views_of([0, 2, 2], 4), "cpu")
    learn(exposure, image, 1, 1.3)
    assert (exposure.apply(image, 2) - 1.3 * image).abs().mean() < 0.01
    assert torch.equal(exposure.apply(image, 0), image)
    assert torch.equal(transformed(image, exposure.by_period()[2]), exposure.apply(image, 1))


@pytest.mark.parametrize("kind", ["image", "period"])
def test_other_transforms_to_begin_with(kind):
    """Those of periods without images stay, the others learn."""
    image, starts = torch.rand(8, 8, 3), torch.eye(3, 4) * torch.tensor([2.0, 3.0])[:, None, None]
    exposure = Exposure(kind, views_of([1, 1], 2), "cpu")
    exposure.begin(starts)
    assert torch.equal(exposure.by_period(), starts)
    learn(exposure, image, 0, 1.0, steps=2)
    found = exposure.by_period()
    assert torch.equal(found[0], starts[0]) and not torch.equal(found[1], starts[1])


def test_between_periods_transforms_are_mixed():
    transforms = torch.stack([torch.eye(3, 4), 3 * torch.eye(3, 4)])
    torch.testing.assert_close(of_period(transforms, 0.25), 1.5 * torch.eye(3, 4))
    assert torch.equal(of_period(transforms[1:], 7.0), transforms[1])


def test_a_wrong_kind_is_refused():
    with pytest.raises(ConfigError, match="'none', 'image' or 'period'"):
        SplattingConfig(exposure="view")


def wall_of(gains):
    """Photos of a coloured wall from one place, each as bright as its period has it."""
    generator = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    wall = np.stack([0.4 + 0.2 * x, 0.4 + 0.2 * y, 0.4 - 0.2 * x * y], axis=-1)
    pose = np.eye(4)
    pose[2, 3] = 1.0
    K = np.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]])
    views = [TrainingView(K, SIZE, SIZE, pose, f"{i}.png", p) for i, p in enumerate([0, 1] * 2)]
    photos = [np.rint(255 * gains[view.period] * wall).astype(np.uint8) for view in views]
    points = generator.uniform(-0.5, 0.5, (300, 3)) * [1, 1, 0.01]
    return TrainingSet(
        views=tuple(views), num_periods=2, points=points.astype(np.float32),
        colors=np.full((300, 3), 100, np.uint8), point_periods=np.ones((300, 2), bool),
        training_from_world=Sim3.identity(), camera_extent=1.1, scene_extent=1.1,
        background=np.zeros(3, np.float32), load_image=photos.__getitem__,
    )  # fmt: skip


def test_static_gaussians_show_periods_as_bright_as_their_photos(tmp_path):
    """Here the period decides on nothing but the exposure."""
    scene = wall_of((1.0, 0.6))
    config = GaussianConfig(
        iterations=150, stretch=True, densify_from=30_000, reset_interval=30_000
    )
    errors = {}
    for kind in ("none", "image", "period"):
        method = GaussianSplatting(replace(config, exposure=kind))
        method.setup(scene, seed=0, device="cpu")
        for i in range(config.iterations):
            method.step(i, i / config.iterations)
        shown = [method.render(scene.views[p], p).rgb for p in (0, 1)]
        errors[kind] = np.mean([np.abs(shown[p] - scene.load_image(p) / 255) for p in (0, 1)])
    assert errors["image"] < 0.5 * errors["none"] and errors["period"] < 0.5 * errors["none"]
    method.save(tmp_path)
    loaded = GaussianSplatting(config)
    loaded.load(tmp_path, device="cpu")
    for period in (0, 0.5, 1):
        ours, theirs = (m.render(scene.views[0], period).rgb for m in (method, loaded))
        assert np.array_equal(ours, theirs)
