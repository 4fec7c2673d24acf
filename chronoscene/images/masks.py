"""Masks: which pixels of an image count.

The mask of ``images/a/x.jpg`` is ``masks/a/x.jpg.png`` as for COLMAP, where 0 means ignore. Here
are the names of the files, and what happens to masks when images are resized.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MASKS = "masks"  # Folder beside ``images/``

MODES = ("L", "1")
"""Pillow's modes of mask files: one channel of 8 bits, or of one."""

_REACH = 2.0
"""Half width of the bicubic filter in pixels, of the larger of the two images (Pillow)."""


def mask_name(name: str) -> str:
    """Return the path below ``masks/`` of the mask of an image, by its path below ``images/``."""
    return f"{name}.png"


def mask_place(name: str) -> str:
    """Return the path of the mask of an image below the folder of the scene."""
    return f"{MASKS}/{mask_name(name)}"


def find_masks(parent: Path, names: Iterable[str]) -> dict[str, Path]:
    """Find the mask files of images by their names, in the folder of masks below ``parent``."""
    folder = parent / MASKS
    if not folder.is_dir():
        return {}
    return {name: path for name in names if (path := folder / mask_name(name)).is_file()}


def resize_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Resize a mask like its image, by Pillow's bicubic filter. [H, W] -> [H', W']

    A pixel counts if all pixels count that its colour is made of, so nothing of what is ignored
    remains in the pixels that count.

    Args:
        mask: Where the image counts.
        size: New width and height.
    """
    return np.ascontiguousarray(_resize_rows(_resize_rows(mask, size[1]).T, size[0]).T)


def _resize_rows(mask: NDArray[np.bool_], target: int) -> NDArray[np.bool_]:
    count = len(mask)
    if target == count:
        return mask
    scale = count / target
    centre, reach = (np.arange(target) + 0.5) * scale, _REACH * max(scale, 1.0)
    first = np.maximum((centre - reach + 0.5).astype(int), 0)
    stop = np.minimum((centre + reach + 0.5).astype(int), count)
    ignored = np.zeros((count + 1, mask.shape[1]), np.int32)
    np.cumsum(~mask, axis=0, out=ignored[1:])
    return np.asarray(ignored[first] == ignored[stop])
