"""Rasters as GeoTIFF, and polygons of GeoJSON as cells."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Mask
from chronoscene.errors import ConfigError
from chronoscene.io.documents import read_json_document
from chronoscene.survey.grid import Grid
from chronoscene.survey.map_frame import MapFrame

NODATA = -9999.0
WHOLE = "whole area"  # Name of the volumes of the whole map
ON_MAP = "a polygon on the map"


class Polygon(NamedTuple):
    """A polygon, as far as it is on the map."""

    cells: Mask
    """Mask of the cells whose centres are inside. [H, W]"""
    on_map: float
    """Share of its area that is on the map."""


def write_raster(
    path: Path, grid: Grid, frame: MapFrame, bands: Mapping[str, NDArray[Any]]
) -> None:
    """Write a GeoTIFF: four bands of bytes as a picture with transparency, others as float32 with
    `NODATA` for NaN.

    Args:
        path: The file.
        grid: Its cells.
        frame: Its reference system.
        bands: By their descriptions, of one type. [H, W] each
    """
    from rasterio.io import MemoryFile

    data = np.stack(list(bands.values()))
    options: dict[str, Any] = {"photometric": "RGB", "alpha": "yes", "predictor": 2}
    if data.dtype != np.uint8:
        data = np.where(np.isfinite(data), data, NODATA).astype(np.float32)
        options = {"nodata": NODATA, "predictor": 3}
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=grid.width, height=grid.height, count=len(data),
            dtype=data.dtype, crs=_wkt(frame), transform=_transform(grid), compress="deflate",
            tiled=True, **options,
        ) as file:  # fmt: skip
            file.write(data)
            file.descriptions = tuple(bands)
        path.write_bytes(memory.getbuffer())  # GDAL itself does not report a full disk


def _wkt(frame: MapFrame) -> str:
    """Reference system for GDAL, which does not know all names that PROJ knows."""
    import pyproj

    return frame.crs if frame.is_local else pyproj.CRS.from_user_input(frame.crs).to_wkt()


def _transform(grid: Grid) -> Any:
    from rasterio import Affine

    return Affine(grid.resolution, 0, grid.left, 0, -grid.resolution, grid.top)


def read_polygons(path: Path, grid: Grid, frame: MapFrame) -> dict[str, Polygon]:
    """Read the polygons of a GeoJSON file by name.

    Coordinates are in the system of its member ``crs`` if it has one; else longitude and latitude
    if they can be, and map coordinates otherwise. Names are the property ``name``, or numbers; one
    that is taken, also by `WHOLE`, gets the number, too.

    Raises:
        ConfigError: If the file is damaged or has other geometries, or one of them has no cell.
    """
    from rasterio.features import geometry_mask

    data = read_json_document(path, error=ConfigError)
    features, raster = data.get("features", [data]), (grid.shape, _transform(grid))
    named: dict[str, Polygon] = {}
    for number, feature in enumerate(features if isinstance(features, list) else (), 1):
        place = f"--area {path}, feature {number}"
        shape = _on_map(place, data.get("crs"), feature, frame)
        cells = geometry_mask([shape], *raster, invert=True)
        if not cells.any():
            if geometry_mask([shape], *raster, invert=True, all_touched=True).any():
                found, todo = "one without the centre of a cell", "choose a finer --resolution"
                raise _wrong(place, ON_MAP, found, todo)
            raise _outside(place)
        properties = feature.get("properties")
        given = properties.get("name") if isinstance(properties, dict) else None
        name = str(number if given is None else given)
        while name in (WHOLE, *named):
            name = f"{name} ({number})"
        named[name] = Polygon(cells, _share_on_map(shape, cells, grid))
    if not named:
        raise _wrong(f"--area {path}", "polygons", "none", "draw at least one")
    return named


def _share_on_map(shape: Any, cells: Mask, grid: Grid) -> float:
    """Share of the area of a geometry in map coordinates that its cells cover; 1 if it is inside
    the map."""
    from rasterio.features import bounds
    from rasterio.transform import array_bounds

    west, south, east, north = array_bounds(*grid.shape, _transform(grid))
    left, bottom, right, top = bounds(shape)
    if west <= left and south <= bottom and right <= east and top <= north:
        return 1.0
    rings = shape["coordinates"] if shape["type"] == "MultiPolygon" else [shape["coordinates"]]
    area = sum(_area(outer) - sum(map(_area, holes)) for outer, *holes in rings)
    return min(1.0, float(cells.sum()) * grid.resolution**2 / max(area, grid.resolution**2))


def _area(ring: Any) -> float:
    """Area inside a ring, closed or not."""
    corners = np.array([corner[:2] for corner in ring], np.float64)
    x, y = (corners - corners[0]).T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def _on_map(place: str, system: Any, feature: Any, frame: MapFrame) -> Any:
    """Geometry of a feature in map coordinates."""
    from rasterio.errors import CRSError
    from rasterio.features import bounds, is_valid_geom
    from rasterio.warp import transform_geom

    shape = feature.get("geometry", feature) if isinstance(feature, dict) else {}
    if not _is_polygon(shape) or not is_valid_geom(shape):
        raise _wrong(place, "a polygon of GeoJSON", "none", "draw areas as polygons")
    for rings in (
        shape["coordinates"] if shape["type"] == "MultiPolygon" else [shape["coordinates"]]
    ):
        if (crossing := _find_crossing(rings)) is not None:
            found = "one that crosses itself near {:.10g}, {:.10g}".format(*crossing)
            raise _wrong(place, "a polygon with an inside", found, "move its corners apart there")
    left, bottom, right, top = bounds(shape)
    angles = max(-left, right) <= 180 and max(-bottom, top) <= 90
    crs = "OGC:CRS84" if angles and not frame.is_local else None
    try:
        if system is not None:
            crs = system["properties"]["name"]
            if frame.is_local:
                raise KeyError
        return shape if crs is None else transform_geom(crs, _wkt(frame), shape)
    except (CRSError, KeyError, TypeError, ValueError) as error:
        wanted, todo = "a known crs", "convert the polygons"
        if frame.is_local:
            wanted, todo = "no crs, as the scene has none", "draw them in the metres of the scene"
        raise _wrong(place, wanted, repr(system)[:80], todo) from error
    except Exception as error:  # of classes that rasterio keeps to itself
        raise _outside(place) from error


def _is_polygon(shape: Any) -> bool:
    """Return True for a polygon whose corners are numbers: GDAL ends the process at others."""
    kind = shape.get("type") if isinstance(shape, dict) else None
    if kind not in ("Polygon", "MultiPolygon"):
        return False
    inner = [shape.get("coordinates")]
    for _ in range(3 if kind == "MultiPolygon" else 2):
        if not all(isinstance(item, list) and item for item in inner):
            return False
        inner = [part for item in inner for part in item]
    return all(
        isinstance(corner, list)
        and len(corner) >= 2
        and all(isinstance(x, int | float) and abs(x) < np.inf for x in corner)
        for corner in inner
    )


def _find_crossing(rings: Any) -> Array | None:
    """Start of an edge that crosses another one; None if edges touch at most. [2]"""
    corners = [np.array([corner[:2] for corner in ring], np.float64) for ring in rings]
    starts = np.concatenate(corners)
    ends = np.concatenate([np.roll(ring, -1, axis=0) for ring in corners])
    order = np.argsort(np.minimum(starts, ends)[:, 0])
    starts, ends = starts[order], ends[order]
    left, right = np.minimum(starts, ends)[:, 0], np.maximum(starts, ends)[:, 0]
    stops = np.searchsorted(left, right, side="right")  # later edges begin farther to the right
    for i, (start, end, stop) in enumerate(zip(starts, ends, stops, strict=True)):
        a, b = starts[i + 1 : stop], ends[i + 1 : stop]
        sides = _side(start, end, a) * _side(start, end, b) < 0
        if (sides & (_side(a, b, start) * _side(a, b, end) < 0)).any():
            return start
    return None


def _side(start: Array, end: Array, point: Array) -> Array:
    """Sign of the side of a line that a point is on; 0 for its ends. [..., 2] -> [...]"""
    along, away = end - start, point - start
    return np.sign(along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0])


def _outside(place: str) -> ConfigError:
    return _wrong(place, ON_MAP, "one outside", "check its coordinates")


def _wrong(place: str, expected: str, found: str, todo: str) -> ConfigError:
    return ConfigError(place, expected=expected, found=found, todo=todo)
