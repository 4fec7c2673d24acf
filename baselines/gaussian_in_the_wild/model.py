"""Gaussians whose colours a network makes of what they read from a photo."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from baselines.gaussian_in_the_wild.networks import Networks, colors_of
from chronoscene.gaussians.model import GaussianModel, opacities_of, scales_of
from chronoscene.methods import View
from chronoscene.training.splatting import Splats, camera_centre_tensor

COORDINATES = "coordinates"
"""Group of parameters: where Gaussians read in feature maps. [N, 3, 2]"""


@dataclass(eq=False)
class WildModel(GaussianModel):
    """Gaussians in `parameters`, the tensors of the networks in `shared`.

    Intrinsic features are in the groups of the spherical harmonics, which they start as.
    """

    _: KW_ONLY
    networks: Networks
    period_features: Tensor | None = None
    """What Gaussians read from photos of each period, to render it; None while unknown.
    [N, T, D]"""

    def splats(self, view: View, period: float) -> Splats:
        """The Gaussians to draw in a view as of a whole period."""
        assert self.period_features is not None
        return self.painted(view, self.period_features[:, int(period)])

    def painted(self, view: View, dynamic: Tensor) -> Splats:
        """The Gaussians to draw in a view with what they read from a photo. [N, D]"""
        p = self.parameters
        return Splats(
            means=p["means"],
            quats=p["quats"],
            scales=scales_of(p["log_scales"]),
            opacities=opacities_of(p["logit_opacities"]),
            colors=self.colors(camera_centre_tensor(view, p["means"].device), dynamic),
        )

    def colors(self, camera_centre: Tensor, dynamic: Tensor) -> Tensor:
        """Colours as seen from a camera centre [3], with what is read from a photo. [N, 3]"""
        p = self.parameters
        intrinsic = torch.cat([p["sh_dc"], p["sh_rest"].flatten(1)], 1)
        return colors_of(p["means"], intrinsic, dynamic, camera_centre, self.shared, self.networks)
