"""Numbers that define the image; every backend uses these. See README.md in this folder."""

from __future__ import annotations

ALPHA_MIN = 1.0 / 255.0  # A Gaussian is skipped at a pixel where its alpha is below this

ALPHA_MAX = 0.9990000128746033
"""Alpha is capped here, so that light always passes and 1 - alpha can be divided by. It is 0.999 in
float32: with more digits, what passes, 1 - alpha, would depend on the float type from its fifth
digit on."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished before the Gaussian that would bring its transmittance to this or below."""

QUATERNION_MIN = 2.0**-66
"""A quaternion whose largest component is smaller has no direction, and its gradient, which grows
with one over its length, no bound: the Gaussian is culled."""

VALUE_MAX = 1e30
"""A Gaussian with a colour or an opacity of this size or more is culled: the squares and sums in
the gradient must stay within float32."""

EXTENT_MAX = 1e15  # So is one whose half extent on the screen is this many pixels or more

DEPTH_MAX = 1e18
"""The far plane is at most here and the near plane at least at one over this: what is divided by
depth, and depth itself where it is rendered, must stay within float32 with its square."""

SIZE_MAX = 65536
"""Largest width and height in pixels: at this distance from the corner of the image float32 still
places a centre within 0.004 pixels."""

FOCAL_MIN = 1e-3
"""Smallest focal length in image widths (heights): rays 89.9 degrees off the axis. Beyond, the
Jacobian of a large Gaussian is a difference of numbers that are equal in float32."""

RADIUS_MAX = 2_000_000_000  # Larger radii are reported as this: they are int32

CLAMP_MARGIN = 0.3
"""The Jacobian of the projection is taken at a position at most this many half image widths
(heights) outside the image; farther out the linearisation is meaningless."""

EPS2D = 0.3
"""Variance in pixels squared added to both axes of the projected covariance: the blur of 3DGS."""

NEAR_PLANE = 0.01  # Default of all methods, in units of the means: nearer Gaussians are culled
FAR_PLANE = 1e10  # Default far plane, likewise
