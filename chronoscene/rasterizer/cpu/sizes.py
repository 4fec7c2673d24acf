"""Numbers on which the CPU kernels agree. Numba reads them when a kernel is compiled."""

from __future__ import annotations

import math

from chronoscene.rasterizer.constants import ALPHA_MIN

# An image is cut into tiles of 32 x 32 pixels, a tile into 64 blocks of 4 x 4, so that the blocks
# of a tile which a Gaussian touches are the bits of one 64-bit number. Planes in memory are
# ordered by tile, block, row and column.
TILE = 32
TILE_PIXELS = TILE * TILE
BLOCKS = 8  # per side of a tile

# One Gaussian on the screen is a record of 16 numbers: one cache line.
RECORD = 16
MEAN_X, MEAN_Y = 0, 1  # pixels
# alpha = 2^(LEVEL - u^2 - v^2) with u = U_X dx + U_Y dy; v = V dy, or V dx where V is negative.
U_X, U_Y, V, LEVEL = 2, 3, 4, 5
COLOR = 6  # three numbers
SHEAR, HALF_WIDTH, RIGHTMOST = 9, 10, 11  # see bins.py
TILES_X, TILES_Y = 12, 13  # int: first tile + (number of tiles << 16), per axis
ROW = 14  # int: first row of sums in the backward pass, counted from that of the chunk
INVERSE_Y = 15  # WHITEN over the standard deviation of y

# One row of sums over the pixels of a tile, for a (Gaussian, tile) pair. With
# g = alpha * d loss / d alpha: sums of g, g u, g v, g u^2, g u v, g v^2, and of the weight times
# the gradient of each channel; and the sign of V, so that both passes agree on it.
SUM, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_COLOR = 0, 1, 2, 3, 4, 5, 6
SUM_SIGN = 9

LOG2_E = math.log2(math.e)
LEVEL_MIN = math.log2(ALPHA_MIN)  # LEVEL - u^2 - v^2 is at least this where alpha counts
WHITEN = math.sqrt(0.5 * LOG2_E)  # u and v over WHITEN are standard deviations

# Camera numbers in one float32 array.
ROTATION, CENTRE, FX, FY, CX, CY = 0, 9, 12, 13, 14, 15  # centre in the world
X_MIN, X_MAX, Y_MIN, Y_MAX = (
    16,
    17,
    18,
    19,
)  # limits of x / z and y / z for the Jacobian
NEAR, FAR, BLUR = 20, 21, 22
CENTRE_REST = 23  # what float32 cannot hold of the centre
COFACTORS = 26  # of the rotation: row i is the cross product of the rows i + 1 and i + 2
CAMERA = 35

CULLED_KEY = 0xFFFFFFFF
CHUNK = 1024  # Gaussians that a thread takes at a time
