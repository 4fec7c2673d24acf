"""Geometry of objects: triangles with textured patches.

A *patch* is a piece of surface with a texture frame (origin and two unit axes in metres, so that
textures are written in metres) and a *style* (kind of texture, colours, numbers). Triangles refer
to patches, patches to styles; both are plain tables, which the compiled shader reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.arrays import Array
from chronoscene.kernels.compilation import inner
from chronoscene.synth.render.noise import dot, plus, scaled, unit

Color = tuple[float, float, float]
TextureFrame = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Origin and two unit axes."""

X, Y, Z = np.eye(3)
"""Directions of the axes of the world."""

STYLE_WIDTH = 24
"""Style row: kind, three colours (1..9), numbers (10..19), reflectance at 0 degrees (20), sharpness
of reflection (21), translucency (22), unused (23)."""
PATCH_WIDTH = 12
"""Patch row: origin (0..2), u axis (3..5), v axis (6..8), extents along u and v (9, 10), free."""


def cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; faster than numpy's, which supports any axes."""
    product = np.empty(np.broadcast(a, b).shape)
    product[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    product[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    product[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def srgb(red: float, green: float, blue: float) -> Color:
    """Linear colour of an sRGB triple 0..255."""
    c = np.array([red, green, blue]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return (float(linear[0]), float(linear[1]), float(linear[2]))


class Mesh(NamedTuple):
    """Geometry as tables of T triangles, P patches and S styles, which kernels read directly."""

    vertices: NDArray[np.float32]
    """World metres, counter-clockwise seen from outside. [T, 3, 3]"""
    normals: NDArray[np.float32]
    """Unit shading normals per corner. [T, 3, 3]"""
    tri_patch: NDArray[np.int32]
    """[T]"""
    patches: NDArray[np.float64]
    """[P, PATCH_WIDTH]"""
    patch_style: NDArray[np.int32]
    """[P]"""
    patch_seed: NDArray[np.int32]
    """[P]"""
    styles: NDArray[np.float64]
    """[S, STYLE_WIDTH]"""

    @property
    def bounds(self) -> Array:
        """Lowest and highest corner. [2, 3]"""
        flat = self.vertices.reshape(-1, 3).astype(np.float64)
        return np.stack([flat.min(axis=0), flat.max(axis=0)])


class _Piece(NamedTuple):
    """N quads or triangles of one call: of one patch or, quads alone, of one each."""

    quads: bool
    values: Array
    """First corners, first and second edges of quads, [3, N, 3]; or vertices and normals of
    triangles, [2, N, 3, 3]."""
    row: Array | None
    """Texture frame and extents of the one patch. [11]"""
    style: int
    seed: int


class MeshBuilder:
    """Collects quads, boxes and triangles into a `Mesh`.

    Args:
        seed: Base of the texture hashes of this mesh.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._pieces: list[_Piece] = []
        self._styles: dict[bytes, int] = {}

    def style(
        self,
        kind: int,
        c0: Color,
        c1: Color | None = None,
        c2: Color | None = None,
        numbers: Sequence[float] = (),
        *,
        reflect: float = 0.0,
        sharp: float = 0.0,
        translucent: float = 0.0,
    ) -> int:
        """Index of a style; equal arguments share one."""
        row = np.zeros(STYLE_WIDTH)
        row[0] = kind
        row[1:10] = [*c0, *(c1 or c0), *(c2 or c0)]
        row[10 : 10 + len(numbers)] = numbers
        row[20:23] = reflect, sharp, translucent
        return self._styles.setdefault(row.tobytes(), len(self._styles))

    def quads(
        self,
        corner: ArrayLike,
        edge_u: ArrayLike,
        edge_v: ArrayLike,
        style: int,
        *,
        frame: TextureFrame | None = None,
        seed: int = 0,
    ) -> None:
        """Add N parallelograms; the outside is where ``edge_u x edge_v`` points.

        Args:
            corner: First corners. [N, 3]
            edge_u: First edges, or one for all. [N, 3] or [3]
            edge_v: Second edges, or one for all. [N, 3] or [3]
            style: Style index.
            frame: Frame of one texture over all quads; by default each quad has its own,
                which starts at its corner.
            seed: Varies the texture.
        """
        corners = np.asarray(corner, np.float64)
        count = len(corners) if corners.ndim == 2 else 1
        if count == 0:
            return
        quads = np.empty((3, count, 3))
        quads[0], quads[1], quads[2] = corners, edge_u, edge_v
        row = None if frame is None else _frame_row(frame, _corners(quads))
        self._pieces.append(_Piece(True, quads, row, style, seed))

    def boxes(
        self,
        corner: ArrayLike,
        a: ArrayLike,
        b: ArrayLike,
        c: ArrayLike,
        style: int,
        *,
        top: int | None = None,
        seed: int = 0,
        bottom: bool = True,
    ) -> None:
        """Add N parallelepipeds with right-handed edges a, b, c (c is usually up).

        Args:
            corner: Lowest corners. [N, 3]
            a: First edges. [N, 3] or [3]
            b: Second edges. [N, 3] or [3]
            c: Third edges. [N, 3] or [3]
            style: Style of the sides and the bottom.
            top: Style of the face at ``+c``; ``style`` where absent.
            seed: Varies the texture.
            bottom: Whether to add the face at ``-c`` as well.
        """
        edges = np.empty((4, *np.broadcast(np.atleast_2d(corner), a, b, c).shape))
        edges[0], edges[1], edges[2], edges[3] = corner, a, b, c
        o, x, y, z = edges
        self.quads(o, x, z, style, seed=seed)
        self.quads(o + x, y, z, style, seed=seed + 1)
        self.quads(o + x + y, -x, z, style, seed=seed + 2)
        self.quads(o + y, -y, z, style, seed=seed + 3)
        self.quads(o + z, x, y, style if top is None else top, seed=seed + 4)
        if bottom:
            self.quads(o + y, x, -y, style, seed=seed + 5)

    def polygon(
        self, points: ArrayLike, style: int, *, frame: TextureFrame | None = None, seed: int = 0
    ) -> None:
        """Add a convex polygon, counter-clockwise seen from outside. [K, 3]"""
        p = np.asarray(points, np.float64)
        tris = np.empty((len(p) - 2, 3, 3))
        tris[:, 0], tris[:, 1], tris[:, 2] = p[0], p[1:-1], p[2:]
        normal = cross(p[1] - p[0], p[2] - p[0])
        normal /= math.sqrt(normal @ normal)
        if frame is None:
            u = p[1] - p[0]
            u /= math.sqrt(u @ u)
            frame = (p[0], u, cross(normal, u))
        normals = np.broadcast_to(normal, tris.shape)
        self._add(tris, normals, _frame_row(frame, p), style, seed)

    def triangles(self, vertices: Array, normals: Array, style: int, *, origin: ArrayLike) -> None:
        """Add triangles of a curved surface as one patch; textures use world axes from origin.

        Args:
            vertices: [N, 3, 3]
            normals: Unit shading normals. [N, 3, 3]
            style: Style index.
            origin: Origin of the texture. [3]
        """
        frame = (origin, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        self._add(vertices, normals, _frame_row(frame, vertices), style, seed=0)

    def build(self) -> Mesh:
        """The collected geometry."""
        pieces = self._pieces
        counts = np.array([piece.values.shape[1] for piece in pieces])
        own = np.array([piece.row is None for piece in pieces])
        of_quads = np.array([piece.quads for piece in pieces])
        patches, num_tris = np.where(own, counts, 1), np.where(of_quads, 2 * counts, counts)
        vertices, normals = np.empty((2, num_tris.sum(), 3, 3), np.float32)
        own_patch = np.repeat(own, patches)
        table = np.zeros((len(own_patch), PATCH_WIDTH))
        if of_quads.any():
            here = np.repeat(of_quads, num_tris)
            quads = np.concatenate([p.values for p in pieces if p.quads], axis=1)
            _, u, v = quads
            normal = cross(u, v)
            normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
            vertices[here] = _corners(quads)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
            normals[here] = np.repeat(normal, 2, axis=0)[:, None]
            alone = np.repeat(own[of_quads], counts[of_quads])
            table[own_patch, :11] = _own_rows(quads[:, alone])
        if not of_quads.all():
            here = np.repeat(~of_quads, num_tris)
            solid = np.concatenate([p.values for p in pieces if not p.quads], axis=1)
            vertices[here], normals[here] = solid
        if not own.all():
            table[~own_patch, :11] = [p.row for p in pieces if p.row is not None]
        numbers = np.arange(len(table))
        # Pieces that share a frame are one texture, so they must share the seed as well.
        seeds = np.array([self._seed + 7919 * (piece.seed + 1) for piece in pieces])
        seeds = np.repeat(seeds, patches) + np.where(own_patch, 31 * numbers, 0)
        return Mesh(
            vertices,
            normals,
            np.repeat(numbers, np.repeat(num_tris // patches, patches)).astype(np.int32),
            table,
            np.repeat([piece.style for piece in pieces], patches).astype(np.int32),
            (seeds % 1_000_003).astype(np.int32),
            np.stack([np.frombuffer(row) for row in self._styles]),
        )

    def _add(self, vertices: Array, normals: Array, row: Array, style: int, seed: int) -> None:
        self._pieces.append(_Piece(False, np.stack([vertices, normals]), row, style, seed))


def _corners(quads: Array) -> Array:
    """Corners of parallelograms, counter-clockwise. [N, 4, 3]"""
    o, u, v = quads
    return np.stack([o, o + u, o + u + v, o + v], axis=1)


def _own_rows(quads: Array) -> Array:
    """Patch rows of textures that start at the corner of each quad. [N, 11]"""
    o, u, v = quads
    lengths = np.sqrt(np.stack([(u * u).sum(axis=1), (v * v).sum(axis=1)], axis=1))
    return np.concatenate([o, u / lengths[:, :1], v / lengths[:, 1:], lengths], axis=1)


def _frame_row(frame: TextureFrame, points: Array) -> Array:
    """Patch row of a texture frame; the extents reach the farthest of the points. [11]"""
    row = np.empty(11)
    row[0:3], row[3:6], row[6:9] = frame
    local = points.reshape(-1, 3) - row[0:3]
    row[9], row[10] = (local @ row[3:6]).max(), (local @ row[6:9]).max()
    return row


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, with shifted indices."""
    patch_shift = np.cumsum([0, *(len(p.patches) for p in meshes)])
    style_shift = np.cumsum([0, *(len(p.styles) for p in meshes)])
    tri_patch = [p.tri_patch + np.int32(n) for p, n in zip(meshes, patch_shift, strict=False)]
    patch_style = [p.patch_style + np.int32(n) for p, n in zip(meshes, style_shift, strict=False)]
    return Mesh(*map(np.concatenate, zip(*meshes, strict=True)))._replace(
        tri_patch=np.concatenate(tri_patch), patch_style=np.concatenate(patch_style)
    )


MISS = 0xFFFFFFFF  # Triangle of a ray that hits nothing


@inner
def hit_normals(tables, tri, u, v, d):  # type: ignore[no-untyped-def]
    """Flat and smooth unit normals of a hit; the flat one is turned towards the viewer."""
    a, b, c = tables.vertices[tri, 0], tables.vertices[tri, 1], tables.vertices[tri, 2]
    e0, e1, e2 = float(b[0] - a[0]), float(b[1] - a[1]), float(b[2] - a[2])
    f0, f1, f2 = float(c[0] - a[0]), float(c[1] - a[1]), float(c[2] - a[2])
    flat = unit((e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0))
    n = tables.normals[tri]
    smooth = unit(plus(plus(scaled(n[0], 1.0 - u - v), scaled(n[1], u)), scaled(n[2], v)))
    return (scaled(flat, -1.0) if dot(flat, d) > 0.0 else flat), smooth
