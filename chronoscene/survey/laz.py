"""Point clouds as LAZ."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.survey.cloud import PointCloud
from chronoscene.survey.map_frame import MapFrame

STEP = 0.001  # Metres between two coordinates of a file


def write_points(
    path: Path, cloud: PointCloud, frame: MapFrame, dimensions: Mapping[str, NDArray[Any]]
) -> None:
    """Write points with colours as LAS 1.4, compressed.

    Args:
        path: The file.
        cloud: Its points.
        frame: Its reference system.
        dimensions: Further numbers of the points by their names. [N] each
    """
    import laspy
    from pyproj import CRS

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, STEP)
    header.offsets = np.floor(cloud.xyz.min(axis=0, initial=np.inf)) if len(cloud) else np.zeros(3)
    header.add_crs(CRS.from_user_input(frame.crs))
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, values.dtype) for name, values in dimensions.items()]
    )
    points = laspy.LasData(header)
    points.xyz = cloud.xyz
    points.red, points.green, points.blue = cloud.rgb.astype(np.uint16).T * 257
    for name, values in dimensions.items():
        points[name] = values
    data = BytesIO()
    points.write(data, do_compress=True)
    path.write_bytes(data.getbuffer())
