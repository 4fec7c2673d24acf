"""Tolerances of backends against the float64 reference, with what was measured and why.

Differences are divided by the largest magnitude of the compared array (of at least `FLOOR`), so
that they are relative to the array, not to each element: sums over pixels cancel, and the error of
a sum follows its largest terms. Pixels at a threshold are left out; see conftest.py.

The worst cases were measured with `python tests/rasterizer/measure.py 1000` (three runs, other
scenes each time; AVX-512 and AVX2). Each tolerance is three to four times that.
"""

FLOOR = 1e-3

IMAGE = 3e-5
"""Measured 8.0e-6. Rounding of the position of a Gaussian, up to 1e-5 pixels, where it is steep."""

ALPHA = 3e-5
"""Measured 7.9e-6. As above."""

DEPTH = 1e-5
"""Measured 2.1e-6. Only where the accumulated opacity is above 0.1, and relative to depths of 2 to
5: the quotient divides the errors of colour and opacity."""

MEANS2D = 3e-6
"""Measured 7.7e-7. A dozen roundings of 6e-8; the subtraction in the projection of a point far
beside the image loses some."""

GRADIENT = 6e-4
"""Measured 1.9e-4 for backgrounds (sums of signs that cancel), 1e-4 for opacities, 7e-5 for the
others. Rounding of alpha is amplified by 1 / (1 - alpha), up to 1000, on the way back through what
an almost opaque Gaussian hides."""

EXTREME_RATIO = 4
"""At the extremes float32 inputs alone, before anything is computed, have an error that differs
from case to case. It is measured (`rasterizer_cases.comparison.rounding`), and the backend may have
this times as much, plus what its own arithmetic adds, below. Measured 1.1 where this counts."""

EXTREME_IMAGE = 2e-5
"""Images, opacities and depths. Measured 6.4e-7 at the extremes. In mixtures of them, which
hide each other behind almost opaque ones, none of 18,000 was at half of its limit."""

EXTREME_GRADIENT = 6e-5
"""Measured 1.4e-5, at a focal length of 1/1000 of the width."""

EXTREME_BACKGROUND = 2e-4
"""Gradient of the background: almost no light is left, one minus a float32 opacity. Likewise."""

MIXTURE_GRADIENT = 2e-3
"""Gradients in mixtures, where Gaussians of every kind hide each other. Likewise."""

EXTREME_MOST = 0.02
"""No error may be larger than this, whatever rounding does. Measured 9e-3. In mixtures an array can
be nothing but rounding, such as the gradient of a position in the middle of the only pixel: where
that of the inputs alone is more than this, it is the limit."""


def of_extreme(name: str, rounding: float, mixture: bool = False) -> float:
    """Tolerance of an output or a gradient of that name."""
    own = EXTREME_IMAGE
    if name == "grad backgrounds":
        own = EXTREME_BACKGROUND
    elif name.startswith("grad"):
        own = MIXTURE_GRADIENT if mixture else EXTREME_GRADIENT
    most = max(EXTREME_MOST, rounding) if mixture else EXTREME_MOST
    return min(most, own + EXTREME_RATIO * rounding)
