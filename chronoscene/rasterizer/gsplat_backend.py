"""The CUDA backend: gsplat's public ``rasterization``, not packed.

gsplat is the optional extra ``cuda``; it is imported when the backend is used. Its numbers differ
from the reference by rounding and by its footprint rule; see README.md.

Source: gsplat 1.5 documentation of ``rasterization`` and its ``meta`` dictionary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from chronoscene.errors import BackendError
from chronoscene.rasterizer import RasterInfo, Rasterization, reference
from chronoscene.rasterizer.constants import ALPHA_MIN, QUATERNION_MIN
from chronoscene.rasterizer.inputs import Inputs, recentred

_TOOLKIT = (
    "gsplat compiles its kernels when it is first used, and needs for that a C++ compiler and the "
    f"CUDA toolkit of torch's version, {torch.version.cuda or 'none in this build of torch'}, "
    "with nvcc on the PATH"
)


def rasterize(inputs: Inputs) -> Rasterization:
    """Render Gaussians. Everything is cast to float32."""
    render = _load(inputs.means.device)
    means, viewmats = recentred(inputs.means, inputs.viewmats)
    inputs = replace(
        inputs,
        means=means.float(),
        quats=inputs.quats.float(),
        scales=inputs.scales.float(),
        opacities=inputs.opacities.float(),
        colors=inputs.colors.float(),
        viewmats=viewmats.float(),
        Ks=inputs.Ks.float(),
        backgrounds=None if inputs.backgrounds is None else inputs.backgrounds.float(),
    )
    if len(means) == 0:  # gsplat launches no kernel for nothing
        return reference.rasterize(inputs)
    gaussians, drawable = _without_bad_rows(*inputs.gaussians)
    try:
        image, alphas, meta = render(
            *gaussians,
            inputs.viewmats,
            inputs.Ks,
            inputs.width,
            inputs.height,
            near_plane=inputs.near_plane,
            far_plane=inputs.far_plane,
            eps2d=inputs.eps2d,
            backgrounds=inputs.backgrounds,
            packed=False,
            absgrad=inputs.absgrad,
            rasterize_mode="antialiased" if inputs.antialiased else "classic",
            render_mode="RGB+ED" if inputs.render_depth else "RGB",
        )
    except (AttributeError, ImportError) as error:  # kernels are None, or could not be built
        raise BackendError(
            "backend 'cuda'",
            expected="gsplat's compiled kernels",
            found=f"gsplat could not build or load them ({error})",
            todo=f"install the CUDA toolkit: {_TOOLKIT}; or choose backend='cpu'",
        ) from error
    depths = None
    if inputs.render_depth:
        image, depths = image[..., :-1], torch.where(alphas > 0, image[..., -1:], 0)
    return Rasterization(image, alphas, depths, _info(meta, drawable))


def _load(device: torch.device) -> Callable[..., Any]:
    """gsplat's function, if it can be used here."""
    try:
        module = import_module("gsplat")
    except ImportError as error:
        raise BackendError(
            "backend 'cuda'",
            expected="the package gsplat",
            found=f"{type(error).__name__}: {error}",
            todo=f"pip install 'chronoscene[cuda]' ({_TOOLKIT}), or choose backend='cpu'",
        ) from None
    if not torch.cuda.is_available():
        raise BackendError(
            "backend 'cuda'",
            expected="an NVIDIA GPU and a torch built for CUDA",
            found=f"torch {torch.__version__} without one",
            todo="choose backend='cpu', or install torch and 'chronoscene[cuda]' for your GPU",
        )
    if device.type != "cuda":
        raise BackendError(
            "backend 'cuda'",
            expected="tensors on a GPU",
            found=str(device),
            todo="move them with .cuda(), or choose backend='auto'",
        )
    function: Callable[..., Any] = module.rasterization
    return function


def _without_bad_rows(*arrays: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """Gaussians with nan, without a rotation or too faint to see, made invisible and harmless."""
    means, quats, scales, opacities, colors = arrays
    finite = torch.stack([torch.isfinite(x.reshape(len(x), -1)).all(-1) for x in arrays]).all(0)
    good = finite & (quats.abs().amax(-1) >= QUATERNION_MIN) & (opacities > ALPHA_MIN)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    rows = good[:, None]
    return (
        torch.where(rows, means, 0),
        torch.where(rows, quats, identity),
        torch.where(rows, scales, 1),
        torch.where(good, opacities, 0),
        torch.where(rows, colors, 0),
    ), good


def _info(meta: dict[str, Any], drawable: Tensor) -> RasterInfo:
    """gsplat's facts, zero where culled; the gradient of its means2d is kept."""
    radii = torch.where(drawable[:, None], meta["radii"], 0).int()
    means2d = meta["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    visible = (radii > 0).all(-1)
    return RasterInfo(means2d, radii, torch.where(visible, meta["depths"].detach(), 0))
