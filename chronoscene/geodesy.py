"""Geodetic positions in a local east-north-up frame in metres, by PROJ.

The frame is topocentric (EPSG method 9837) around a position: there is no map projection and so
no distortion. No geoid grid is needed, because heights are used as stated: heights above sea level
instead of the ellipsoid shift the whole frame vertically and do not bend it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from chronoscene.arrays import Array

HeightKind = Literal["as stated", "relative", "none"]


@dataclass(frozen=True, slots=True)
class Georeference:
    """A local frame: x east, y north, z up, in metres, around an origin on WGS 84."""

    latitude: float
    """Degrees, of the origin."""
    longitude: float
    height: float
    """Metres, of the origin, in the sense of ``height_kind``."""
    height_kind: HeightKind
    """``as stated`` (above sea level or the ellipsoid: photos do not state which), ``relative``
    (above take-off, by the barometer) or ``none`` (unknown: all are set to zero)."""

    @property
    def crs(self) -> str:
        """PROJ string of the frame: the last step of a pipeline."""
        return (
            f"+proj=topocentric +ellps=WGS84 +lat_0={self.latitude!r} +lon_0={self.longitude!r} "
            f"+h_0={self.height!r}"
        )

    def to_enu(self, latitude: Array, longitude: Array, height: Array) -> Array:
        """Metres east, north and up of the origin. [N] each -> [N, 3]"""
        places = _pipeline(self.crs).transform(longitude, latitude, height)
        return np.stack([np.asarray(a, np.float64) for a in places], axis=-1)

    def to_geodetic(self, enu: Array) -> Array:
        """Latitude, longitude (degrees) and height (metres): inverse of `to_enu`. [N, 3]"""
        inverse: Any = "INVERSE"
        east, north, up = np.moveaxis(enu, -1, 0)
        lon, lat, height = _pipeline(self.crs).transform(east, north, up, direction=inverse)
        return np.stack([lat, lon, height], axis=-1)


def from_crs(crs: str | None) -> Georeference | None:
    """The frame that `Georeference.crs` describes; None for any other text."""
    number = r"([-+0-9.e]+)"
    pattern = rf"\+proj=topocentric \+ellps=WGS84 \+lat_0={number} \+lon_0={number} \+h_0={number}"
    found = re.fullmatch(pattern, crs or "")
    if found is None:
        return None
    latitude, longitude, height = (float(value) for value in found.groups())
    return Georeference(latitude, longitude, height, height_kind="as stated")


def median_longitude(degrees: Array) -> float:
    """Median of longitudes in degrees, correct across the antimeridian."""
    first = degrees[0]
    turned = (degrees - first + 180) % 360 - 180
    return float((np.median(turned) + first + 180) % 360 - 180)


def _pipeline(crs: str) -> Any:
    """Transformer from longitude, latitude (degrees) and height (metres) to the frame."""
    import pyproj

    return pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart +ellps=WGS84 +step {crs}"
    )
