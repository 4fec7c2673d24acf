"""Map coordinates, compared with PROJ used directly."""

import re
from dataclasses import replace

import numpy as np
import pyproj
import pytest
from surveyed import moved

from chronoscene.errors import ConfigError, SceneError
from chronoscene.geodesy import Georeference
from chronoscene.scene import WorldFrame
from chronoscene.scene.geometry import camera_centre
from chronoscene.survey.map_frame import LOCAL, map_frame

PLACE = Georeference(46.5, 11.35, 300.0, "as stated")
XYZ = np.array([[0.0, 0, 0], [120, -80, 10], [-60, 90, -5]])


def exactly(xyz, crs):
    lat, lon, height = PLACE.to_geodetic(xyz).T
    east, north = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return np.column_stack([east, north, height])


@pytest.mark.parametrize(("crs", "used"), [(None, "EPSG:32632"), ("EPSG:25833", "EPSG:25833")])
def test_the_local_frame_of_a_registration(scene, crs, used):
    frame = map_frame(replace(scene, world=WorldFrame("metre", PLACE.crs)), crs)
    assert frame.crs == used and not frame.is_local
    np.testing.assert_allclose(frame.to_map(XYZ), exactly(XYZ, used), atol=0.003)
    np.testing.assert_allclose(frame.to_world(frame.to_map(XYZ)), XYZ, atol=1e-6)
    assert frame.error < 1e-3
    east = exactly(np.array([[0.0, 0, 0]]), used)[0] + [1, 0, 0]
    step = frame.to_world(east[None])[0]
    np.testing.assert_allclose(step, frame.axes[0] / frame.scales[0], atol=2e-3)
    assert np.degrees(np.arccos(frame.axes[0, 0])) > 1  # the convergence of meridians
    assert (frame.scales[:2] > 0.9995).all() and (frame.scales[:2] < 1.0006).all()


def test_south_of_the_equator(scene):
    south = Georeference(-33.9, 18.4, 0.0, "as stated")
    assert map_frame(replace(scene, world=WorldFrame("metre", south.crs)), None).crs == "EPSG:32734"


def test_a_projected_scene_with_an_offset(scene):
    offset = (680_000.0, 5_152_000.0, 300.0)
    world = WorldFrame("metre", "EPSG:32632", offset)
    frame = map_frame(replace(scene, world=world), None)
    np.testing.assert_allclose(frame.to_map(XYZ), XYZ + offset, atol=1e-6)
    other = map_frame(replace(scene, world=world), "EPSG:32633")
    convert = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:32633", always_xy=True)
    wanted = np.column_stack([*convert.transform(*(XYZ + offset).T[:2]), XYZ[:, 2] + 300])
    np.testing.assert_allclose(other.to_map(XYZ), wanted, atol=0.01)


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (WorldFrame("metre", PLACE.crs), "46.5000 north, 11.3500 east, outside .* EPSG:25833"),
        (WorldFrame("metre", "EPSG:32632", (680_000.0, 5_152_000.0, 0.0)), "outside .* EPSG:25833"),
        (WorldFrame("metre", "EPSG:32633", (500_000.0, 5_152_000.0, 0.0)), None),
    ],
)
def test_remarks_on_a_reference_system(scene, world, expected):
    remarks = map_frame(replace(scene, world=world), "EPSG:25833").remarks
    assert len(remarks) == (expected is not None)
    assert expected is None or re.search(expected, remarks[0])


def test_the_local_frame_with_an_offset(scene):
    shift = np.array([900.0, -700.0, 40.0])
    world = moved(scene, -shift, crs=PLACE.crs, offset=tuple(shift))
    frame = map_frame(world, None)
    np.testing.assert_allclose(frame.to_map(XYZ - shift), exactly(XYZ, frame.crs), atol=0.003)


def test_the_error_is_that_of_the_affine_map(scene):
    wide = moved(scene, [3000.0, 0, 0], crs=PLACE.crs)
    frames = [f if f.period else g for f, g in zip(wide.frames, scene.frames, strict=True)]
    wide = replace(wide, frames=tuple(frames))
    frame = map_frame(wide, None)
    centres = camera_centre(wide.frame_poses)
    off = np.linalg.norm(frame.to_map(centres) - exactly(centres, frame.crs), axis=1)
    assert frame.error == pytest.approx(off.max(), rel=1e-3)
    assert 0.1 < frame.error < 0.3  # the curvature of the earth: 1500^2 / 2 / 6.4e6


def test_local_metres(scene):
    frame = map_frame(scene, None)
    assert frame.is_local and frame.crs == LOCAL
    np.testing.assert_array_equal(frame.to_map(XYZ), XYZ)


@pytest.mark.parametrize(
    ("world", "crs", "error", "message"),
    [
        (WorldFrame(), None, SceneError, "a scene in metres, found unit unknown"),
        (WorldFrame("metre"), "EPSG:32632", ConfigError, "a scene with a georeference, found none"),
        (WorldFrame("metre", PLACE.crs), "EPSG:4326", ConfigError, "found one in degrees"),
        (WorldFrame("metre", PLACE.crs), "EPSG:6424", ConfigError, "found one in feet"),
        (WorldFrame("metre", PLACE.crs), "EPSG:99999", ConfigError, "that PROJ knows"),
        (WorldFrame("metre", PLACE.crs), "EPSG:5513", ConfigError, "axes point south and west"),
        (WorldFrame("metre", PLACE.crs), "EPSG:32755", ConfigError, "scale is 1 in this region"),
        (WorldFrame("metre", PLACE.crs), "EPSG:3857", ConfigError, r"found scale 1\.45"),
        (WorldFrame("metre", PLACE.crs), "EPSG:8857", ConfigError, r"found scale 1\.07"),
        (WorldFrame("metre", "EPSG:4326"), None, ConfigError, "found one in degrees.*world.json"),
        (WorldFrame("metre", "EPSG:6424"), "EPSG:32632", ConfigError, "in feet.*world.json"),
    ],
)
def test_errors(scene, world, crs, error, message):
    with pytest.raises(error, match=message):
        map_frame(replace(scene, world=world), crs)


def test_a_local_world_that_lies_on_its_side(scene):
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    frames = tuple(replace(f, cam_from_world=f.cam_from_world @ turn) for f in scene.frames)
    with pytest.raises(SceneError, match="z axis points up, found 90 degrees"):
        map_frame(replace(scene, frames=frames), None)
