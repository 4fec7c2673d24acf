"""How far backends may be from the float64 reference, what was measured, and why.

Differences are divided by the largest magnitude of the compared array (of at least `FLOOR`), so
that "relative" means relative to the array, not to each element: sums over pixels cancel, and the
error of a sum follows its largest terms.

Measured with `python tests/rasterizer/measure.py` over 3000 scenes drawn like those of
test_agreement.py; the worst case is the number in brackets.
"""

FLOOR = 1e-3

IMAGE = 2e-4
ALPHA = 2e-4
DEPTH = 2e-4
MEANS2D = 1e-5
GRADIENT = 2e-3
