"""Whether a photo shows the points that its pose says it sees: by their colours.

A point of the model has the mean colour of the pixels that see it. In the right photo the
brightness of the pixels goes with that of the points; in another photo, or in one that was turned,
it does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.scene_folder import RawScene

Array = NDArray[np.float64]

FEWEST = 30
"""Observations of an image from which their correlation means something."""

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in brightness (ITU-R BT.601)."""


class Sight(NamedTuple):
    """What one image should show at its m observations."""

    image: int
    """Index into the images."""
    place: Array
    """Position in the image, from 0 to 1 along width and height. [m, 2]"""
    brightness: Array
    """Of the points. [m]"""

    def correlation(self, grey: NDArray[np.uint8]) -> float:
        """Of the brightness of the points with that of the pixels; NaN where one is constant.

        Args:
            grey: The photo, of any size. [H, W]
        """
        size = np.array(grey.shape[::-1])
        x, y = np.clip((self.place * size).astype(np.int64), 0, size - 1).T
        pixels = grey[y, x].astype(np.float64)
        a, b = pixels - pixels.mean(), self.brightness - self.brightness.mean()
        length = float(np.linalg.norm(a) * np.linalg.norm(b))
        return float(a @ b) / length if length > 0 else float("nan")


def sights(scene: RawScene) -> list[Sight]:
    """Of the images with enough observations within them."""
    images, points, seen = scene.images, scene.points, scene.observations
    if images is None or points is None or seen is None:
        return []
    brightness = points.rgb.astype(np.float64) @ np.array(LUMA)
    found = []
    for image, rows in seen.by_image(images):
        camera = scene.usable_cameras.get(int(images.camera_ids[image]))
        if camera is None:
            continue
        place = images.keypoint_xy[seen.keypoint[rows]] / [camera.width, camera.height]
        inside = ((place >= 0) & (place <= 1)).all(axis=1)
        if np.count_nonzero(inside) >= FEWEST:
            found.append(Sight(image, place[inside], brightness[seen.point[rows[inside]]]))
    return found
