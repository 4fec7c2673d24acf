"""Spherical harmonics: against scipy, closed forms and finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from chronoscene.kernels.runtime import set_threads
from chronoscene.kernels.vectors import LANES
from chronoscene.rasterizer import gsplat_backend
from chronoscene.training import spherical_harmonics as sh
from chronoscene.training.harmonics_kernels import BLOCK


def random_inputs(count, *, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=dtype)  # noqa: E731
    return draw(count, 3), 0.3 * draw(count, 15, 3), draw(count, 3), torch.tensor([0.1, 0.4, -2.0])


def real_harmonic(degree, order, directions):
    """Real harmonic with the Condon-Shortley phase, from scipy's complex one."""
    x, y, z = directions.T
    value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
    if order == 0:
        return value.real
    return np.sqrt(2) * (value.imag if order < 0 else value.real)


def test_basis_is_scipys():
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ours = sh.basis(torch.from_numpy(directions), 3).numpy()
    pairs = [(degree, order) for degree in range(4) for order in range(-degree, degree + 1)]
    expected = np.stack([real_harmonic(*pair, directions) for pair in pairs], axis=1)
    np.testing.assert_allclose(ours, expected, atol=1e-14)


@pytest.mark.parametrize("count", [3, LANES, LANES + 1, 1300, 2 * BLOCK + 1])
@pytest.mark.parametrize("degree", range(4))
def test_kernel_equals_the_definition_forward_and_backward(degree, count):
    """Fewer than a vector, one, and a remainder; one task and several, the last one longer."""
    *parameters, centre = random_inputs(count)
    weights = torch.randn(count, 3, generator=torch.Generator().manual_seed(9))
    results = []
    for function, dtype in ((sh.evaluate, torch.float32), (sh.evaluate_reference, torch.float64)):
        leaves = [p.to(dtype).requires_grad_() for p in parameters]
        colors = function(*leaves, centre.to(dtype), degree)
        grads = torch.autograd.grad((colors * weights.to(dtype)).sum(), leaves, allow_unused=True)
        results.append((colors.detach(), grads))
    (ours, ours_grads), (wanted, wanted_grads) = results
    np.testing.assert_allclose(ours.numpy(), wanted.numpy(), atol=2e-6)
    for name, mine, theirs in zip(("dc", "rest", "means"), ours_grads, wanted_grads, strict=True):
        if theirs is None:
            assert degree == 0 and name == "means"
            assert mine is None if count < LANES else not mine.any()
        else:
            np.testing.assert_allclose(mine.numpy(), theirs.numpy(), atol=2e-5, err_msg=name)
    assert (ours > 0).any()
    assert count < 1000 or (ours == 0).any()


@pytest.mark.parametrize("degree", range(4))
def test_gradients_of_the_definition(degree):
    *parameters, centre = random_inputs(12, seed=3, dtype=torch.float64)
    leaves = [p.requires_grad_() for p in parameters]
    assert torch.autograd.gradcheck(
        lambda *p: sh.evaluate_reference(*p, centre.double(), degree), leaves
    )


def test_dc_gives_the_colour_from_everywhere():
    rgb = torch.tensor([[0.0, 0.25, 1.0]])
    for centre in ([0.0, 0, -3], [5.0, 1, 2]):
        colors = sh.evaluate(
            sh.dc_from_rgb(rgb), torch.zeros(1, 15, 3), torch.zeros(1, 3), torch.tensor(centre), 3
        )
        torch.testing.assert_close(colors, rgb, atol=1e-7, rtol=0)


def test_bits_do_not_depend_on_the_threads():
    outcomes = []
    for threads in (1, 2):
        set_threads(threads)
        leaves = [p.requires_grad_() for p in random_inputs(5000)[:3]]
        colors = sh.evaluate(*leaves, random_inputs(1)[3], 3)
        grads = torch.autograd.grad(colors.square().sum(), leaves)
        outcomes.append([t.detach().numpy().tobytes() for t in (colors, *grads)])
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize("count", [3, 3 * LANES])
def test_a_gaussian_on_the_camera_centre_gives_no_nan(count):
    dc, rest, means, centre = random_inputs(count)
    means[1] = centre
    leaves = [p.requires_grad_() for p in (dc, rest, means)]
    colors = sh.evaluate(*leaves, centre, 3)
    grads = torch.autograd.grad(colors.sum(), leaves)
    assert all(torch.isfinite(t).all() for t in (colors, *grads))


def test_what_is_not_finite_shows_and_has_no_gradient_where_none_comes_in():
    dc, rest, means, centre = random_inputs(3 * LANES)
    means[1] = rest[LANES + 2, 14, 2] = torch.nan
    leaves = [p.requires_grad_() for p in (dc, rest, means)]
    colors = sh.evaluate(*leaves, centre, 3)
    assert colors[1].isnan().all() and colors[LANES + 2, 2].isnan()
    weights = torch.ones_like(colors)
    weights[[1, LANES + 2]] = 0
    for grad in torch.autograd.grad(colors, leaves, weights):
        assert grad.isfinite().all() and not grad[[1, LANES + 2]].any()


@pytest.mark.parametrize("release", ["1.5", "1.6"])
def test_gsplat_is_asked_in_the_words_of_its_version(monkeypatch, release):
    """With stand-ins of both signatures; they, too, add no half and cut nothing off."""

    def of_directions(degree, directions, coeffs):
        centre = torch.zeros(3, dtype=directions.dtype)
        return sh.evaluate_reference(coeffs[:, 0], coeffs[:, 1:], directions, centre, degree) - 0.5

    def of_cameras(degree, means, viewmats, coeffs):
        assert torch.equal(viewmats, torch.eye(4)[None])
        return of_directions(degree, means, coeffs)[None]

    functions = {"1.5": of_directions, "1.6": of_cameras}
    gsplat = SimpleNamespace(spherical_harmonics=functions[release])
    monkeypatch.setattr(gsplat_backend, "gsplat_release", lambda: release)
    monkeypatch.setattr(gsplat_backend, "_load", lambda device: gsplat)
    dc, rest, means, centre = random_inputs(40)
    means[7] = centre
    for degree in range(4):
        ours = sh._evaluate_gsplat(dc, rest, means, centre, degree)
        wanted = sh.evaluate_reference(dc, rest, means, centre, degree)
        assert ours.isfinite().all()
        seen = torch.arange(40) != 7
        torch.testing.assert_close(ours[seen], wanted[seen], atol=1e-6, rtol=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("degree", range(4))
def test_gsplats_kernel_equals_the_definition(degree):
    pytest.importorskip("gsplat", reason="needs the extra cuda")
    *parameters, centre = random_inputs(1300)
    weights = torch.randn(1300, 3, generator=torch.Generator().manual_seed(9))
    results = []
    for device, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        leaves = [p.to(device, dtype).requires_grad_() for p in parameters]
        colors = sh.evaluate(*leaves, centre.to(device, dtype), degree)
        (colors * weights.to(device, dtype)).sum().backward()
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in leaves]
        results.append([x.detach().cpu().double() for x in (colors, *grads)])
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, atol=2e-5, rtol=1e-5)
