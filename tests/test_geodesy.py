"""Geodetic positions to metres: against the closed form, and back."""

import re

import numpy as np
import pytest
from pyproj import CRS, Transformer

from chronoscene.errors import ConfigError, SceneError
from chronoscene.geodesy import (
    WGS84,
    Georeference,
    from_crs,
    median_longitude,
    read_projected,
    read_reference_system,
)

PLACE = (51.5, 10.25)
SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
"""Constants of WGS 84 (NIMA TR8350.2)."""


def geocentric(latitude, longitude, height):
    """Degrees and metres as x, y, z in metres, in closed form."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared = FLATTENING * (2 - FLATTENING)
    normal = SEMI_MAJOR / np.sqrt(1 - squared * np.sin(phi) ** 2)
    across = (normal + height) * np.cos(phi)
    up = (normal * (1 - squared) + height) * np.sin(phi)
    return np.stack([across * np.cos(lam), across * np.sin(lam), up], axis=-1)


def test_metres_agree_with_the_closed_form() -> None:
    rng = np.random.default_rng(0)
    frame = Georeference(39.99, 116.3, 50.0, "as stated")
    latitude, longitude = 39.99 + rng.uniform(-0.01, 0.01, 9), 116.3 + rng.uniform(-0.01, 0.01, 9)
    height = rng.uniform(0, 300, 9)
    phi, lam = np.radians([frame.latitude, frame.longitude])
    axes = np.array(
        [
            [-np.sin(lam), np.cos(lam), 0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )
    origin = geocentric(frame.latitude, frame.longitude, frame.height)
    expected = (geocentric(latitude, longitude, height) - origin) @ axes.T
    np.testing.assert_allclose(frame.to_enu(latitude, longitude, height), expected, atol=1e-6)


def test_metres_and_back() -> None:
    frame = Georeference(*PLACE, 30.0, "as stated")
    enu = np.array([[100.0, -50.0, 12.0], [0.0, 0.0, 0.0], [-3000.0, 4000.0, -20.0]])
    geodetic = frame.to_geodetic(enu)
    np.testing.assert_allclose(frame.to_enu(*geodetic.T), enu, atol=1e-6)
    np.testing.assert_allclose(geodetic[1], [*PLACE, 30.0], atol=1e-10)
    north = frame.to_enu(np.array([PLACE[0] + 1e-3]), np.array([PLACE[1]]), np.array([30.0]))
    assert north[0, 1] == pytest.approx(111.26, abs=0.1)  # meridian arc at 51.5 degrees
    assert abs(north[0, 0]) < 1e-6


def test_the_frame_is_read_back_from_its_text() -> None:
    frame = Georeference(51.5, -10.25, 30.0, "as stated")
    assert from_crs(frame.crs) == frame
    assert from_crs("EPSG:32632") is None
    assert from_crs(None) is None


def test_median_longitude_across_the_antimeridian() -> None:
    assert median_longitude(np.array([179.9, -179.9, 179.8])) == pytest.approx(179.9)
    assert median_longitude(np.array([179.9, -179.9, -179.8])) == pytest.approx(-179.9)
    assert median_longitude(np.array([10.0, 12.0, 11.0])) == pytest.approx(11.0)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("nonsense", "'nonsense'"),
        ("EPSG:32632+5773", "heights above a geoid"),
        ("EPSG:4978", "geocentric"),
        ("EPSG:27700", r"the grid (\S+\.tif); install it \(pyproj sync --file \1\)"),
        ("EPSG:3053", "does not convert to WGS 84 exactly"),
    ],
)
def test_systems_that_would_be_converted_wrongly_are_refused(text: str, found: str) -> None:
    with pytest.raises(SceneError, match=found) as caught:
        read_reference_system("points.csv:1", text)
    assert caught.value.place == "points.csv:1"


def test_another_datum_at_a_great_height() -> None:
    """Heights stay, but a place on two ellipsoids depends on how far it is above them."""
    frame = Georeference(46.0, 7.75, 3000.0, "as stated")
    swiss = read_reference_system("", "EPSG:2056")
    enu = np.array([[0.0, 0.0, 0.0], [500.0, -300.0, 200.0]])
    found = swiss.from_local(frame, enu)
    latitude, longitude, height = frame.to_geodetic(enu).T
    solid = Transformer.from_crs("EPSG:4979", CRS("EPSG:2056").to_3d(), always_xy=True)
    expected = np.column_stack(solid.transform(longitude, latitude, height))
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-6)  # was 7 cm away
    np.testing.assert_allclose(found[:, 2], height, atol=1e-9)
    # Stated heights do not say above which of the two, which are 50 m apart.
    np.testing.assert_allclose(swiss.to_local(frame, found), enu, atol=2e-3)


def test_names_of_systems() -> None:
    named = "WGS 84 / UTM zone 32N"
    with pytest.raises(SceneError, match=f"correct it; {named} is understood, too"):
        read_reference_system("--crs", "WGS84 UTM 32N")
    assert read_reference_system("--crs", named).is_projected


def test_coordinates_in_feet_have_heights_in_feet() -> None:
    metres, feet = read_reference_system("", "EPSG:6423"), read_reference_system("", "EPSG:6424")
    frame = Georeference(34.0, -118.0, 50.0, "as stated")
    enu = np.array([[10.0, 20.0, 30.0], [-5.0, 0.0, 7.0]])
    foot = 1200 / 3937
    assert feet.unit == pytest.approx(foot, rel=1e-12)
    np.testing.assert_allclose(
        foot * feet.from_local(frame, enu), metres.from_local(frame, enu), rtol=1e-9
    )
    np.testing.assert_allclose(feet.to_local(frame, feet.from_local(frame, enu)), enu, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "axes"), [("EPSG:2053", "west and south"), ("EPSG:5513", "south and west")]
)
def test_axes_that_are_not_east_and_north_are_read_but_not_written(text: str, axes: str) -> None:
    """Systems of South Africa and of Czechia: the second is even left-handed."""
    assert not read_reference_system("", text).is_east_north
    with pytest.raises(ConfigError, match=f"one whose axes point {axes} .{text}"):
        read_projected("--crs", text)


@pytest.mark.parametrize("text", ["EPSG:32632", "EPSG:2193", "EPSG:3413", "EPSG:3031"])
def test_axes_that_are_east_and_north_or_run_along_meridians(text: str) -> None:
    assert read_projected("--crs", text).is_east_north


def test_projected_coordinates_and_back() -> None:
    """Five degrees off the central meridian: north turns by the convergence of the grid."""
    frame = Georeference(*PLACE, 30.0, "as stated")
    utm = read_reference_system("", "EPSG:32633")
    enu = np.array([[0.0, 0.0, 0.0], [800.0, 0.0, 100.0], [-3000.0, 4000.0, -20.0]])
    projected = utm.from_local(frame, enu)
    np.testing.assert_allclose(utm.to_local(frame, projected), enu, atol=1e-6)
    turn = np.arctan(np.tan(np.radians(PLACE[1] - 15)) * np.sin(np.radians(PLACE[0])))
    axes = utm.derivative(frame, enu)[0]
    scale = np.hypot(*axes[:2, 0])
    assert 0.9996 < scale < 1.0010
    expected = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    np.testing.assert_allclose(axes[:2, :2], expected, atol=2e-5)
    np.testing.assert_allclose(axes[2], [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("crs", "inside", "outside"),
    [
        ("EPSG:32632", (48.0, 9.0), (48.0, 13.0)),
        ("EPSG:32760", (-17.0, 179.0), (17.0, 179.0)),
        ("EPSG:3460", (-17.0, -179.5), (-17.0, 170.0)),  # Fiji, on both sides of 180 degrees
        ("EPSG:3857", (48.0, -179.0), (89.0, 9.0)),
        ("+proj=utm +zone=32 +datum=WGS84", (48.0, 9.0), None),
    ],
)
def test_a_place_outside_of_the_area_of_a_system(crs, inside, outside) -> None:
    system = read_reference_system("", crs)
    assert not any("outside" in remark for remark in system.remarks_at(*inside))
    if outside is not None:
        (remark,) = system.remarks_at(*outside)
        assert crs in remark


@pytest.mark.parametrize(
    ("crs", "place", "source", "expected"),
    [
        (
            "EPSG:23030",
            (40.0, -3.5),
            WGS84,
            r"accuracy of 1.5 m here \(1 m .* es_ign_SPED2ETV2.tif",
        ),
        ("EPSG:23030", (40.0, -3.5), "EPSG:25830", "between EPSG:25830 and .* 1.5 m"),
        ("EPSG:6339", (38.0, -122.0), WGS84, "accuracy of 2 m here: coordinates may be"),
        ("+proj=utm +zone=32 +ellps=bessel", (48.0, 9.0), WGS84, "takes their datums for the same"),
        ("EPSG:25832", (48.0, 11.0), WGS84, None),
        ("EPSG:23030", (40.0, -3.5), "EPSG:23030", None),
        ("+proj=utm +zone=32 +ellps=bessel", (np.inf, np.inf), WGS84, None),
    ],
)
def test_conversions_that_are_less_exact_than_usual(crs, place, source, expected) -> None:
    remarks = read_reference_system("", crs).remarks_at(*place, source)
    assert len(remarks) == (expected is not None)
    assert expected is None or re.search(expected, remarks[0])
