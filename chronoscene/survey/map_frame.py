"""Map coordinates of a scene: east, north and height in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import ConfigError, SceneError
from chronoscene.geodesy import STEP, from_crs, read_projected
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.orbit import find_up

LOCAL = 'LOCAL_CS["local metres",UNIT["metre",1]]'
"""Reference system, as WKT, of coordinates that have none."""
MAX_SCALE_ERROR = 0.01  # Of a reference system; in UTM, it is 0.001 between neighbouring zones
MAX_TILT = 45.0  # Degrees between z of a local scene and what is up in its photos


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """Affine map from the world of a scene to map coordinates: the tangent of a projection.

    It maps lines to lines, so that a camera straight above sees a map.
    """

    crs: str
    """For PROJ: the name of a projected system, or `LOCAL`."""
    matrix: Array
    """[3, 3]"""
    offset: Array
    """[3]"""
    error: float
    """Largest distance in metres from the projection itself, over all cameras."""
    remarks: tuple[str, ...] = ()
    """Reasons for which the coordinates are not exact."""

    @property
    def is_local(self) -> bool:
        """True if the scene has no georeference."""
        return self.crs == LOCAL

    @property
    def axes(self) -> Array:
        """Directions of east, north and up in the world, as rows: the nearest rotation. [3, 3]"""
        u, _, vt = np.linalg.svd(self.matrix)
        return np.asarray(u @ vt)

    @property
    def scales(self) -> Array:
        """Metres of the map per metre of the world, east, north and up. [3]"""
        return np.asarray(np.linalg.norm(self.matrix, axis=1))

    def to_map(self, world: Array) -> Array:
        """Convert places in the world. [N, 3]"""
        return np.asarray(world @ self.matrix.T + self.offset)

    def to_world(self, places: Array) -> Array:
        """Invert `to_map`. [N, 3]"""
        return np.asarray(np.linalg.solve(self.matrix, (places - self.offset).T).T)


def map_frame(scene: Scene, crs: str | None) -> MapFrame:
    """Choose map coordinates.

    They are those of ``crs``; by default those of the scene if it has a projected system, UTM if
    it has the local frame of a registration, and its own metres if it has no georeference.

    Raises:
        SceneError: If the world is not in metres, or its z axis does not point up.
        ConfigError: If a reference system cannot be used, or the scene has none to convert from.
    """
    poses = scene.frame_poses
    _check_world(scene, poses, crs)
    if scene.world.crs is None:
        return MapFrame(LOCAL, np.eye(3), np.zeros(3), error=0.0)
    centres = camera_centre(poses)
    middle, steps = np.median(centres, axis=0), STEP * np.eye(3)
    target, convert, remarks = _conversion(scene, middle, scene.world.crs, crs)
    matrix = (convert(middle + steps) - convert(middle - steps)).T / (2 * STEP)
    offset = convert(middle[None])[0] - matrix @ middle
    made = MapFrame(target, matrix, offset, error=0.0, remarks=tuple(remarks))
    _check_scales(made)
    errors = convert(centres) - centres @ matrix.T - offset
    return replace(made, error=float(np.linalg.norm(errors, axis=1).max()))


def _check_scales(frame: MapFrame) -> None:
    """Check that metres are metres in every direction: with equal areas, they need not be."""
    flat = frame.matrix[:2]
    known = np.isfinite(flat).all()
    scales = np.linalg.svd(flat, compute_uv=False) if known else np.array([np.inf])
    worst = scales[np.argmax(np.abs(scales - 1))]
    if abs(worst - 1) > MAX_SCALE_ERROR:
        raise ConfigError(
            f"--crs {frame.crs}",
            expected="a reference system whose scale is 1 in this region",
            found=f"scale {worst:.3g}",
            todo="choose another one, such as the zone of UTM",
        )


def _check_world(scene: Scene, poses: Array, crs: str | None) -> None:
    """Check that the world has metres and, if it is local, that z is up and no system wanted."""
    georeference = "register it with GPS or ground control"
    if scene.world.unit != "metre":
        raise SceneError(
            scene.root,
            expected="a scene in metres",
            found=f"unit {scene.world.unit} in sparse/world.json",
            todo=f"{georeference}, or state the unit there if you know it",
        )
    if scene.world.crs is not None:
        return
    if crs is not None:
        raise ConfigError(
            f"--crs {crs}",
            expected="a scene with a georeference",
            found="none in sparse/world.json",
            todo="leave it out, for products in the metres of the scene",
        )
    tilt = np.degrees(np.arccos(np.clip(find_up(poses)[2], -1, 1)))
    if tilt > MAX_TILT:
        raise SceneError(
            scene.root,
            expected="a world whose z axis points up",
            found=f"{tilt:.0f} degrees between z and what is up in the photos",
            todo=georeference,
        )


def _conversion(
    scene: Scene, middle: Array, world_crs: str, crs: str | None
) -> tuple[str, Callable[[Array], Array], list[str]]:
    """Name of the reference system of the map, the transform of world coordinates to it, and
    remarks on it in the middle of the scene."""
    local, shift = from_crs(world_crs), np.asarray(scene.world.offset)
    if local is not None:
        target = read_projected("--crs", crs or _utm(local.latitude, local.longitude), metres=True)
        remarks = target.remarks_at(local.latitude, local.longitude)
        return target.text, lambda xyz: target.from_local(local, xyz + shift), remarks
    import pyproj

    todo = "correct crs in sparse/world.json; with null, products are in the metres of the scene"
    source = read_projected(str(scene.root), world_crs, metres=True, todo=todo)
    target = source if crs is None else read_projected("--crs", crs, metres=True)
    transform = pyproj.Transformer.from_crs(source.text, target.text, always_xy=True).transform
    latitude, longitude = source.to_geodetic(middle + shift)

    def convert(xyz: Array) -> Array:
        east, north, height = (xyz + shift).T
        return np.column_stack([*transform(east, north), height])

    return target.text, convert, target.remarks_at(latitude, longitude, source.text)


def _utm(latitude: float, longitude: float) -> str:
    """Zone of UTM on WGS 84."""
    return f"EPSG:{(32601 if latitude >= 0 else 32701) + int((longitude + 180) % 360 // 6)}"
