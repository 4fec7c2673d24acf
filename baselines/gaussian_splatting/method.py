"""3D Gaussian Splatting as a plug-in."""

from __future__ import annotations

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.method import GaussianMethod


class GaussianSplatting(GaussianMethod):
    """One static scene of Gaussians, trained on all views alike.

    The period is no input: every period renders the same image.

    Source: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering".
    Different on purpose: the principal point is kept; the near plane is that of all methods here.
    """

    name = "3dgs"
    config_class = GaussianConfig


class GaussianSplattingPeriod(GaussianSplatting):
    """One scene at all periods, with the exposure of each."""

    name = "3dgs-period"
