"""Camera positions by the photos' GPS against those of the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.geodesy import Georeference, median_longitude
from chronoscene.scene.similarity import SIGMA, Similarity, fit_robustly
from chronoscene.validation.scene_folder import RawScene

FEWEST = 6
"""Photos with a position from which a similarity is worth something."""

LEAST_SPREAD = 10.0
"""Metres; positions within less are the noise of the receiver."""


class GpsFit(NamedTuple):
    """The model laid over the positions of N photos."""

    images: NDArray[np.int64]
    """Indices into the images. [N]"""
    metres_from_world: Similarity
    distance: NDArray[np.float64]
    """Horizontal metres between model and photo. [N]"""
    sigma: float
    """Robust standard deviation of `distance`."""
    spread: float
    """Median horizontal distance of the positions from their middle, in metres."""


def fit_gps(scene: RawScene) -> GpsFit | None:
    """Fit the camera centres to the positions in the photos; None where there is too little."""
    images = scene.images
    if images is None:
        return None
    rows, places = [], []
    for i, name in enumerate(images.names):
        exif = scene.headers[name].exif if name in scene.headers else None
        if exif is not None and exif.has_position and not np.isnan(scene.centres[i]).any():
            rows.append(i)
            places.append((exif.latitude, exif.longitude, exif.altitude or 0.0))
    if len(rows) < FEWEST:
        return None
    latitude, longitude, altitude = np.array(places, np.float64).T
    middle = (float(np.median(latitude)), median_longitude(longitude), float(np.median(altitude)))
    target = Georeference(*middle, "as stated").to_enu(latitude, longitude, altitude)
    spread = float(np.median(np.linalg.norm(target[:, :2], axis=1)))
    found = fit_robustly(scene.centres[rows], target, axes=2) if spread >= LEAST_SPREAD else None
    if found is None:
        return None
    sigma = SIGMA * float(np.median(found[1]))
    return GpsFit(np.array(rows, np.int64), found[0], found[1], sigma, spread)
