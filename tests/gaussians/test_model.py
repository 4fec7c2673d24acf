"""Initial Gaussians and their activations."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_scene import toy_scene

from chronoscene.errors import SceneError
from chronoscene.gaussians.model import SHAPES, initialise, opacities_of, scales_of


def test_start_as_published():
    scene = toy_scene(views=1)
    start = initialise(scene, opacity=0.1)
    assert {name: tuple(rows.shape[1:]) for name, rows in start.items()} == SHAPES
    distances = np.linalg.norm(scene.points[:, None] - scene.points[None], axis=-1)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    expected = np.sqrt((nearest.astype(np.float64) ** 2).mean(1))
    np.testing.assert_allclose(
        scales_of(start["log_scales"]).numpy(), np.repeat(expected[:, None], 3, 1), rtol=1e-5
    )
    np.testing.assert_allclose(opacities_of(start["logit_opacities"]).numpy(), 0.1, rtol=1e-6)
    assert (start["quats"] == torch.tensor([1.0, 0, 0, 0])).all()
    assert not start["sh_rest"].any()


def test_twins_and_lone_points_start_with_a_size():
    scene = toy_scene(views=1)
    for points in (np.zeros((1, 3)), np.zeros((5, 3)), np.array([[0, 0, 0], [3.0, 4, 0]])):
        few = replace(
            scene, points=points.astype(np.float32), colors=np.zeros((len(points), 3), np.uint8)
        )
        scales = scales_of(initialise(few, opacity=0.1)["log_scales"])
        assert torch.isfinite(scales).all() and (scales > 3e-4).all()
    assert scales[0, 0] == pytest.approx(5.0)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((60, 3), np.nan)])
def test_no_points_is_an_error(points):
    scene = toy_scene(views=1)
    empty = replace(scene, points=points.astype(np.float32), colors=scene.colors[: len(points)])
    with pytest.raises(SceneError, match="sparse points"):
        initialise(empty, opacity=0.1)


def test_a_scale_beyond_all_numbers_spoils_no_step():
    """A field that deforms Gaussians can send one there; it is not drawn, its gradient is 0."""
    logarithms = torch.tensor([0.0, 88.0, 200.0, float("inf"), float("nan")], requires_grad=True)
    scales = scales_of(logarithms)
    assert scales[:4].isfinite().all() and scales[4].isnan()
    scales[:4].backward(torch.zeros(4))
    assert (logarithms.grad[:4] == 0).all()


@pytest.mark.parametrize("function", [scales_of, opacities_of])
def test_gradients_of_the_activations(function):
    x = torch.randn(20, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(function, x.requires_grad_())
    extreme = torch.tensor([-200.0, 200.0 if function is opacities_of else 0.0]).requires_grad_()
    (gradient,) = torch.autograd.grad(function(extreme).sum(), extreme)
    assert torch.isfinite(gradient).all()
