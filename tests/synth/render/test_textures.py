"""Noise, filtered patterns and textures; geometry of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from chronoscene.synth.render import noise
from chronoscene.synth.render import textures as tex
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, srgb
from chronoscene.synth.render.shade import albedo_at

# Inner functions have no entry for Python; these give them one.
_pulse, _span = noise.pulse, noise.span
_hash01, _value_noise = noise.hash01, noise.value_noise


@njit
def pulse(x, period, width, fw):  # type: ignore[no-untyped-def]
    return _pulse(x, period, width, fw)


@njit
def span(x, low, high, fw):  # type: ignore[no-untyped-def]
    return _span(x, low, high, fw)


@njit
def hash01(ix, iy, seed):  # type: ignore[no-untyped-def]
    return _hash01(ix, iy, seed)


@njit
def value_noise(x, y, seed):  # type: ignore[no-untyped-def]
    return _value_noise(x, y, seed)


KINDS = {
    tex.PLAIN: (0.3, 0.5),
    tex.PLASTER: (0.2, 3.0, 0.2),
    tex.BRICK: (0.25, 0.08, 3.0),
    tex.PANEL: (1.2, 1.5, 0.2),
    tex.CONCRETE: (2.4, 1.5),
    tex.TILES: (0.3, 0.36, 0.2),
    tex.FLAT_ROOF: (1.1, 1.0),
    tex.ASPHALT: (1, 2.0),
    tex.PAVING: (0.6, 0.4, 0.5, 2.0, 4.0),
    tex.GRASS: (0.2, 0.1, 0.2),
    tex.SOIL: (0.1, 0.8),
    tex.LEAVES: (0.24, 0.1),
    tex.WOOD: (0.16, 0.02),
    tex.PAINT: (0.2, 0.3),
    tex.CORRUGATED: (0.3, 0.2, 1.0),
    tex.FIELDS: (),
    tex.GLASS: (0.07, 2, 2),
    tex.SIGN: (),
    tex.WATER: (),
    tex.SOLAR: (),
    tex.DOOR: (),
}


ORDER = sorted(KINDS)
SIZE = 12.0


def sheet() -> Mesh:
    """One square of 12 m per kind, all in the same place; triangle 2 * i is of kind ORDER[i]."""
    b = MeshBuilder(seed=77)
    for kind in ORDER:
        colors = srgb(150, 80, 60), srgb(90, 110, 140), srgb(200, 200, 190)
        b.quads(np.zeros(3), [SIZE, 0, 0], [0, SIZE, 0], b.style(kind, *colors, KINDS[kind]))
    return b.build()


def color(kind: int, uv: np.ndarray, fw: float) -> np.ndarray:
    """Albedo of a kind at texture coordinates [n, 2]. [n, 3]"""
    uv = np.atleast_2d(uv).astype(float)
    points = np.column_stack([uv, np.zeros(len(uv))])
    tri = np.full(len(uv), 2 * ORDER.index(kind), np.uint32)
    return albedo_at(points, tri, sheet(), np.full(len(uv), fw))


@settings(deadline=None)  # the first call compiles
@given(st.floats(-50, 50), st.floats(0.05, 5), st.floats(0.01, 0.99), st.floats(1e-3, 8))
def test_pulse_is_a_box_filter(x: float, period: float, duty: float, fw: float) -> None:
    width = duty * period
    at = x + fw * ((np.arange(100_003) + 0.5) / 100_003 - 0.5)
    brute = np.mean(np.mod(at, period) < width)
    assert pulse(x, period, width, fw) == pytest.approx(brute, abs=2e-3)


@settings(deadline=None)
@given(st.floats(-5, 5), st.floats(-3, 0), st.floats(0, 3), st.floats(1e-3, 4))
def test_span_is_a_box_filter(x: float, low: float, high: float, fw: float) -> None:
    at = x + fw * ((np.arange(100_003) + 0.5) / 100_003 - 0.5)
    assert span(x, low, high, fw) == pytest.approx(np.mean((at >= low) & (at < high)), abs=2e-3)


def test_hash_is_uniform_and_depends_on_the_seed() -> None:
    values = np.array([[hash01(i, j, s) for s in (3, 4)] for i in range(80) for j in range(80)])
    assert np.allclose(values.mean(axis=0), 0.5, atol=0.02)
    assert np.allclose(values.std(axis=0), np.sqrt(1 / 12), atol=0.02)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.03


@settings(deadline=None)
@given(st.floats(-1000, 1000), st.floats(-1000, 1000))
def test_noise_is_bounded_and_continuous(x: float, y: float) -> None:
    here = value_noise(x, y, 5)
    assert -1 <= here <= 1
    # The steepest slope of the fade curve is 15/8, over a range of 2.
    assert abs(value_noise(x + 1e-4, y, 5) - here) <= 2 * 15 / 8 * 1e-4 + 1e-9


@settings(max_examples=40, deadline=None)  # the first call compiles
@given(st.sampled_from(ORDER), st.floats(-5, 300), st.floats(-5, 300), st.floats(1e-4, 50))
def test_albedo_is_physical(kind: int, u: float, v: float, fw: float) -> None:
    c = color(kind, np.array([u, v]), fw)
    assert np.isfinite(c).all() and (c > 0).all() and (c < 0.95).all()


@pytest.mark.parametrize("kind", ORDER)
def test_far_pixels_are_calm_and_keep_the_mean(kind: int) -> None:
    """With wide pixels neighbours agree better than fine detail does, at the same mean colour."""
    rng = np.random.default_rng(kind)
    at = rng.uniform(1.5, 10.5, (600, 2))
    fine = color(kind, at, 1e-3).mean(axis=1)
    wide = color(kind, at, 1.5).mean(axis=1)
    assert wide.std() <= fine.std() + 0.01
    assert wide.mean() == pytest.approx(fine.mean(), rel=0.2)


def test_boxes_are_closed_and_face_outwards() -> None:
    """The divergence theorem gives the volume only if every face is there and turned right."""
    b = MeshBuilder()
    a, c, d = np.array([2.0, 0.5, 0]), np.array([-0.4, 3.0, 0.1]), np.array([0.1, 0.2, 1.5])
    b.boxes([[5.0, 6.0, 7.0], [0.0, 0.0, 0.0]], a, c, d, b.style(0, (1.0, 1.0, 1.0)))
    t = b.build().vertices.astype(float)
    volume = np.einsum("ni,ni->", t[:, 0], np.cross(t[:, 1], t[:, 2])) / 6
    assert volume == pytest.approx(2 * np.dot(a, np.cross(c, d)), rel=1e-5)


def test_pieces_of_one_frame_share_one_texture() -> None:
    """Walls are cut around windows; the bricks must run on as if they were not."""
    b = MeshBuilder(seed=4)
    s = b.style(tex.BRICK, (0.3, 0.1, 0.1))
    frame = (np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
    b.quads([0.0, 0, 0], [2.0, 0, 0], [0, 0, 1.0], s, frame=frame)
    b.quads([0.0, 0, 2.0], [2.0, 0, 0], [0, 0, 1.0], s, frame=frame)
    mesh = b.build()
    assert mesh.patch_seed[0] == mesh.patch_seed[1]
    assert (mesh.patches[0, :9] == mesh.patches[1, :9]).all()
