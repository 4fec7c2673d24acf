"""Gaussians that were trained with the antialiasing filter, for renderers without it.

Both kinds of renderers widen a Gaussian on the screen by the same blur. The filter multiplies its
opacity by sqrt(det S / det (S + 0.3 I)), S the covariance on the screen in square pixels, so that
the blur adds no light; without the filter, small Gaussians are too opaque. The factor depends on
the view. Here it becomes part of the opacity, as its mean over views, weighted by what the Gaussian
adds to each.

The result fits the distances and the image sizes of these views. In images with more pixels the
factor would be nearer to 1: what is thin looks too faint there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from chronoscene.methods import View
from chronoscene.rasterizer.reference import filter_factors
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.drawing import Splats, camera_tensors, weights_in
from chronoscene.training.views import coarse_view


def adapt_to_plain(
    gaussians: GaussianCloud, views: Sequence[View], near_plane: float, device: torch.device
) -> GaussianCloud:
    """Multiply opacities by the mean factor of the filter in some views.

    Args:
        gaussians: In the training frame. Those that no view shows stay as they are.
        views: Where the result is to be right.
        near_plane: As for `chronoscene.training.drawing.draw`.
        device: Device of the model.
    """
    tensors = gaussians.tensors(str(device))
    shape = (tensors["means"], tensors["quats"], tensors["scales"])
    splats = Splats(*shape, tensors["opacities"], torch.zeros_like(tensors["means"]))
    weights = torch.zeros_like(splats.opacities)
    weighted = torch.zeros_like(splats.opacities)
    for view in views:
        small = coarse_view(view)
        everywhere = torch.ones(small.height, small.width, 3, device=device)
        added = weights_in(splats, small, everywhere, near_plane=near_plane, antialiased=True)[:, 0]
        seen = added > 0
        viewmats, Ks = camera_tensors(view, device)
        factors = filter_factors(*shape, viewmats[0], Ks[0], view.width, view.height)
        weights += added
        weighted[seen] += added[seen] * factors[seen]
    factor = torch.where(weights > 0, weighted / weights.clamp_min(1e-30), 1.0)
    return replace(gaussians, opacities=(splats.opacities * factor).cpu().numpy())
