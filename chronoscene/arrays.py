"""Types of arrays. Shapes stand in the comments beside their use."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
"""An image in 8 bits, RGB or grey."""
