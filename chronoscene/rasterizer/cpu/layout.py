"""Memory layout shared by the CPU kernels: tiles, records, camera numbers, vector width.

Numba reads these numbers when a kernel is compiled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.kernels import memory, transposes, vectors
from chronoscene.rasterizer.constants import ALPHA_MIN, CLAMP_MARGIN
from chronoscene.rasterizer.inputs import Inputs

AnyArray = NDArray[Any]

# An image is cut into tiles of 32 x 32 pixels, a tile into 64 blocks of 4 x 4, so that the blocks
# of a tile which a Gaussian touches are the bits of one 64-bit number. Planes in memory are
# ordered by tile, block, row and column.
TILE = 32
TILE_PIXELS = TILE * TILE
BLOCKS = 8  # Per side of a tile

# A vector holds the pixels of one block, or of half a block where vectors are narrow.
LANES = max(vectors.LANES, 8)
PARTS = 16 // LANES  # Vectors per block
PART_ROWS = LANES // 4
splat, splat_int = vectors.make_splat("f32", LANES), vectors.make_splat("i32", LANES)
load = memory.make_load(LANES)
load_triples = transposes.make_load_columns(3, LANES)
load_quads = transposes.make_load_columns(4, LANES)

# One Gaussian on the screen is a record of 16 numbers: one cache line.
RECORD = 16
MEAN_X, MEAN_Y = 0, 1  # Pixels
# alpha = 2^(LEVEL - u^2 - v^2) with u = U_X dx + U_Y dy; v = V dy, or V dx where V is negative.
U_X, U_Y, V, LEVEL = 2, 3, 4, 5
COLOR = 6  # Three numbers
SHEAR, HALF_WIDTH, RIGHTMOST = 9, 10, 11  # See bins.py
TILES_X, TILES_Y = 12, 13  # int: first tile + (number of tiles << 16), per axis
ROW = 14  # int: first row of sums in the backward pass, counted from that of the chunk
DEPTH = 14  # In the place of the row, once the tiles of the Gaussian are listed: its z-depth
INVERSE_Y = 15  # WHITEN over the standard deviation of y

# One row of sums over the pixels of a tile, for a (Gaussian, tile) pair. With
# g = alpha * d loss / d alpha: sums of g, g u, g v, g u^2, g u v, g v^2, and of the weight times
# the gradient of each channel and of the depth; the sign of V, so that both passes agree on it;
# and, if asked for, of |g (u U_X + v V_X)| and |g (u U_Y + v V_Y)|, where v = V_X dx + V_Y dy.
SUM, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_COLOR = 0, 1, 2, 3, 4, 5, 6
SUM_DEPTH = 9  # 0 without depth
SUM_SIGN = 10
SUM_ABSOLUTE = 11  # Two numbers

# An entry is a (Gaussian, tile) pair in 16 bytes, so that sorting moves one piece of memory: the
# blocks as one 64-bit number, then two of 32 bits, the Gaussian and its row of sums.
ENTRY_BLOCKS, ENTRY_NUMBERS = 2, 4  # An entry in numbers of 64 and of 32 bits
GAUSSIAN, PLACE = 2, 3  # Numbers of 32 bits

LOG2_E = math.log2(math.e)
LEVEL_MIN = math.log2(ALPHA_MIN)  # LEVEL - u^2 - v^2 is at least this where alpha counts
WHITEN = math.sqrt(0.5 * LOG2_E)  # u and v over WHITEN are standard deviations

# Camera numbers in one float32 array.
ROTATION, CENTRE, FX, FY, CX, CY = 0, 9, 12, 13, 14, 15  # Centre in the world
X_MIN, X_MAX, Y_MIN, Y_MAX = 16, 17, 18, 19  # Limits of x / z and y / z for the Jacobian
NEAR, FAR, BLUR = 20, 21, 22
CENTRE_REST = 23  # What float32 cannot hold of the centre
COFACTORS = 26  # Of the rotation: row i is the cross product of the rows i + 1 and i + 2
ANTIALIASED = 35  # 1 if opacities make up for the blur, 0 if not
CAMERA = 36

CHUNK = 1024  # Gaussians that a thread takes at a time


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]  # Axes of a cross product


@dataclass(frozen=True, slots=True)
class View:
    """Camera of one image, in the form that the kernels read."""

    camera: AnyArray
    """`CAMERA` numbers, float32."""
    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        return -(-self.width // TILE)

    @property
    def tiles(self) -> int:
        return self.tiles_x * -(-self.height // TILE)


def make_view(viewmat: AnyArray, K: AnyArray, inputs: Inputs) -> View:
    """Pack one camera of the inputs for the kernels, from its float64 matrices."""
    width, height = inputs.width, inputs.height
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    camera = np.zeros(CAMERA, np.float32)
    rows = np.asarray(viewmat[:3, :3])
    camera[ROTATION : ROTATION + 9] = rows.reshape(-1)
    a, b = rows[_NEXT], rows[_LAST]
    cofactors = a[:, _NEXT] * b[:, _LAST] - a[:, _LAST] * b[:, _NEXT]
    camera[COFACTORS : COFACTORS + 9] = cofactors.reshape(-1)
    centre = _centre(viewmat)
    camera[CENTRE : CENTRE + 3] = centre
    camera[CENTRE_REST : CENTRE_REST + 3] = centre - camera[CENTRE : CENTRE + 3]
    camera[FX], camera[FY], camera[CX], camera[CY] = fx, fy, cx, cy
    camera[X_MIN], camera[X_MAX] = -cx / fx - margin_x, (width - cx) / fx + margin_x
    camera[Y_MIN], camera[Y_MAX] = -cy / fy - margin_y, (height - cy) / fy + margin_y
    camera[NEAR], camera[FAR] = inputs.near_plane, inputs.far_plane
    camera[BLUR], camera[ANTIALIASED] = inputs.eps2d, inputs.antialiased
    return View(camera, width, height)


def _centre(viewmat: AnyArray) -> AnyArray:
    """Camera centre, also valid for a rotation that is slightly off by rounding."""
    try:
        return -np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
    except np.linalg.LinAlgError:  # nan: all is culled
        return np.full(3, np.nan)
