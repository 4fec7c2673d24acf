"""Files, read back with rasterio and laspy."""

import json

import laspy
import numpy as np
import pyproj
import pytest
import rasterio

from chronoscene.errors import ConfigError
from chronoscene.io.laz import write_laz
from chronoscene.survey.grid import Grid
from chronoscene.survey.map_frame import LOCAL, MapFrame
from chronoscene.survey.rasters import NODATA, read_polygons, write_raster

UTM = MapFrame("EPSG:32632", np.eye(3), np.zeros(3), 0.0)
NAMED = MapFrame("WGS 84 / UTM zone 32N", np.eye(3), np.zeros(3), 0.0)  # PROJ knows it, GDAL not
HERE = MapFrame(LOCAL, np.eye(3), np.zeros(3), 0.0)
GRID = Grid(680_000.0, 5_152_000.0, 0.5, 40, 30, 0.0, 10.0)


@pytest.mark.parametrize("frame", [UTM, NAMED, HERE])
def test_a_raster_of_heights(tmp_path, frame):
    heights = np.arange(1200.0).reshape(30, 40)
    heights[3, 5] = np.nan
    bands = {"height": heights, "views": np.full((30, 40), 7)}
    write_raster(tmp_path / "a.tif", GRID, frame, bands)
    with rasterio.open(tmp_path / "a.tif") as file:
        read = file.read(1, masked=True)
        assert file.nodata == NODATA and read.mask.sum() == 1 and read.mask[3, 5]
        assert file.descriptions == ("height", "views") and (file.read(2) == 7).all()
        assert file.index(680_000.75, 5_151_999.25) == (1, 1) and file.res == (0.5, 0.5)
        assert next(file.sample([(680_003.1, 5_151_998.4)]))[0] == heights[3, 6]
        if frame is not HERE:
            assert file.crs.to_epsg() == 32632
        else:
            assert "local metres" in file.crs.to_wkt() and not file.crs.is_projected


def test_a_picture_is_transparent_where_nothing_is_known(tmp_path):
    bands = {name: np.full((30, 40), i, np.uint8) for i, name in enumerate("rgb")}
    bands["alpha"] = np.eye(30, 40, dtype=np.uint8) * 255
    write_raster(tmp_path / "a.tif", GRID, UTM, bands)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert [c.name for c in file.colorinterp] == ["red", "green", "blue", "alpha"]
        np.testing.assert_array_equal(file.dataset_mask(), bands["alpha"])


