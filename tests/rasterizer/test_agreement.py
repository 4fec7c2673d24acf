"""The CPU backend against the reference: images, facts and all gradients."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from rasterizer_cases.scenes import ANTIALIASED, SmallScene, scenes, well_posed

from chronoscene.errors import ShapeError
from chronoscene.kernels.runtime import GSPLAT_ALPHA_MAX, gsplat_release

Check = Callable[..., Any]


def check_random_scene(scene: SmallScene, check_agreement: Check) -> None:
    assume(well_posed(scene))
    check_agreement(scene)


@settings(max_examples=60)
@given(scene=scenes())
def test_random_scenes(scene: SmallScene, check_agreement: Check) -> None:
    check_random_scene(scene, check_agreement)


@pytest.mark.slow
@settings(max_examples=500, derandomize=False)
@given(scene=scenes())
def test_random_scenes_drawn_afresh(scene: SmallScene, check_agreement: Check) -> None:
    check_random_scene(scene, check_agreement)


@pytest.mark.parametrize(
    ("count", "width", "height", "changes"),
    [
        (300, 70, 50, {}),
        (300, 33, 65, {"render_depth": True}),
        (300, 70, 50, {"options": ANTIALIASED}),
        (15, 32, 32, {"backgrounds": np.array([[0.3, 0.6, 0.9]], np.float32)}),
        (17, 1, 1, {}),
        (1, 40, 3, {}),
        (0, 7, 5, {"backgrounds": np.array([[0.3, 0.6, 0.9]], np.float32), "render_depth": True}),
    ],
)
def test_sizes(
    count: int,
    width: int,
    height: int,
    changes: dict[str, Any],
    tools: SimpleNamespace,
    check_agreement: Check,
) -> None:
    comparison = check_agreement(tools.random_scene(count, width, height, **changes))
    if count > 100:  # the comparison is worth something only if there is something to see
        assert comparison.expected["alphas"].mean() > 0.3
        assert comparison.steady.mean() > 0.9


@pytest.mark.parametrize("channels", [1, 2, 4, 7])
@pytest.mark.parametrize("render_depth", [False, True])
def test_any_number_of_channels(
    channels: int, render_depth: bool, tools: SimpleNamespace, check_agreement: Check
) -> None:
    colors = np.random.default_rng(channels).uniform(-1, 1, (60, channels)).astype(np.float32)
    background = np.linspace(0, 1, channels, dtype=np.float32)[None]
    check_agreement(
        tools.random_scene(
            60, 36, 33, colors=colors, render_depth=render_depth, backgrounds=background
        )
    )


@pytest.mark.parametrize(
    ("count", "width", "height"),
    [(9_000, 70, 50), pytest.param(60_000, 96, 64, marks=pytest.mark.slow)],
)
def test_lists_of_several_parts(
    count: int, width: int, height: int, tools: SimpleNamespace, check_agreement: Check
) -> None:
    """From 4,096 Gaussians on, several workers list them; every one of them must be there."""
    scene = tools.crowd(count, width, height)
    with tools.thresholds(TILE=4):  # the reference is then faster where Gaussians are small
        comparison = check_agreement(scene)
    assert comparison.steady.mean() > 0.99
    assert 0.3 < comparison.expected["alphas"].mean() < 0.95
    got, expected = (x["grad colors"] for x in (comparison.got, comparison.expected))
    present = np.abs(expected).max(-1) > 1e-6 * np.abs(expected).max()
    assert present.mean() > 0.9 and got[present].any(-1).all()
    assert_elements_agree(comparison)


def assert_elements_agree(comparison: Any) -> None:
    """Also each Gaussian by itself: one that is missing hides among the errors of all."""
    for name in ("grad opacities", "grad colors", "grad means2d"):
        got, expected = (
            x[name].reshape(comparison.scene.opacities.size, -1)
            for x in (comparison.got, comparison.expected)
        )
        size = np.linalg.norm(expected, axis=-1)
        error = np.linalg.norm(got - expected, axis=-1)
        assert (error <= 1e-3 * (size + np.median(size))).all(), name


def test_several_cameras(tools: SimpleNamespace, check_agreement: Check) -> None:
    scene = tools.random_scene(80, 34, 30)
    viewmats = np.tile(scene.viewmats, (3, 1, 1))
    viewmats[1, :3, 3], viewmats[2, :3, 3] = [0.5, 0.2, 1.0], [-0.5, 0.3, -1.5]
    check_agreement(scene.with_(viewmats=viewmats, Ks=np.tile(scene.Ks, (3, 1, 1))))


def test_opaque_gaussians_end_pixels(tools: SimpleNamespace, check_agreement: Check) -> None:
    scene = tools.random_scene(400, 40, 40, seed=7)
    scene = scene.with_(opacities=np.linspace(0.9, 1.2, 400, dtype=np.float32))
    scene = scene.with_(scales=scene.scales * 3)
    comparison = check_agreement(scene)
    assert (comparison.expected["alphas"] > 0.9999 - 1e-3).mean() > 0.5


def test_opaque_gaussians_just_outside_the_image(
    tools: SimpleNamespace, check_agreement: Check
) -> None:
    """Pixels outside the image, in a block over its edge, let no light through."""
    count = 100
    scene = tools.random_scene(count, 5, 5)
    check_agreement(
        scene.with_(
            means=np.tile(np.array([[0.83, 0, 2.5]], np.float32), (count, 1)),
            scales=np.full((count, 3), 0.01, np.float32),
            opacities=np.full(count, 0.99, np.float32),
            viewmats=np.eye(4, dtype=np.float32)[None],
            Ks=np.array([[[10, 0, 2.5], [0, 10, 2.5], [0, 0, 1]]], np.float32),
        )
    )


@pytest.mark.parametrize(
    "change",
    [
        {"scales": [1e-8, 1e-8, 1e-8]},
        {"scales": [2.0, 1e-6, 1e-6]},
        {"scales": [2.0, 2.0, 1e-7]},
        {"scales": [30.0, 0.05, 0.05]},
        {"scales": [1e4, 1e4, 1e4]},
        {"quats": [1e-18, 2e-18, 0.0, 1e-18]},
        {"quats": [1e-25, 2e-25, 0.0, 1e-25]},
        {"quats": [1e18, -2e18, 3e17, 0.0]},
        {"quats": [0.0, 0.0, 0.0, 0.0]},
        {"opacities": 1.0},
        {"opacities": 0.0},
        {"opacities": 1.0001 / 255},
    ],
    ids=str,
)
def test_extremes(change: dict[str, Any], tools: SimpleNamespace, check_agreement: Check) -> None:
    """Every third Gaussian is extreme, the others are as usual."""
    scene = tools.random_scene(45, 37, 35, seed=5)
    for name, value in change.items():
        array = getattr(scene, name).copy()
        array[::3] = value
        scene = scene.with_(**{name: array})
    check_agreement(scene)


@pytest.mark.parametrize("z", [-1.0, 0.0, 0.0099, 0.0101, 0.05])
def test_gaussians_at_the_near_plane(
    z: float, tools: SimpleNamespace, check_agreement: Check
) -> None:
    scene = tools.random_scene(30, 30, 30, seed=6)
    means = scene.means.copy()
    means[::2, 2] = z
    means[::2, :2] *= 0.01
    check_agreement(scene.with_(means=means))


def test_far_coordinates(tools: SimpleNamespace, check_agreement: Check) -> None:
    """Distances of 1e5 with a focal length to match: nothing overflows."""
    scene = tools.random_scene(40, 32, 32, seed=8)
    factor = np.float32(1e5)
    check_agreement(scene.with_(means=scene.means * factor, scales=scene.scales * factor))


def test_options(tools: SimpleNamespace, check_agreement: Check) -> None:
    scene = tools.random_scene(60, 32, 32, seed=9)
    options = (("near_plane", 2.5), ("far_plane", 5.0), ("eps2d", 0.05))
    comparison = check_agreement(scene.with_(options=options))
    visible = comparison.expected["radii"].all(-1)
    assert 5 < visible.sum() < 55


def test_every_gradient_that_should_be_there_is(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(200, 48, 48, seed=10)
    comparison = tools.compare(scene)
    visible = comparison.expected["radii"][0].all(-1)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        got, expected = (
            x["grad " + name].reshape(200, -1) for x in (comparison.got, comparison.expected)
        )
        present = np.abs(expected) > 1e-3 * np.abs(expected).max()
        assert present.any() and (got[present] != 0).all(), name
        assert (got[~visible] == 0).all(), name


def test_float64_is_cast_and_gradients_come_back_as_float64(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(40, 24, 24)
    double, inputs = scene.render("cpu", torch.float64)
    single, _ = scene.render("cpu", torch.float32)
    assert double.image.dtype == torch.float32 and torch.equal(double.image, single.image)
    double.image.sum().backward()
    assert all(x.grad is not None and x.grad.dtype == torch.float64 for x in inputs.values())


def test_half_precision_is_cast(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(40, 24, 24)
    half, inputs = scene.render("cpu", torch.bfloat16)
    assert torch.isfinite(half.image).all()
    half.image.float().sum().backward()
    assert all(torch.isfinite(x.grad).all() for x in inputs.values())


def test_many_gaussians_on_one_pixel(tools: SimpleNamespace) -> None:
    """1e5 faint points in one place: the sum has a closed form."""
    n = 100_000
    one = tools.random_scene(1, 5, 5)
    Ks = np.array([[[10, 0, 2.5], [0, 10, 2.5], [0, 0, 1]]], np.float32)
    scene = one.with_(
        means=np.tile(np.array([[0, 0, 3]], np.float32), (n, 1)),
        quats=np.tile(np.array([[1, 0, 0, 0]], np.float32), (n, 1)),
        scales=np.full((n, 3), 0.01, np.float32),
        opacities=np.full(n, 0.005, np.float32),
        colors=np.ones((n, 3), np.float32),
        Ks=Ks,
    )
    result, inputs = scene.render("cpu")
    centre = result.alphas[0, 2, 2, 0].item()
    # (1 - 0.005)^k first falls to 1e-4 at k = 1838, which is not drawn any more.
    assert centre == pytest.approx(1 - 0.995**1837, abs=2e-6)
    result.image.sum().backward()
    gradient = inputs["opacities"].grad
    assert gradient is not None and torch.isfinite(gradient).all()
    assert (gradient[1837:] == 0).all() and (gradient[:1837] != 0).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees(tools: SimpleNamespace, check_agreement: Check) -> None:
    """The reference has the cap of alpha of the gsplat that is installed."""
    pytest.importorskip("gsplat", reason="needs the extra cuda")
    cap = GSPLAT_ALPHA_MAX[gsplat_release()]
    with tools.thresholds(ALPHA_MAX=float(np.float32(cap))):
        for seed in range(3):
            scene = tools.random_scene(200, 48, 40, seed=seed, render_depth=True)
            check_agreement(scene, "cuda", "cuda")
            check_agreement(scene.with_(options=ANTIALIASED), "cuda", "cuda")
        opaque = tools.random_scene(400, 40, 40, seed=7)
        opaque = opaque.with_(opacities=np.linspace(0.9, 1.0, 400, dtype=np.float32))
        check_agreement(opaque, "cuda", "cuda")


def with_absolute_gradients(
    scene: SmallScene, backend: str, weights: torch.Tensor, dtype: torch.dtype, **options: Any
) -> Any:
    """Centres after the backward pass of a weighted sum of the image."""
    result, _ = scene.with_(options=tuple(options.items())).render(backend, dtype)
    (result.image * weights.to(dtype)).sum().backward()
    return result.info.means2d


def test_absolute_gradients_of_the_reference_are_those_of_each_pixel(
    tools: SimpleNamespace,
) -> None:
    scene = tools.random_scene(12, 6, 5)
    weights = torch.randn(5, 6, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.zeros(1, 12, 2, dtype=torch.float64)
    for pixel in torch.eye(30).reshape(30, 5, 6, 1):
        means2d = with_absolute_gradients(scene, "reference", weights * pixel, torch.float64)
        expected += means2d.grad.abs()
    whole = with_absolute_gradients(scene, "reference", weights, torch.float64, absgrad=True)
    assert expected.max() > 0 and (expected > whole.grad.abs() + 1e-9).any()
    torch.testing.assert_close(whole.absgrad, expected)


@pytest.mark.parametrize(("count", "width", "height"), [(300, 70, 50), (15, 33, 3)])
def test_absolute_gradients(
    count: int, width: int, height: int, tools: SimpleNamespace, tolerances: Any
) -> None:
    scene = tools.random_scene(count, width, height)
    weights = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0))
    weights = weights * tools.steady_pixels(scene, 1e-3)[0]
    expected = with_absolute_gradients(
        scene, "reference", weights, torch.float64, absgrad=True
    ).absgrad
    got = with_absolute_gradients(scene, "cpu", weights, torch.float32, absgrad=True)
    error = (got.absgrad.double() - expected).abs().max() / expected.max()
    assert expected.max() > 0 and error < tolerances.GRADIENT
    # To the bit: nothing else changes.
    plain = with_absolute_gradients(scene, "cpu", weights, torch.float32)
    assert torch.equal(plain.grad, got.grad) and not hasattr(plain, "absgrad")


def test_absolute_gradients_are_for_colours_alone(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(3, 6, 5, render_depth=True, options=(("absgrad", True),))
    with pytest.raises(ShapeError, match="absgrad: expected three channels"):
        scene.render("cpu")
