"""How far backends may be from the float64 reference, what was measured, and why.

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
