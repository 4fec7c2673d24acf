"""The CUDA backend with gsplat's own torch definitions in the place of its kernels, on a CPU.

What is tested is what the backend passes to gsplat and reads from it: names, order and meaning of
arguments, frames, units, pixel centres, and what `meta` has. That the kernels compute what these
definitions do is tested on a GPU alone (`pytest -m gpu`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest
import torch
from rasterizer_cases.comparison import Comparison
from rasterizer_cases.scenes import ANTIALIASED, SmallScene, random_scene
from torch import Tensor

from chronoscene.rasterizer import gsplat_backend
from chronoscene.training import spherical_harmonics as sh

gsplat = pytest.importorskip("gsplat", reason="needs gsplat; its kernels are not used")
definitions = pytest.importorskip("gsplat.cuda._torch_impl")
wrapper = pytest.importorskip("gsplat.cuda._wrapper")
rendering = pytest.importorskip("gsplat.rendering")

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4
"""Constants of gsplat's kernels: ``RasterizeToPixels3DGSFwd.cu`` of 1.5.3."""


def project(
    means: Tensor, covars: Any, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, opacities: Tensor, **options: Any,
) -> Any:  # fmt: skip
    """Project as the definition does, with the radii and the unwritten rows of the kernel."""
    assert covars is None and not options["packed"]
    known = inspect.signature(definitions._fully_fused_projection).parameters
    covariances, _ = definitions._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, means2d, depths, conics, compensations = definitions._fully_fused_projection(
        means, covariances, viewmats, Ks, width, height,
        **{name: value for name, value in options.items() if name in known},
    )  # fmt: skip
    with torch.no_grad():
        alphas = opacities * (1 if compensations is None else compensations)
        extent = (2 * torch.log(alphas / ALPHA_MIN)).clamp(0, 3.33**2).sqrt()[..., None]
        variances = conics[..., [2, 0]] / (
            conics[..., :1] * conics[..., 2:] - conics[..., 1:2] ** 2
        )
        radius = torch.ceil(extent * variances.sqrt())
        size = torch.tensor([width, height])
        inside = ((means2d + radius > 0) & (means2d - radius < size)).all(-1)
        seen = inside & (alphas >= ALPHA_MIN) & (radii > 0).all(-1)
    rows = seen[..., None]
    means2d, conics = (torch.where(rows, x, torch.nan) for x in (means2d, conics))
    depths = torch.where(seen, depths, torch.nan)
    return torch.where(rows, radius, 0).int(), means2d, depths, conics, compensations


def near_to_far(means2d: Tensor, radii: Tensor, depths: Tensor, *_: Any, **__: Any) -> Any:
    """Indices into the flat table of cameras and Gaussians, in the order of depth."""
    seen = (radii > 0).all(-1).flatten().nonzero()[:, 0]
    order = torch.argsort(depths.detach().flatten()[seen], stable=True)
    return None, torch.zeros(1), seen[order]


def composite(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int,
              height: int, tile_size: int, offsets: Tensor, order: Tensor, *,
              backgrounds: Tensor | None, packed: bool, absgrad: bool) -> Any:  # fmt: skip
    assert not packed
    x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    pixels, images, alphas = torch.stack([x, y], -1), [], []
    count = means2d.shape[1]
    for c in range(len(means2d)):
        left, done = torch.ones(height, width), torch.zeros(height, width, dtype=torch.bool)
        image = torch.zeros(height, width, colors.shape[-1])
        for i in (order[order // count == c] % count).tolist():
            dx, dy = (means2d[c, i] - pixels).unbind(-1)
            a, b, d = conics[c, i]
            power = 0.5 * (a * dx * dx + d * dy * dy) + b * dx * dy
            alpha = (opacities[c, i] * torch.exp(-power)).clamp(max=ALPHA_MAX)
            counts = (alpha >= ALPHA_MIN) & ~done
            done = done | (counts & (left * (1 - alpha) <= TRANSMITTANCE_MIN))
            weight = torch.where(counts & ~done, left * alpha, 0)
            image, left = image + weight[..., None] * colors[c, i], left - weight
        if backgrounds is not None:
            image = image + left[..., None] * backgrounds[c]
        images.append(image)
        alphas.append(1 - left[..., None])
    return torch.stack(images), torch.stack(alphas)


@pytest.fixture(autouse=True)
def kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Definitions instead of kernels; calls must still fit the functions that they replace."""

    def replace(module: Any, name: str, function: Callable[..., Any]) -> None:
        signature = inspect.signature(getattr(wrapper, name))

        def called(*args: Any, **kwargs: Any) -> Any:
            signature.bind(*args, **kwargs)
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, called)

    replace(rendering, "fully_fused_projection", project)
    replace(rendering, "isect_tiles", near_to_far)
    replace(rendering, "isect_offset_encode", lambda ids, n, width, height: torch.zeros(
        n, height, width
    ))  # fmt: skip
    replace(rendering, "rasterize_to_pixels", composite)
    replace(gsplat, "spherical_harmonics", definitions._spherical_harmonics)
    monkeypatch.setattr(gsplat_backend, "_load", lambda device: gsplat)


def two_cameras() -> SmallScene:
    scene = random_scene(12, 20, 15, seed=5)
    viewmats = scene.viewmats.repeat(2, axis=0)
    viewmats[1, 0, 3], viewmats[1, 2, 3] = 0.3, 0.5
    Ks = scene.Ks.repeat(2, axis=0)
    Ks[1, 0, 0] *= 1.3
    backgrounds = torch.tensor([[0.2, 0.4, 0.9], [0.7, 0.1, 0.3]]).numpy()
    return scene.with_(viewmats=viewmats, Ks=Ks, backgrounds=backgrounds)


SCENES = {
    "plain": random_scene(40, 24, 18, seed=1),
    "antialiased": random_scene(40, 24, 18, seed=2, options=ANTIALIASED),
    "depth": random_scene(40, 24, 18, seed=3, render_depth=True),
    "two cameras with backgrounds": two_cameras(),
}


@pytest.mark.parametrize("name", SCENES)
def test_images_and_gradients_are_those_of_the_reference(
    name: str, check_agreement: Callable[..., Comparison]
) -> None:
    check_agreement(SCENES[name], "cuda")


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_are_ours(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    offsets = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    coefficients = torch.randn(50, 16, 3, generator=generator, dtype=torch.float64)
    found = gsplat_backend.spherical_harmonics(degree, offsets, coefficients)
    bases = sh.basis(torch.nn.functional.normalize(offsets, dim=-1), degree)
    wanted = (bases[..., None] * coefficients[:, : (degree + 1) ** 2]).sum(1)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)
