"""The CPU backend: Numba kernels behind one autograd function per image.

`passes` says what happens in which order. Gradients are summed in an order that does not depend on
the number of threads, so equal inputs give equal bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from chronoscene.errors import BackendError
from chronoscene.rasterizer import RasterInfo, Rasterization
from chronoscene.rasterizer.constants import VALUE_MAX
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.layout import LANES, AnyArray, View, make_view
from chronoscene.rasterizer.cpu.passes import Gaussians, Rendering
from chronoscene.rasterizer.cpu.project import set_colors
from chronoscene.rasterizer.inputs import Inputs, recentred

__all__ = ["DirectRender", "expected_depth", "rasterize"]


def rasterize(inputs: Inputs) -> Rasterization:
    """Render Gaussians. Everything is cast to float32."""
    means, quats, scales, opacities, colors = inputs.gaussians
    viewmats, render_depth = inputs.viewmats, inputs.render_depth
    if means.device.type != "cpu":
        raise BackendError(
            "backend",
            expected="tensors on the CPU",
            found=str(means.device),
            todo="move them with .cpu() or choose backend='auto'",
        )
    if means.dtype == torch.float64:
        means, viewmats = recentred(means, viewmats)
    if colors.shape[1] != 3:  # the kernel sees three channels, if these are all
        colors, opacities = _without_bad_colors(colors, opacities)
    gaussians = _prepare(means, quats, scales, opacities, colors)
    count, padded, cameras = means.shape[0], gaussians[0].shape[0], viewmats.shape[0]
    wants_grad = torch.is_grad_enabled() and any(x.requires_grad for x in gaussians)
    info = RasterInfo(
        torch.empty(cameras, padded, 2),
        torch.empty(cameras, padded, 2, dtype=torch.int32),
        torch.empty(cameras, padded),
    )
    leaf = info.means2d[:, :count].detach().requires_grad_(wants_grad)
    absgrad = torch.zeros(cameras, padded, 2) if inputs.absgrad else None
    if absgrad is not None:
        leaf.absgrad = absgrad[:, :count]  # type: ignore[attr-defined]
    images, alphas, depths = [], [], []
    poses, intrinsics = (x.detach().double().numpy() for x in (viewmats, inputs.Ks))
    for c in range(cameras):
        view = make_view(poses[c], intrinsics[c], inputs)
        background = None if inputs.backgrounds is None else inputs.backgrounds[c].float()
        image, alpha, weighted = Render.apply(
            *gaussians,
            _slot(leaf, c, padded) if wants_grad else None,
            background,
            Request(view, _flat(info, c), render_depth, None if absgrad is None else absgrad[c]),
        )
        images.append(image)
        alphas.append(alpha)
        if render_depth:
            depths.append(expected_depth(weighted, alpha))
    return Rasterization(
        image=_stack(images),
        alphas=_stack(alphas),
        depths=_stack(depths) if render_depth else None,
        info=RasterInfo(means2d=leaf, radii=info.radii[:, :count], depths=info.depths[:, :count]),
    )


def expected_depth(weighted: Tensor, alpha: Tensor) -> Tensor:
    """Divide the weighted depth by the opacity; 0 where that is 0. [H, W, 1]"""
    hit = alpha > 0
    return torch.where(hit, weighted / torch.where(hit, alpha, 1), 0)


def _stack(parts: list[Tensor]) -> Tensor:
    """Stack images, without a copy for the usual single camera."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _slot(leaf: Tensor, c: int, padded: int) -> Tensor:
    """Return the tensor that receives the gradient of one camera's means2d, with ``padded`` rows.

    The usual single camera gets the leaf itself: taking a part of it costs two copies on the way
    back.
    """
    part = leaf if leaf.shape[0] == 1 else leaf[c]
    missing = padded - leaf.shape[1]
    return pad(part, (0, 0, 0, missing)) if missing else part


