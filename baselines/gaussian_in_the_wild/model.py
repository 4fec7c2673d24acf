"""Gaussians whose colours a network makes of what they read from a photo."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from math import log

import torch
from torch import Tensor

from baselines.gaussian_in_the_wild.networks import Networks, colors_of
from chronoscene.anchors.visibility import visible_anchors
from chronoscene.gaussians.model import GaussianModel, opacities_of, scales_of
from chronoscene.methods import View
from chronoscene.training.drawing import Splats, camera_centre_tensor

COORDINATES = "coordinates"
"""Group of parameters: where Gaussians read in feature maps. [N, 3, 2]"""
EARLIER = "earlier_features"
"""Group of what Gaussians read from photos of periods before this training, if any; not trained.
[N, S, D]"""
_SLACK = log(2)
"""Added to logarithms of scales: the test of anchors is a little tighter than the rasterizer."""
_NEAR = 1e-6
"""Nearest depth of what a view may show: below all near planes."""


@dataclass(eq=False)
class WildModel(GaussianModel):
    """Gaussians in `parameters`, the tensors of the networks in `shared`.

    Intrinsic features are in the groups of the spherical harmonics, which they start as.
    """

    _: KW_ONLY
    networks: Networks
    period_features: Tensor | None = None
    """Features that Gaussians read from photos of each period, to render it; None while unknown.
    [N, T, D]"""

    def splats(self, view: View, period: float) -> Splats:
        """The Gaussians to draw in a view as of a whole period."""
        assert self.period_features is not None
        rows = self.rows_in(view)
        return self.painted(view, rows, self.period_features[rows, int(period)])

    def rows_in(self, view: View) -> Tensor:
        """Gaussians that a view may show, and some more: the others need no colour. int64 [M]"""
        p = self.parameters
        widest = (p["log_scales"].amax(1, keepdim=True) + _SLACK).repeat(1, 3)
        return visible_anchors(p["means"], widest, view, near_plane=_NEAR)

    def painted(self, view: View, rows: Tensor, dynamic: Tensor) -> Splats:
        """The Gaussians to draw in a view; those that it cannot show are black.

        Args:
            view: The camera.
            rows: Those that it may show. [M]
            dynamic: What these read from a photo. [M, D]
        """
        p = self.parameters
        centre = camera_centre_tensor(view, p["means"].device)
        colors = torch.zeros_like(p["means"]).index_copy(
            0, rows, self.colors(centre, rows, dynamic)
        )
        return Splats(
            means=p["means"],
            quats=p["quats"],
            scales=scales_of(p["log_scales"]),
            opacities=opacities_of(p["logit_opacities"]),
            colors=colors,
        )

    def colors(self, camera_centre: Tensor, rows: Tensor, dynamic: Tensor) -> Tensor:
        """Colours of some Gaussians as seen from a camera centre [3]. [M, 3]"""
        names = ("means", "sh_dc", "sh_rest")
        means, dc, rest = (self.parameters[name].index_select(0, rows) for name in names)
        intrinsic = torch.cat([dc, rest.flatten(1)], 1)
        return colors_of(means, intrinsic, dynamic, camera_centre, self.shared, self.networks)
