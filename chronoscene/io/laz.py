"""Point clouds as LAZ."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_STEPS = 2_000_000_000  # Coordinates are integers of 32 bits


def write_laz(
    path: Path,
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    crs: str,
    *,
    step: float = 0.001,
    dimensions: Mapping[str, NDArray[Any]] | None = None,
) -> None:
    """Write points with colours as LAS 1.4, compressed; needs laspy.

    Args:
        path: The file.
        xyz: Coordinates. [N, 3]
        rgb: Colours. [N, 3]
        crs: Their reference system, as PROJ reads it.
        step: Distance of two coordinates of the file; ten times that, or more, where points lie so
            far apart that the file could not number them.
        dimensions: Further numbers of the points by their names. [N] each
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    more = dimensions or {}
    reach = float(np.ptp(xyz, axis=0).max()) if len(xyz) else 0.0
    while reach > MAX_STEPS * step:
        step *= 10
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, step)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    header.vlrs.append(WktCoordinateSystemVlr(_wkt(crs)))
    header.global_encoding.wkt = True
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, values.dtype) for name, values in more.items()]
    )
    points = laspy.LasData(header)
    points.xyz = xyz
    points.red, points.green, points.blue = rgb.astype(np.uint16).T * 257
    points.return_number = points.number_of_returns = np.ones(len(xyz), np.uint8)  # never 0
    for name, values in more.items():
        points[name] = values
    data = BytesIO()
    points.write(data, do_compress=True)
    path.write_bytes(data.getbuffer())


def _wkt(crs: str) -> str:
    """Reference system as WKT 1, which LAS 1.4 demands; as WKT 2 where that cannot describe it."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    system = CRS.from_user_input(crs)
    try:
        return str(system.to_wkt("WKT1_GDAL", output_axis_rule=True))
    except CRSError:
        return str(system.to_wkt())