def _without_bad_colors(colors: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Gaussians whose colours are not finite or too large, made invisible and harmless."""
    usable = (colors.abs() < VALUE_MAX).all(dim=1)
    if bool(usable.all()):
        return colors, opacities
    return torch.where(usable[:, None], colors, 0), torch.where(usable, opacities, 0)


def _prepare(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> tuple[Tensor, ...]:
    """Contiguous float32, at least `LANES` rows: added rows have opacity 0."""
    missing = max(0, LANES - means.shape[0])
    if missing:
        opacities = pad(opacities, (0, missing))
        means, quats, scales, colors = (
            pad(x, (0, 0, 0, missing)) for x in (means, quats, scales, colors)
        )
    return tuple(x.float().contiguous() for x in (means, quats, scales, opacities, colors))


def _flat(info: RasterInfo, c: int) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Flat arrays of one camera for the kernel, which writes integers as float bits."""
    radii = info.radii[c].view(torch.float32)
    return (info.means2d[c].numpy().reshape(-1), radii.numpy().reshape(-1), info.depths[c].numpy())


@dataclass(frozen=True, slots=True)
class Request:
    """Camera, options and output arrays of one image."""

    view: View
    visible: tuple[AnyArray, AnyArray, AnyArray]
    render_depth: bool
    absgrad: Tensor | None
    """Absolute gradients of means2d are added to it in the backward pass. [N, 2]"""


class Render(torch.autograd.Function):
    """(image [H, W, D], opacity [H, W, 1], weighted depth or None) of one camera."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        means2d: Tensor | None,
        background: Tensor | None,
        request: Request,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        inputs = (means, quats, scales, opacities, colors)
        job = _Job(inputs, background, request)
        rendering, image, alphas, weighted = job.forward()
        ctx.set_materialize_grads(False)
        ctx.request = request
        ctx.slot = (-1, 2) if means2d is None else means2d.shape
        ctx.save_for_backward(*inputs, background, alphas)
        ctx.rendering = rendering if any(ctx.needs_input_grad) else None
        return image, alphas, weighted

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *output_grads: Tensor | None) -> tuple[Tensor | None, ...]:
        *inputs, background, alphas = ctx.saved_tensors
        job = _Job(tuple(inputs), background, ctx.request)
        rendering, ctx.rendering = ctx.rendering, None
        if rendering is None:  # a second backward pass through the same graph
            rendering, *_ = job.forward()
        image_grad, alpha_grad, weighted_grad = output_grads
        if image_grad is None:
            image_grad = torch.zeros(*alphas.shape[:2], inputs[-1].shape[1])
        grads = job.backward(rendering, image_grad, alpha_grad, weighted_grad)
        background_grad = None
        if background is not None and ctx.needs_input_grad[6]:
            background_grad = _background_gradient(image_grad, rendering.transmittance())
        *gaussian_grads, means2d_grad = grads
        return (*gaussian_grads, means2d_grad.reshape(ctx.slot), background_grad, None)


def _background_gradient(image_grad: Tensor, light: AnyArray) -> Tensor:
    """Gradient of the background, summed by numpy in an order independent of threads. [D]"""
    passed = image_grad.numpy() * light[..., None]
    return torch.from_numpy(passed.sum(axis=(0, 1), dtype=np.float64).astype(np.float32))


class DirectRender:
    """One image of three channels without autograd: drawn when this is made, and the way back.

    Args:
        inputs: One camera with a background, and at least `layout.LANES` Gaussians, contiguous and
            float32.
    """

    info: RasterInfo
    image: Tensor
    """[H, W, 3]"""
    alpha: Tensor
    """[H, W, 1]"""
    weighted: Tensor | None
    """Depth times opacity, if it is asked for. [H, W, 1]"""

    def __init__(self, inputs: Inputs) -> None:
        assert inputs.backgrounds is not None
        count = len(inputs.means)
        radii = torch.empty(1, count, 2, dtype=torch.int32)
        self.info = RasterInfo(torch.empty(1, count, 2), radii, torch.empty(1, count))
        self._absgrad = torch.zeros(1, count, 2) if inputs.absgrad else None
        view = make_view(inputs.viewmats[0].double().numpy(), inputs.Ks[0].double().numpy(), inputs)
        absgrad = None if self._absgrad is None else self._absgrad[0]
        request = Request(view, _flat(self.info, 0), inputs.render_depth, absgrad)
        self._job = _Job(inputs.gaussians, inputs.backgrounds[0], request)
        self._rendering, self.image, self.alpha, self.weighted = self._job.forward()

    def backward(
        self,
        image_grad: Tensor,
        alpha_grad: Tensor | None = None,
        weighted_grad: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the gradients of the Gaussians; that of the centres is in `info`.

        Arguments are gradients of `image`, `alpha` and `weighted`.
        """
        *grads, centres = self._job.backward(self._rendering, image_grad, alpha_grad, weighted_grad)
        self.info.means2d.grad = centres[None]
        if self._absgrad is not None:
            self.info.means2d.absgrad = self._absgrad  # type: ignore[attr-defined]
        return tuple(grads)


class _Job:
    """One image with any number of channels, three at a time."""

    def __init__(
        self, inputs: tuple[Tensor, ...], background: Tensor | None, request: Request
    ) -> None:
        self.means, self.quats, self.scales, self.opacities, self.colors = inputs
        self.request, self.view = request, request.view
        self.count, self.channels = self.colors.shape
        self.groups = max(1, -(-self.channels // 3))
        self.direct = self.channels == 3
        self.background = np.zeros(3 * self.groups, np.float32)
        if background is not None:
            self.background[: self.channels] = background.detach().numpy()

    def forward(self) -> tuple[Rendering, Tensor, Tensor, Tensor | None]:
        height, width = self.view.height, self.view.width
        rendering = Rendering(self.view)
        rendering.bin_gaussians(self._gaussians(), self.request.visible)
        images = torch.empty(self.groups, height, width, 3)
        alphas = torch.empty(height, width, 1)
        weighted = torch.empty(height, width, 1) if self.request.render_depth else None
        depth = None if weighted is None else weighted.numpy().reshape(-1)
        for group in range(self.groups):
            self._load_colors(rendering, group)
            image = images[group].numpy().reshape(-1)
            rendering.composite(self._background(group), image, alphas.numpy().reshape(-1), depth)
            depth = None  # written once
        if self.direct:
            return rendering, images[0], alphas, weighted
        values = torch.cat(list(images), dim=-1)[..., : self.channels].contiguous()
        return rendering, values, alphas, weighted

    def backward(
        self,
        rendering: Rendering,
        image_grad: Tensor,
        alpha_grad: Tensor | None,
        weighted_grad: Tensor | None,
    ) -> tuple[Tensor, ...]:
        """Gradients of means, quats, scales, opacities, colors and means2d."""
        outputs = tuple(
            torch.empty(self.count, k) if k > 1 else torch.empty(self.count)
            for k in (3, 4, 3, 1, 3, 2)
        )
        grads = tuple(x.numpy().reshape(-1) for x in outputs)
        if self.direct:
            pixels = (image_grad, alpha_grad, weighted_grad)
            summed: Any = self._sum_pixels(rendering, 0, *pixels)
            self._add_absolute(rendering, summed)
        else:
            image_grad = pad(image_grad, (0, 3 * self.groups - self.channels))
            summed, values = self._sum_groups(rendering, image_grad, alpha_grad, weighted_grad)
        rendering.gaussian_gradients(self._gaussians(), summed, grads)
        means, quats, scales, opacities, colors, means2d = outputs
        if not self.direct:
            colors = torch.from_numpy(values[:, : self.channels].copy())
        return means, quats, scales, opacities, colors, means2d

    def _add_absolute(self, rendering: Rendering, summed: tuple[AnyArray, AnyArray]) -> None:
        """Turn sums over pixels of absolute values into gradients in pixels, if asked for."""
        if self.request.absgrad is None:
            return
        sums = np.zeros((self.count, layout.RECORD), np.float32)
        rendering.sum_rows(*summed, sums.reshape(-1))
        found = sums[:, layout.SUM_ABSOLUTE : layout.SUM_ABSOLUTE + 2]
        # By numpy: torch would wake its threads, which keep those of the kernels from processors.
        absgrad = self.request.absgrad.numpy()
        absgrad += found * np.float32(layout.WHITEN**-2)

    def _sum_groups(
        self,
        rendering: Rendering,
        image_grad: Tensor,
        alpha_grad: Tensor | None,
        weighted_grad: Tensor | None,
    ) -> tuple[AnyArray, AnyArray]:
        """16 sums of each Gaussian over all groups, and the gradients of all channels."""
        sums = np.zeros((self.count, 16), np.float32)
        values = np.zeros((self.count, 3 * self.groups), np.float32)
        for group in range(self.groups):
            self._load_colors(rendering, group)
            part = image_grad[..., 3 * group : 3 * group + 3]
            pixels = (part, alpha_grad, weighted_grad)
            rendering.sum_rows(*self._sum_pixels(rendering, group, *pixels), sums.reshape(-1))
            values[:, 3 * group : 3 * group + 3] = sums[:, 6:9]
            sums[:, 6:9] = 0
            alpha_grad = weighted_grad = None  # counted once
        return sums.reshape(-1), values

    def _sum_pixels(
        self,
        rendering: Rendering,
        group: int,
        image_grad: Tensor,
        alpha_grad: Tensor | None,
        weighted_grad: Tensor | None,
    ) -> tuple[AnyArray, AnyArray]:
        alpha = torch.empty(0) if alpha_grad is None else alpha_grad
        given = (image_grad, alpha) if weighted_grad is None else (image_grad, alpha, weighted_grad)
        grads = (x.contiguous().numpy().reshape(-1) for x in given)
        wants_absolute = self.request.absgrad is not None
        return rendering.composite_backward(self._background(group), *grads, absgrad=wants_absolute)

    def _background(self, group: int) -> AnyArray:
        return self.background[3 * group : 3 * group + 3]

    def _gaussians(self) -> Gaussians:
        """Flat arrays; colours that do not go straight into the records are left out."""
        seen = self.colors if self.direct else torch.zeros(self.count, 3)
        tensors = (self.means, self.quats, self.scales, self.opacities, seen)
        means, quats, scales, opacities, colors = (x.detach().numpy().reshape(-1) for x in tensors)
        return means, quats, scales, opacities, colors

    def _load_colors(self, rendering: Rendering, group: int) -> None:
        """Put the channels of a group into the records, unless they are there."""
        if self.direct:
            return
        flat = self.colors.detach().contiguous().numpy().reshape(-1)
        set_colors(flat, self.channels, 3 * group, rendering.records)
