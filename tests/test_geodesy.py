"""Geodetic positions to metres: against the closed form, and back."""

import numpy as np
import pytest

from chronoscene.errors import SceneError
from chronoscene.geodesy import Georeference, from_crs, median_longitude, read_reference_system

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
        ("EPSG:27700", "grid"),
    ],
)
def test_systems_that_would_be_converted_wrongly_are_refused(text: str, found: str) -> None:
    with pytest.raises(SceneError, match=found) as caught:
        read_reference_system("points.csv:1", text)
    assert caught.value.place == "points.csv:1"


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
