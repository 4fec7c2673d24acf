"""The CUDA backend: gsplat's public ``rasterization``, not packed, and its spherical harmonics.

gsplat is the optional extra ``cuda``; it is imported when the backend is used. Its numbers differ
from the reference by rounding and by its footprint rule, those of 1.6 also by its cap of alpha; see
README.md.

Source: documentation and source of gsplat 1.5.0 to 1.5.3 and 1.6.0.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from chronoscene.errors import BackendError
from chronoscene.kernels import gpu
from chronoscene.kernels.runtime import gsplat_release
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
    gsplat = _load(inputs.means.device)
    means, viewmats = inputs.means, inputs.viewmats
    if not means.dtype == viewmats.dtype == torch.float32:  # else there are no digits to lose
        means, viewmats = recentred(means, viewmats)
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
    image, alphas, meta = gsplat.rasterization(
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
    depths = None
    if inputs.render_depth:
        image, depths = image[..., :-1], torch.where(alphas > 0, image[..., -1:], 0)
    return Rasterization(image, alphas, depths, _info(meta, drawable))


def spherical_harmonics(degree: int, offsets: Tensor, coeffs: Tensor) -> Tensor:
    """Sums of coefficients times basis values. float32

    Args:
        degree: Highest degree that counts.
        offsets: From the camera to the Gaussians, of any length but 0. [N, 3]
        coeffs: [N, 16, 3]

    Returns:
        sums: Colours less 0.5, not clamped. [N, 3]
    """
    gsplat = _load(offsets.device)
    if gsplat_release() == "1.5":
        sums: Tensor = gsplat.spherical_harmonics(degree, offsets, coeffs)
        return sums
    # From 1.6 on it takes centres and cameras; this camera is at the origin.
    camera = torch.eye(4, device=offsets.device)[None]
    sums = gsplat.spherical_harmonics(degree, offsets, camera, coeffs)[0]
    return sums


@cache
def _load(device: torch.device) -> Any:
    """The package gsplat with its kernels, if it can be used here."""
    gsplat_release()
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
    try:
        gsplat, kernels = import_module("gsplat"), import_module("gsplat.cuda._backend")._C
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        raise _without_kernels(_first_error(str(error))) from error
    if kernels is None:
        raise _without_kernels("no CUDA toolkit")
    return gsplat


def _without_kernels(reason: str) -> BackendError:
    return BackendError(
        "backend 'cuda'",
        expected="gsplat's compiled kernels",
        found=f"gsplat could not build or load them ({reason})",
        todo=f"install the CUDA toolkit: {_TOOLKIT}; python -c 'import gsplat.cuda._backend' shows "
        "the whole output; or choose backend='cpu'",
    )


def _first_error(output: str) -> str:
    """The line to show of what compilers wrote, which can be hundreds."""
    lines = [line.strip() for line in output.splitlines() if line.strip()] or ["no message"]
    return next((line for line in lines if "error:" in line or "fatal" in line), lines[0])


def _without_bad_rows(*arrays: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """Gaussians with nan, without a rotation or too faint to see, made invisible and harmless."""
    if arrays[0].is_cuda and gpu.compiles():
        from chronoscene.rasterizer.clean_gpu import cleaned

        made, good = cleaned(arrays, least_length=QUATERNION_MIN, least_opacity=ALPHA_MIN)
        return tuple(made), good
    means, quats, scales, opacities, colors = arrays
    finite = torch.stack([torch.isfinite(x.reshape(len(x), -1)).all(-1) for x in arrays]).all(0)
    good = finite & (quats.abs().amax(-1) >= QUATERNION_MIN) & (opacities > ALPHA_MIN)
    identity = torch.zeros_like(quats[:1])
    identity[:, 0] = 1.0
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
    # The kernel leaves rows of culled Gaussians as it finds them in memory, and never reads them.
    means2d.data.masked_fill_(~visible[..., None], 0)
    return RasterInfo(means2d, radii, torch.where(visible, meta["depths"].detach(), 0))
