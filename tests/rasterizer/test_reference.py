"""The reference against closed forms and invariances; all else is compared with it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from chronoscene.rasterizer import constants, rasterize

# Numbers of gsplat's classic mode, written out so that changing a constant fails here.
EPS2D, ALPHA_MIN, ALPHA_MAX = 0.3, 1 / 255, float(np.float32(0.999))
F, Z, SIZE = 50.0, 4.0, 31
K = torch.tensor([[[F, 0.0, SIZE / 2], [0.0, F, SIZE / 2], [0.0, 0.0, 1.0]]]).double()


def render(
    means: list[list[float]],
    scales: list[float],
    opacities: list[float],
    colors: list[list[float]],
    **options: Any,
) -> Any:
    """Isotropic Gaussians before a camera at the origin, float64."""

    def f(x: Any) -> torch.Tensor:
        return torch.tensor(x, dtype=torch.float64)

    n = len(means)
    return rasterize(
        f(means),
        f([[1.0, 0, 0, 0]] * n),
        f([[s] * 3 for s in scales]),
        f(opacities),
        f(colors),
        torch.eye(4).double()[None],
        options.pop("Ks", K),
        options.pop("width", SIZE),
        options.pop("height", SIZE),
        backend="reference",
        **options,
    )


def squared_distance(x: float, y: float) -> np.ndarray:
    """Squared distances of pixel centres from a point. [SIZE, SIZE]"""
    c = np.arange(SIZE) + 0.5
    return (c[None, :] - x) ** 2 + (c[:, None] - y) ** 2


def test_gaussian_on_the_axis_has_the_closed_form() -> None:
    s, opacity = 0.2, 0.7
    result = render([[0, 0, Z]], [s], [opacity], [[1.0, 0.5, 0.25]])
    variance = (F * s / Z) ** 2 + EPS2D
    alpha = opacity * np.exp(-0.5 * squared_distance(SIZE / 2, SIZE / 2) / variance)
    alpha[alpha < ALPHA_MIN] = 0
    assert (alpha == 0).any() and (alpha > 0.5).any()
    np.testing.assert_allclose(result.alphas[0, ..., 0], alpha, atol=1e-12)
    np.testing.assert_allclose(result.image[0, ..., 1], 0.5 * alpha, atol=1e-12)
    radius = np.sqrt(2 * np.log(opacity / ALPHA_MIN) * variance)
    assert result.info.radii[0, 0].tolist() == [np.ceil(radius)] * 2
    assert result.info.means2d[0, 0].tolist() == [SIZE / 2] * 2
    assert result.info.depths[0, 0] == Z


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("reduced", [1, 4, 16])
def test_antialiased_light_does_not_depend_on_the_size_of_the_image(
    reduced: int, backend: str
) -> None:
    """The sum over pixels of a Gaussian's opacity is 2 pi o times the root of the determinant of
    its covariance without the blur, here f^2 s_x s_y / z^2, which falls with the pixels."""
    s_x, s_y, opacity, f, size = 0.3, 0.6, 0.9, F / reduced, 128 // reduced
    light = {}
    for antialiased in (False, True):
        alphas = rasterize(
            torch.tensor([[0.0, 0.0, Z]]),
            torch.tensor([[1.0, 0, 0, 0]]),
            torch.tensor([[s_x, s_y, 0.1]]),
            torch.tensor([opacity]),
            torch.ones(1, 1),
            torch.eye(4)[None],
            torch.tensor([[[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]]]),
            size,
            size,
            antialiased=antialiased,
            backend=backend,
        ).alphas
        light[antialiased] = float(alphas.double().sum())
    variances = (f / Z * np.array([s_x, s_y])) ** 2
    sharp, blurred = np.sqrt(variances.prod()), np.sqrt((variances + EPS2D).prod())
    outside = blurred / 255  # Where alpha is below its threshold.
    assert light[True] == pytest.approx(2 * np.pi * (opacity * sharp - outside), rel=0.02)
    assert light[False] == pytest.approx(2 * np.pi * (opacity * blurred - outside), rel=0.02)


def test_off_axis_gaussian_is_stretched_by_the_jacobian() -> None:
    s, x = 0.1, 0.6
    result = render([[x, 0, Z]], [s], [0.9], [[1.0]])
    u, stretch = SIZE / 2 + F * x / Z, (F / Z) ** 2 * (1 + (x / Z) ** 2)
    dx = np.arange(SIZE) + 0.5 - u
    dy = np.arange(SIZE) + 0.5 - SIZE / 2
    power = dx[None, :] ** 2 / (stretch * s**2 + EPS2D)
    power = power + dy[:, None] ** 2 / ((F / Z * s) ** 2 + EPS2D)
    alpha = 0.9 * np.exp(-0.5 * power)
    alpha[alpha < ALPHA_MIN] = 0
    np.testing.assert_allclose(result.alphas[0, ..., 0], alpha, atol=1e-12)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_radii_end_where_alpha_reaches_its_threshold(backend: str, tools: SimpleNamespace) -> None:
    scene = tools.random_scene(40, 64, 64, seed=2)
    means = scene.means * np.array([0.1, 0.1, 1], np.float32)  # no Jacobian at its margin
    scene = scene.with_(means=means, scales=scene.scales.max(-1, keepdims=True).repeat(3, -1))
    radii = scene.render(backend, torch.float32)[0].info.radii[0].numpy()
    x, y, z = scene.means.astype(np.float64).T
    f, s = scene.Ks[0].diagonal()[:2].astype(np.float64), scene.scales[:, 0]
    tilt = np.stack([x, y], -1) / z[:, None]
    variances = (f * (s / z)[:, None]) ** 2 * (1 + tilt**2) + 0.3
    extents = np.sqrt(2 * np.log(255 * scene.opacities)[:, None] * variances)
    assert (np.abs(radii - np.ceil(extents)) <= (np.abs(extents - extents.round()) < 1e-4)).all()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_what_is_drawn_begins_at_the_default_near_plane(
    backend: str, tools: SimpleNamespace
) -> None:
    scene = tools.random_scene(4, 16, 16)
    means = np.array([[0, 0, 0.0099], [0, 0, 0.0101], [0, 0, 0.99e10], [0, 0, 1.01e10]])
    scales = np.repeat(means[:, 2:] * 0.1, 3, axis=1)
    scene = scene.with_(means=means.astype(np.float32), scales=scales.astype(np.float32))
    radii = scene.render(backend)[0].info.radii[0]
    assert (radii > 0).all(-1).tolist() == [False, True, True, False]


def test_constants_are_those_of_the_readme() -> None:
    assert {name: x for name, x in vars(constants).items() if name.isupper()} == {
        "ALPHA_MIN": 1 / 255,
        "ALPHA_MAX": float(np.float32(0.999)),
        "TRANSMITTANCE_MIN": 1e-4,
        "EPS2D": 0.3,
        "CLAMP_MARGIN": 0.3,
        "NEAR_PLANE": 0.01,
        "FAR_PLANE": 1e10,
        "QUATERNION_MIN": 2**-66,
        "EXTENT_MAX": 1e15,
        "VALUE_MAX": 1e30,
        "DEPTH_MAX": 1e18,
        "SIZE_MAX": 65536,
        "FOCAL_MIN": 1e-3,
        "RADIUS_MAX": 2_000_000_000,
    }


@pytest.mark.parametrize("near_first", [True, False])
def test_two_gaussians_composite_by_depth_not_by_index(near_first: bool) -> None:
    near, far = ([0.0, 0.0, Z - 1], 0.6, [1.0, 0.0, 0.0]), ([0.0, 0.0, Z], 0.8, [0.0, 1.0, 0.0])
    pair = [near, far] if near_first else [far, near]
    result = render(
        [p[0] for p in pair],
        [0.3, 0.3],
        [p[1] for p in pair],
        [p[2] for p in pair],
        backgrounds=torch.tensor([[0.0, 0.0, 1.0]]).double(),
        render_depth=True,
    )
    d2 = squared_distance(SIZE / 2, SIZE / 2)
    a = 0.6 * np.exp(-0.5 * d2 / ((F * 0.3 / (Z - 1)) ** 2 + EPS2D))
    b = 0.8 * np.exp(-0.5 * d2 / ((F * 0.3 / Z) ** 2 + EPS2D))
    a[a < ALPHA_MIN], b[b < ALPHA_MIN] = 0, 0
    expected = np.stack([a, (1 - a) * b, (1 - a) * (1 - b)], axis=-1)
    np.testing.assert_allclose(result.image[0], expected, atol=1e-12)
    weight = a + (1 - a) * b
    depth = np.where(weight > 0, (a * (Z - 1) + (1 - a) * b * Z) / np.maximum(weight, 1e-9), 0)
    np.testing.assert_allclose(result.depths[0, ..., 0], depth, atol=1e-9)


def test_equal_depths_are_drawn_in_the_order_of_the_input() -> None:
    result = render([[0, 0, Z]] * 2, [0.5] * 2, [0.9] * 2, [[1.0, 0.0], [0.0, 1.0]])
    centre = result.image[0, SIZE // 2, SIZE // 2]
    np.testing.assert_allclose(centre, [0.9, 0.09], atol=1e-12)


def test_alpha_is_capped_and_a_pixel_ends_before_its_last_light() -> None:
    result = render([[0, 0, Z + i] for i in range(3)], [9.0] * 3, [1.0] * 3, [[1.0, 0, 0]] * 3)
    centre = result.alphas[0, SIZE // 2, SIZE // 2, 0]
    # 0.999 passes 1e-3; the second would leave 1e-6, below 1e-4, and is not drawn.
    assert centre.item() == pytest.approx(ALPHA_MAX, abs=1e-12)


@pytest.mark.parametrize(
    ("mean", "scale", "opacity"),
    [
        ([0, 0, -Z], 0.1, 0.9),
        ([0, 0, 0.0], 0.1, 0.9),
        ([0, 0, 0.0099], 0.1, 0.9),
        ([0, 0, 2e10], 0.1, 0.9),
        ([9 * Z, 0, Z], 0.1, 0.9),
        ([0, 0, Z], 0.1, 0.0),
        ([0, 0, Z], 0.1, -0.5),
        ([0, 0, Z], 0.1, 0.9 / 255),
        ([float("nan"), 0, Z], 0.1, 0.9),
        ([0, 0, Z], float("inf"), 0.9),
    ],
)
def test_what_cannot_be_seen_is_culled_with_gradient_zero(
    mean: list[float], scale: float, opacity: float
) -> None:
    mean_t = torch.tensor([mean]).double().requires_grad_()
    opacity_t = torch.tensor([opacity]).double().requires_grad_()
    result = rasterize(
        mean_t,
        torch.tensor([[1.0, 0, 0, 0]]).double(),
        torch.full((1, 3), scale).double(),
        opacity_t,
        torch.ones(1, 3).double(),
        torch.eye(4).double()[None],
        K,
        SIZE,
        SIZE,
        backend="reference",
        check_finite=False,
    )
    (result.image.sum() + result.alphas.sum()).backward()
    assert result.info.radii.tolist() == [[[0, 0]]]
    assert result.info.means2d.tolist() == [[[0.0, 0.0]]]
    assert result.image.abs().sum() == 0
    assert mean_t.grad is not None and mean_t.grad.abs().sum() == 0
    assert opacity_t.grad is not None and opacity_t.grad.abs().sum() == 0
    assert result.info.means2d.grad is not None and result.info.means2d.grad.abs().sum() == 0


def test_moving_the_principal_point_moves_the_image() -> None:
    scene: dict[str, Any] = {
        "means": [[0.1, 0.2, Z], [-0.2, 0.1, Z + 1]],
        "scales": [0.2, 0.1],
        "opacities": [0.7, 0.8],
        "colors": [[1.0], [0.5]],
    }
    moved = K.clone()
    moved[0, 0, 2] += 3
    moved[0, 1, 2] -= 2
    here, there = render(**scene), render(**scene, Ks=moved)
    np.testing.assert_allclose(here.image[0, 2:, :-3], there.image[0, :-2, 3:], atol=1e-12)


def test_moving_world_and_camera_together_changes_nothing(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(15, 24, 20)
    inputs: dict[str, Any]
    inputs = {k: v.detach() for k, v in scene.tensors(torch.float64).items()}
    world = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())
    rotation = world.Q * torch.sign(torch.linalg.det(world.Q))
    shift = torch.tensor([1.0, -2.0, 3.0]).double()
    moved = dict(inputs, means=inputs["means"] @ rotation.T + shift)
    moved["quats"] = _compose(rotation, inputs["quats"])
    inverse = torch.eye(4).double()
    inverse[:3, :3], inverse[:3, 3] = rotation.T, -rotation.T @ shift
    rest: dict[str, Any] = {"width": 24, "height": 20, "backend": "reference"}
    rest["Ks"] = torch.tensor(scene.Ks).double()
    viewmat = torch.tensor(scene.viewmats).double()
    here = rasterize(**inputs, viewmats=viewmat, **rest)
    there = rasterize(**moved, viewmats=viewmat @ inverse, **rest)
    assert here.alphas.max() > 0.3
    np.testing.assert_allclose(here.image, there.image, atol=1e-10)


def _compose(rotation: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    """Quaternions of rotation times each rotation of ``quats``."""
    from chronoscene.scene.geometry import quaternion_from_rotation, rotation_from_quaternion

    matrices = rotation.numpy() @ rotation_from_quaternion(quats.numpy())
    return torch.tensor(np.stack([quaternion_from_rotation(m) for m in matrices]))


def test_order_of_the_input_does_not_matter(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(20, 20, 20)
    order = np.random.default_rng(3).permutation(20)
    names = ("means", "quats", "scales", "opacities", "colors")
    shuffled = scene.with_(**{name: getattr(scene, name)[order] for name in names})
    here = scene.render("reference", torch.float64)[0]
    there = shuffled.render("reference", torch.float64)[0]
    np.testing.assert_allclose(here.image.detach(), there.image.detach(), atol=1e-12)
    assert (here.info.radii[:, order] == there.info.radii).all()


@pytest.mark.parametrize("antialiased", [pytest.param(False, marks=pytest.mark.slow), True])
def test_gradcheck(antialiased: bool, tools: SimpleNamespace) -> None:
    """Finite differences of every input, at pixels that no threshold is near to."""
    scene = tools.random_scene(7, 9, 8, seed=4)
    scene = scene.with_(
        opacities=np.array([0.9, 0.8, 0.3, 0.6, 0.99, 0.5, 0.95], np.float32),
        scales=scene.scales * 3,
        backgrounds=np.array([[0.2, 0.4, 0.6]], np.float32),
        render_depth=True,
        options=(("antialiased", antialiased),),
    )
    steady = tools.steady_pixels(scene, 1e-3)
    assert 0.5 < steady.float().mean() <= 1
    viewmats, Ks = torch.tensor(scene.viewmats).double(), torch.tensor(scene.Ks).double()
    inputs = [*scene.tensors(torch.float64).values()]
    inputs.append(torch.tensor(scene.backgrounds).double().requires_grad_())

    def outputs(*args: torch.Tensor) -> tuple[torch.Tensor, ...]:
        function: Any = rasterize
        result = function(
            *args[:5],
            viewmats,
            Ks,
            9,
            8,
            backgrounds=args[5],
            render_depth=True,
            antialiased=antialiased,
            backend="reference",
        )
        assert result.depths is not None
        depths = torch.where(steady & (result.alphas.detach() > 0.1), result.depths, 0)
        return result.image * steady, result.alphas * steady, depths

    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-7, atol=1e-5, rtol=1e-4)


def test_clamped_jacobian_has_the_right_gradient() -> None:
    """A large Gaussian far outside the image: its Jacobian is taken at the margin."""
    mean = torch.tensor([[6.0, -5.0, 2.0]]).double().requires_grad_()

    def alphas(mean: torch.Tensor) -> torch.Tensor:
        result = rasterize(
            mean,
            torch.tensor([[1.0, 0.2, 0.1, 0.3]]).double(),
            torch.tensor([[5.0, 4.0, 3.0]]).double(),
            torch.tensor([0.9]).double(),
            torch.ones(1, 1).double(),
            torch.eye(4).double()[None],
            K,
            5,
            5,
            backend="reference",
        )
        return result.alphas

    assert (alphas(mean) > ALPHA_MIN).all()
    assert torch.autograd.gradcheck(alphas, [mean], eps=1e-6, atol=1e-7)


def test_means2d_gradient_is_that_of_moving_the_image(tools: SimpleNamespace) -> None:
    """Summed over Gaussians, d loss / d means2d is d loss / d principal point."""
    scene = tools.random_scene(12, 16, 16, seed=2)
    # Within the image: farther out the principal point also moves the limit of the Jacobian.
    scene = scene.with_(means=scene.means * np.array([0.3, 0.3, 1], np.float32))
    Ks = torch.tensor(scene.Ks).double().requires_grad_()
    weights = torch.randn(1, 16, 16, 3, generator=torch.Generator().manual_seed(5)).double()
    inputs: dict[str, Any] = scene.tensors(torch.float64)
    viewmats = torch.tensor(scene.viewmats).double()
    result = rasterize(**inputs, viewmats=viewmats, Ks=Ks, width=16, height=16, backend="reference")
    (result.image * weights).sum().backward()
    assert result.info.means2d.grad is not None and Ks.grad is not None
    np.testing.assert_allclose(
        result.info.means2d.grad.sum((0, 1)), Ks.grad[0, :2, 2], rtol=1e-9, atol=1e-9
    )
