"""Numbers that define the image; every backend uses these. See README.md in this folder."""

from __future__ import annotations

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is skipped at a pixel where its alpha is below this."""

ALPHA_MAX = 0.999
"""Alpha is capped here, so that light always passes and 1 - alpha can be divided by."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished before the Gaussian that would bring its transmittance to this or below."""

QUATERNION_MIN = 2.0**-66
"""A quaternion whose largest component is smaller has no direction, and its gradient, which grows
with one over its length, no bound: the Gaussian is culled."""

CLAMP_MARGIN = 0.3
"""The Jacobian of the projection is taken at a position at most this many half image widths
(heights) outside the image; farther out the linearisation is meaningless."""

EPS2D = 0.3
"""Variance in pixels squared added to both axes of the projected covariance: the blur of 3DGS."""

NEAR_PLANE = 0.01
FAR_PLANE = 1e10