@pytest.mark.parametrize("frame", [UTM, HERE])
def test_a_cloud(tmp_path, frame):
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-50, 50, (500, 3)) + np.array([680_000, 5_152_000, 300])
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    numbers = {"period": np.full(500, 2, np.uint16), "sigma": rng.random(500, np.float32)}
    write_laz(tmp_path / "a.laz", xyz, rgb, frame.crs, dimensions=numbers)
    read = laspy.read(tmp_path / "a.laz")
    assert read.header.are_points_compressed and read.header.point_format.id == 7
    np.testing.assert_allclose(read.xyz, xyz, atol=0.00051)
    np.testing.assert_array_equal(np.stack([read.red, read.green, read.blue], axis=1) // 256, rgb)
    np.testing.assert_array_equal(read["period"], 2)
    np.testing.assert_array_equal(read["sigma"], numbers["sigma"])
    assert read["period"].dtype == np.uint16 and read["sigma"].dtype == np.float32
    assert (read.return_number == 1).all() and (read.number_of_returns == 1).all()
    (wkt,) = read.header.vlrs.get("WktCoordinateSystemVlr")
    assert read.header.global_encoding.wkt
    assert wkt.string.startswith("PROJCS[" if frame is UTM else "LOCAL_CS[")  # WKT 1
    crs = read.header.parse_crs()
    assert crs.to_epsg() == 32632 if frame is UTM else crs.name == "local metres"


@pytest.mark.parametrize(("code", "wkt"), [(2193, "PROJCS["), (8857, "PROJCRS[")])
def test_a_cloud_in_other_systems(tmp_path, code, wkt):
    """With north before east, and one that WKT 1 cannot describe."""
    write_laz(tmp_path / "a.laz", np.zeros((1, 3)), np.zeros((1, 3), np.uint8), f"EPSG:{code}")
    header = laspy.read(tmp_path / "a.laz").header
    assert header.parse_crs().to_epsg() == code
    assert header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith(wkt)


def test_a_cloud_without_points(tmp_path):
    xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    numbers = {"period": np.zeros(0, np.uint16)}
    write_laz(tmp_path / "a.laz", xyz, rgb, HERE.crs, dimensions=numbers)
    assert len(laspy.read(tmp_path / "a.laz")) == 0


GRID_CORNER = np.array([680_000.0, 5_151_985.0])  # In the south-west


def test_a_cloud_with_a_point_far_away(tmp_path):
    xyz = np.array([[0.0, 0, 0], [0.12, 4.56, -7.89], [3e7, -4e7, 2e7]])
    write_laz(tmp_path / "a.laz", xyz, np.zeros((3, 3), np.uint8), HERE.crs)
    read = laspy.read(tmp_path / "a.laz")
    np.testing.assert_allclose(read.header.scales, 0.1)
    np.testing.assert_allclose(read.xyz, xyz, atol=0.051)


SQUARE = np.array([[2, 2], [7, 2], [7, 5], [2, 5], [2, 2]]) + np.array([680_000.0, 5_151_990.0])

SLIVER = np.array([[0.05, 0.05], [3.2, 0.05], [3.2, 0.2], [0.05, 0.2], [0.05, 0.05]])


def geojson(ring, crs=None, **properties):
    shape = {"type": "Polygon", "coordinates": [np.asarray(ring).tolist()]}
    feature = {"type": "Feature", "properties": properties or None, "geometry": shape}
    named = {"crs": {"type": "name", "properties": {"name": crs}}} if crs else {}
    return {"type": "FeatureCollection", "features": [feature]} | named


def read(tmp_path, data, frame=UTM, grid=GRID):
    path = tmp_path / "area.geojson"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return read_polygons(path, grid, frame)


def test_polygons_in_each_system(tmp_path):
    to = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    degrees = np.column_stack(to.transform(*SQUARE.T))
    to = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:32633", always_xy=True)
    other = np.column_stack(to.transform(*SQUARE.T))
    cells = np.zeros(GRID.shape, bool)
    cells[10:16, 4:14] = True
    for data in (
        geojson(SQUARE, name="pit"),
        geojson(degrees, name="pit"),
        geojson(other, "urn:ogc:def:crs:EPSG::32633", name="pit"),
    ):
        made = read(tmp_path, data)
        assert list(made) == ["pit"]
        np.testing.assert_array_equal(made["pit"].cells, cells)
        assert made["pit"].on_map == 1
    named = read(tmp_path, geojson(degrees, name="pit"), NAMED)
    np.testing.assert_array_equal(named["pit"].cells, cells)
    near = Grid(0.0, 10.0, 0.5, 40, 30, 0.0, 10.0)
    local = read(tmp_path, geojson(SQUARE - [680_000, 5_151_990])["features"][0], HERE, near)
    np.testing.assert_array_equal(local["1"].cells, cells)


def test_a_polygon_that_leaves_the_map(tmp_path):
    # The map is 20 m wide: 5 of 40 m, less half of the hole, are on it.
    outer, hole = (
        np.array([[15, y], [55, y], [55, y + h], [15, y + h], [15, y]]) + GRID_CORNER
        for y, h in ((2, 8), (4, 2))
    )
    hole[:, 0] = np.array([17, 23, 23, 17, 17]) + GRID_CORNER[0]
    data = geojson(outer)
    data["features"][0]["geometry"]["coordinates"].append(hole.tolist())
    made = read(tmp_path, data)["1"]
    assert made.cells.sum() * 0.25 == 5 * 8 - 3 * 2
    assert made.on_map == pytest.approx((5 * 8 - 3 * 2) / (40 * 8 - 6 * 2))
    unclosed = read(tmp_path, geojson(outer[:-1] + np.array([[0, 0], [0, 0], [9, 0], [9, 0]])))["1"]
    assert unclosed.on_map == pytest.approx(unclosed.cells.sum() * 0.25 / (40 * 8))
    several = data["features"][0]["geometry"]
    several |= {"type": "MultiPolygon", "coordinates": [several["coordinates"], [SQUARE.tolist()]]}
    both = read(tmp_path, data)["1"]
    assert both.on_map == pytest.approx((5 * 8 - 3 * 2 + 15) / (40 * 8 - 6 * 2 + 15))


def test_equal_names_stay_apart(tmp_path):
    data = geojson(SQUARE, name="pit")
    data["features"] *= 2
    assert list(read(tmp_path, data)) == ["pit", "pit (2)"]


def test_a_name_that_looks_like_a_numbered_one(tmp_path):
    data = geojson(SQUARE, name="pit (3)")
    data["features"] += geojson(SQUARE, name="pit")["features"] * 2
    assert list(read(tmp_path, data)) == ["pit (3)", "pit", "pit (3) (3)"]


def test_names_that_are_empty_or_taken(tmp_path):
    data = geojson(SQUARE, name=None)  # as QGIS writes an empty field
    data["features"] += geojson(SQUARE, name="whole area")["features"]
    assert list(read(tmp_path, data)) == ["1", "whole area (2)"]


def test_properties_of_another_kind(tmp_path):
    data = geojson(SQUARE)
    data["features"][0]["properties"] = [3]
    assert list(read(tmp_path, data)) == ["1"]


def test_a_polygon_whose_edges_touch(tmp_path):
    """A ring that runs to a hole and back, as some programs write holes."""
    hole = [[4, 3], [4, 4], [5, 4], [5, 3], [4, 3]] + SQUARE[0] - [2, 2]
    made = read(tmp_path, geojson([SQUARE[0], *hole, *SQUARE]))["1"]
    assert made.cells.sum() * 0.25 == 15 - 1


def test_a_hole_that_crosses_the_border(tmp_path):
    data = geojson(SQUARE)
    data["features"][0]["geometry"]["coordinates"].append((SQUARE + 1).tolist())
    with pytest.raises(ConfigError, match="a polygon with an inside, found one that crosses"):
        read(tmp_path, data)


@pytest.mark.parametrize(
    ("data", "frame", "message"),
    [
        ("{", UTM, "expected JSON"),
        ({"type": "FeatureCollection", "features": []}, UTM, "expected polygons, found none"),
        ({"features": 3}, UTM, "expected polygons, found none"),
        ({"features": [3]}, UTM, "feature 1: expected a polygon"),
        ({"type": "Point", "coordinates": [0, 0]}, UTM, "expected a polygon"),
        ({"type": "Polygon", "coordinates": [[[0, 0], ["x", 1]]]}, UTM, "expected a polygon"),
        (geojson([["x", 0], [1, 0], [1, 1], [0, 0]]), UTM, "expected a polygon of GeoJSON"),
        (geojson([[0], [1], [2], [0]]), UTM, "expected a polygon of GeoJSON"),
        ({"type": "Polygon", "coordinates": []}, UTM, "expected a polygon of GeoJSON"),
        (geojson([[99, 0], [99.1, 0], [99.1, 0.1], [99, 0]]), UTM, "on the map, found one outside"),
        (geojson(SQUARE * np.nan), UTM, "expected a polygon"),
        (geojson(SQUARE * np.inf), UTM, "expected a polygon"),
        ({"features": [{"geometry": None}]}, UTM, "expected a polygon"),
        (geojson([[200, 95], [201, 95], [201, 96], [200, 95]]), UTM, "on the map"),
        (geojson([[2e2, 9e1], [1e300, 0], [0, 1], [2e2, 9e1]]), UTM, "on the map"),
        (geojson([[180, 90], [-180, 90], [0, -90], [180, 90]]), UTM, "on the map|expected"),
        (geojson(SQUARE + 1e4), UTM, "on the map, found one outside"),
        (geojson(SQUARE[0] + SLIVER), UTM, "one without the centre of a cell; choose"),
        (geojson(SQUARE[[0, 2, 1, 3]]), UTM, "one that crosses itself near 680..., 515199."),
        (geojson(SQUARE, "EPSG:nonsense"), UTM, "a known crs"),
        (geojson(SQUARE, "EPSG:32632"), HERE, "scene has none, .*draw them in the metres"),
        (geojson(SQUARE) | {"crs": 3}, UTM, "a known crs"),
    ],
)
def test_bad_polygons(tmp_path, data, frame, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, data, frame)
