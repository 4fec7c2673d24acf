"""Rendering one period: images, depth, object and albedo maps, visibility tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.scene import Camera
from chronoscene.synth.render.light import Light, Probes, probe_values, sky_args
from chronoscene.synth.render.mesh import MISS, Mesh
from chronoscene.synth.render.ray_caster import Hits, RayCaster
from chronoscene.synth.render.shade import albedo_at, camera_rays, shade, shadow_rays

MAX_SAMPLES = 1_500_000  # Maximum number of rays in memory at once
PROBE_RAYS = 64
SUN_SPREAD = 0.009
"""Angular radius of the sun in radians; about twice the real one, for softer shadows."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelMaps:
    """First hits of the rays through pixel centres. Sky has depth 0 and element -1."""

    depth: NDArray[np.float32]
    """z-depth in metres. [H, W]"""
    element: NDArray[np.int32]
    """Identity of the object. [H, W]"""
    albedo: Array
    """Linear. [H, W, 3]"""


class PeriodRenderer:
    """Shader of the world at one period.

    Args:
        mesh: All geometry of the period.
        tri_element: Identity of the object of each triangle. [T]
        light: Light settings.
        supersample: Samples per pixel and axis.
        probe_box: Lowest and highest corner of the region with its own indirect light. [2, 3]
        probe_spacing: Metres between probes.
    """

    def __init__(
        self,
        mesh: Mesh,
        tri_element: NDArray[np.int32],
        light: Light,
        *,
        supersample: int,
        probe_box: Array,
        probe_spacing: float,
    ) -> None:
        self._sky = sky_args(light)
        self._element = tri_element
        self._ss = supersample
        self._box, self._spacing = probe_box, probe_spacing
        self.tables = mesh
        self.surfaces = RayCaster(mesh.vertices)

    def coarse_depth(self, camera: Camera, cam_from_world: Array) -> NDArray[np.float32]:
        """z-depth on a 24 x 18 grid over the view; infinite for the sky. [n]"""
        k = camera.K.copy()
        k[0] *= 24 / camera.width
        k[1] *= 18 / camera.height
        return self.surfaces.cast(camera_rays(np.linalg.inv(cam_from_world), k, 24, 0, 18, 1)).t

    def image(self, camera: Camera, cam_from_world: Array) -> NDArray[np.uint8]:
        """Photo of the period. [H, W, 3]"""
        world_from_cam = np.linalg.inv(cam_from_world)
        per_pixel = self._ss * self._ss
        step = max(1, MAX_SAMPLES // (camera.width * per_pixel))
        fw = 1.0 / (camera.K[0, 0] * self._ss)
        rows = []
        for row in range(0, camera.height, step):
            count = min(step, camera.height - row)
            rays = camera_rays(world_from_cam, camera.K, camera.width, row, count, self._ss)
            hits = self.surfaces.cast(rays)
            lit = self._lit(rays, hits, per_pixel)
            rows.append(shade(rays, *hits, lit, self.tables, self._sky, self.probes, per_pixel, fw))
        return np.concatenate(rows).reshape(camera.height, camera.width, 3)

    def maps(self, camera: Camera, cam_from_world: Array) -> PixelMaps:
        """Depth, objects and albedo at the pixel centres."""
        shape = (camera.height, camera.width)
        world_from_cam = np.linalg.inv(cam_from_world)
        rays = camera_rays(world_from_cam, camera.K, camera.width, 0, camera.height, 1)
        hits = self.surfaces.cast(rays)
        depth = np.where(hits.tri == MISS, np.float32(0), hits.t)
        color = self.albedo(rays, hits, depth / camera.K[0, 0])
        element = self.elements_of(hits.tri).reshape(shape)
        return PixelMaps(depth.reshape(shape), element, color.reshape(*shape, 3))

    def surface_near(self, points: Array) -> NDArray[np.uint32]:
        """Triangles that pass through points, `MISS` where the nearest is too far away. [n]"""
        gap, tri = self.surfaces.nearest(points)
        # A millimetre, and the rounding of single precision far from the origin.
        limit = 1e-3 + 2e-6 * np.abs(points).max(axis=1)
        return np.where(gap < limit, tri, np.uint32(MISS))

    def elements_of(self, tri: NDArray[np.uint32]) -> NDArray[np.int32]:
        """Identity of the objects of triangles, -1 for `MISS`. [n]"""
        out = np.full(len(tri), -1, np.int32)
        hit = tri != MISS
        out[hit] = self._element[tri[hit]]
        return out

    def albedo_on(self, points: Array, tri: NDArray[np.uint32]) -> Array:
        """Albedo in full detail at points on triangles. [n, 3]"""
        return np.asarray(albedo_at(points, tri, self.tables, np.zeros(len(tri))))

    def albedo(self, rays: NDArray[np.float32], hits: Hits, fw: NDArray[np.floating]) -> Array:
        """Linear albedo at hits, seen with pixels of the given widths in metres. [n, 3]"""
        t = np.where(hits.tri == MISS, 0, hits.t).astype(np.float64)[:, None]
        points = rays[:, :3].astype(np.float64) + t * rays[:, 3:]
        return np.asarray(albedo_at(points, hits.tri, self.tables, np.asarray(fw, np.float64)))

    @cached_property
    def probes(self) -> Probes:
        """Indirect light of the period."""
        low, high = self._box
        count = np.maximum(2, np.ceil((high - low) / self._spacing).astype(int) + 1)
        step = (high - low) / (count - 1)
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1)
        places = (low + grid * step).reshape(-1, 3)
        directions, albedo = _sphere(PROBE_RAYS), _mean_albedo(self.tables.styles)
        values, valid = [], []
        for start in range(0, len(places), MAX_SAMPLES // PROBE_RAYS):
            some = places[start : start + MAX_SAMPLES // PROBE_RAYS]
            rays = np.empty((len(some), PROBE_RAYS, 6), np.float32)
            rays[..., :3], rays[..., 3:] = some[:, None], directions
            flat = rays.reshape(-1, 6)
            hits = self.surfaces.cast(flat)
            lit = self._lit(flat, hits, 1)
            v, ok = probe_values(flat, *hits, lit, self.tables, albedo, self._sky, PROBE_RAYS)
            values.append(v)
            valid.append(ok)
        shape = tuple(int(n) for n in count)
        return Probes(
            np.asarray(low, np.float64),
            step,
            np.concatenate(values).reshape(*shape, 4, 3),
            np.concatenate(valid).reshape(shape),
        )

    def _lit(self, rays: NDArray[np.float32], hits: Hits, count: int) -> NDArray[np.bool_]:
        """Mask of the hits that the sun reaches. [n]"""
        towards, need = shadow_rays(
            rays, *hits, self.tables, self._sky.direction, SUN_SPREAD, count
        )
        lit = np.zeros(len(need), np.bool_)
        lit[need] = ~self.surfaces.occluded(towards[need])
        return lit


def _sphere(count: int) -> NDArray[np.float32]:
    """Evenly distributed unit directions (a Fibonacci lattice). [count, 3]"""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1).astype(np.float32)


def _mean_albedo(styles: Array) -> Array:
    """Approximate mean albedo of each style, for indirect light. [S, 3]"""
    return 0.7 * styles[:, 1:4] + 0.3 * styles[:, 4:7]
