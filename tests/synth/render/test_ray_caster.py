"""Ray caster: against all triangles one by one, and the same whatever the tree and its order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.synth import preset
from chronoscene.synth.city.plan import make_world
from chronoscene.synth.render.mesh import MISS
from chronoscene.synth.render.ray_caster import RayCaster

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def soup(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Random triangles, many of them flat and in line with the axes, as in a city."""
    corners = rng.normal(0, 20, (count, 1, 3)) + rng.normal(0, 3, (count, 3, 3))
    flat = rng.integers(0, 3, count)
    rows = np.flatnonzero(rng.random(count) < 0.6)
    corners[rows, :, flat[rows]] = np.round(corners[rows, :1, flat[rows]])
    return corners.astype(np.float32)


def some_rays(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Rays from among the triangles; some along an axis, from a whole coordinate."""
    rays = np.concatenate([rng.normal(0, 25, (count, 3)), rng.normal(size=(count, 3))], axis=1)
    straight = rng.random(count) < 0.2
    rays[straight, 3:] = np.eye(3)[rng.integers(0, 3, straight.sum())] * rng.choice([-1, 1])
    rays[straight, :3] = np.round(rays[straight, :3])
    return rays.astype(np.float32)


def by_trial(triangles: NDArray[np.float32], rays: NDArray[np.float32]) -> Array:
    """Parameter of the first hit over all triangles, in double precision."""
    a, b, c = np.moveaxis(triangles.astype(float), 1, 0)
    first = np.full(len(rays), np.inf)
    for i, ray in enumerate(rays.astype(float)):
        with np.errstate(divide="ignore", invalid="ignore"):
            p = np.cross(ray[3:], c - a)
            det = (p * (b - a)).sum(1)
            s = ray[:3] - a
            u = (p * s).sum(1) / det
            q = np.cross(s, b - a)
            v = q @ ray[3:] / det
            t = (q * (c - a)).sum(1) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (abs(det) > 1e-9)
        first[i] = t[hit].min(initial=np.inf)
    return first


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), count=st.sampled_from([1, 2, 5, 40, 700]))
def test_first_hits_are_those_of_all_triangles(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    triangles, rays = soup(rng, count), some_rays(rng, 200)
    caster = RayCaster(triangles)
    hits = caster.cast(rays)
    expected = by_trial(triangles, rays)
    assert np.mean(np.isfinite(expected) != np.isfinite(hits.t)) <= 0.01  # on edges, by rounding
    both = np.isfinite(expected) & np.isfinite(hits.t)
    np.testing.assert_allclose(hits.t[both], expected[both], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(caster.occluded(rays), np.isfinite(hits.t))
    np.testing.assert_array_equal(hits.tri == MISS, np.isinf(hits.t))
    u, v = hits.uv[both].T.astype(float)[:, :, None]
    a, b, c = np.moveaxis(triangles[hits.tri[both]].astype(float), 1, 0)
    there = rays[both, :3] + hits.t[both, None].astype(float) * rays[both, 3:]
    np.testing.assert_allclose((1 - u - v) * a + u * b + v * c, there, atol=2e-4)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_results_do_not_depend_on_the_order(seed: int) -> None:
    """Neither on the order of the triangles, which makes another tree, nor on that of the rays."""
    rng = np.random.default_rng(seed)
    triangles, rays = soup(rng, 3_000), some_rays(rng, 4_000)
    triangles[100:200] = triangles[:100]  # equal distances
    order, turn = rng.permutation(len(triangles)), rng.permutation(len(rays))
    one, other = RayCaster(triangles), RayCaster(triangles[order])
    hits = one.cast(rays)
    np.testing.assert_array_equal(one.cast(rays[turn]).tri, hits.tri[turn])
    np.testing.assert_array_equal(other.cast(rays).t, hits.t)
    assert not np.isin(hits.tri, np.arange(100, 200)).any(), "of equal ones the smallest number"
    points = rays[:500, :3].astype(float)
    np.testing.assert_array_equal(other.nearest(points)[0], one.nearest(points)[0])


def test_no_ray_leaves_a_closed_box() -> None:
    """Also those through its corners, edges and diagonals."""
    quads = CUBE[np.array(FACES)]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    rng = np.random.default_rng(0)
    inside = np.array([[0.5, 0.5, 0.5], [0.25, 0.5, 0.75], [0.1, 0.2, 0.3]], np.float32)
    a, b = CUBE[rng.integers(0, 8, 3_000)], CUBE[rng.integers(0, 8, 3_000)]
    aims = a + rng.random((3_000, 1)) * (b - a)
    aims = np.concatenate([CUBE, aims.astype(np.float32)])
    rays = np.concatenate([np.concatenate([np.broadcast_to(o, aims.shape), aims - o], axis=1)
                           for o in inside])  # fmt: skip
    hits = RayCaster(triangles).cast(rays.astype(np.float32))
    on_surface = np.any((aims == 0) | (aims == 1), axis=1)
    np.testing.assert_allclose(hits.t.reshape(3, -1)[:, on_surface], 1, rtol=1e-5)
    assert np.isfinite(hits.t).all()


@settings(max_examples=4)
@given(seed=st.integers(0, 10_000), count=st.sampled_from([1, 30, 500]))
def test_nearest_triangle(seed: int, count: int) -> None:
    """Samples of the surface are never nearer, and the nearest triangle touches that distance."""
    rng = np.random.default_rng(seed)
    triangles = soup(rng, count)
    points = rng.normal(0, 30, (20, 3))
    distance, number = RayCaster(triangles).nearest(points)
    steps = np.linspace(0, 1, 41)
    u, v = (x.ravel() for x in np.meshgrid(steps, steps))
    u, v = u[u + v <= 1 + 1e-9], v[u + v <= 1 + 1e-9]
    weights = np.stack([1 - u - v, u, v], axis=1)
    surface = np.einsum("sk,tkc->tsc", weights, triangles.astype(float))
    gaps = np.linalg.norm(surface[None] - points[:, None, None], axis=-1).min(axis=2)
    assert (distance <= gaps.min(axis=1) + 1e-9).all()
    reach = np.linalg.norm(np.diff(triangles.astype(float), axis=1), axis=2).max() / 40
    assert (gaps[np.arange(20), number] <= distance + reach).all()


def test_a_city_far_from_the_origin() -> None:
    """Rays that look down on a generated city hit its ground or what stands on it."""
    vertices = make_world(preset("tiny")).geometry(0)[0].vertices
    shift = np.array([500_000, 4_000_000, 0], np.float32)
    x, y = np.meshgrid(np.linspace(-8, 8, 30), np.linspace(-8, 8, 30))
    down = np.zeros((900, 6), np.float32)
    down[:, 0], down[:, 1], down[:, 2], down[:, 5] = x.ravel(), y.ravel(), 200, -1
    far = down.copy()
    far[:, :3] += shift
    near, there = RayCaster(vertices).cast(down), RayCaster(vertices + shift).cast(far)
    assert (near.t < 201).all() and np.isfinite(there.t).all()


@pytest.mark.parametrize("method", ["cast", "occluded"])
def test_no_rays(method: str) -> None:
    out = getattr(RayCaster(CUBE[None, :3]), method)(np.empty((0, 6), np.float32))
    assert len(out[0] if method == "cast" else out) == 0
