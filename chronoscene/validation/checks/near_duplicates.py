"""Photos that are one photo but for brightness, contrast or colours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from chronoscene.validation.checks.pixels import Pixels

ALIKE = 0.997
"""Correlation of the grey thumbnails of two photos beyond which they are one. Measured: a photo
made darker, brighter, warmer or with more contrast 0.9985 and more; neighbouring frames of a video
0.989 and less, aerial photos of one flight 0.9 and less."""

PLAIN = 8.0
"""Standard deviation of a grey thumbnail, in grey levels, below which rounding counts."""

_ROWS = 256


def relit_pairs(
    pixels: Mapping[str, Pixels], role: Mapping[str, object]
) -> Iterator[tuple[str, str, float]]:
    """Pairs of images of different roles whose grey thumbnails correlate, and by how much.

    Of an image and all that come after it, the pair that is most alike.
    """
    grey = {n: p.thumbnail.mean(axis=2) for n, p in pixels.items() if p.thumbnail is not None}
    names = [n for n, thumbnail in grey.items() if thumbnail.std() >= PLAIN]
    if len(names) < 2:
        return
    table = np.stack([np.ravel(grey[n] - grey[n].mean()) for n in names])
    table /= np.linalg.norm(table, axis=1, keepdims=True)
    _, group = np.unique([repr(role[n]) for n in names], return_inverse=True)
    for first in range(0, len(names), _ROWS):
        alike = table[first : first + _ROWS] @ table[first:].T
        alike[group[first : first + _ROWS, None] == group[first:]] = -1.0
        alike = np.triu(alike, 1)
        best = alike.argmax(axis=1)
        for i in np.flatnonzero(alike[np.arange(len(best)), best] >= ALIKE).tolist():
            yield names[first + i], names[first + best[i]], float(alike[i, best[i]])
