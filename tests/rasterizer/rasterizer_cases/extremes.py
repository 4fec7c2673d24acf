"""The registry of numerical extremes: how to build each, what must happen and why.

All Gaussians of a scene are extreme alike, so that the largest magnitude, by which errors are
divided, is an extreme one too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from chronoscene.bench.protocol import training_frame
from chronoscene.geometry import quaternion_from_rotation, rotation_from_quaternion

from .scenes import SmallScene, random_scene

AGREES, CULLED = "agrees", "culled"


@dataclass(frozen=True)
class Extreme:
    """One extreme."""

    name: str
    why: str
    """What happens and why that is right, for the README."""
    build: Callable[[], SmallScene]
    outcome: str = AGREES
    """AGREES with the reference; CULLED: the background and gradients of zero; or an error."""
    truth: Callable[[], SmallScene] | None = None
    """What the reference is given, if it is not the same numbers."""
    ties: bool = False
    """Depths are equal on purpose: positions may not be moved to see what their rounding does."""
    excluded: float = 0.05
    """Largest share of pixels that may be left out because a threshold decides them."""
    band: float = 1e-4
    """How far the thresholds are moved to find them."""


def _f(x: Any) -> np.ndarray:
    return np.asarray(x, np.float32)


def _camera(f: float, width: int, height: int, **entries: float) -> np.ndarray:
    K = np.array([[f, 0, 0.45 * width], [0, 1.1 * f, 0.55 * height], [0, 0, 1]])
    K[0, 2], K[1, 2] = entries.get("cx", K[0, 2]), entries.get("cy", K[1, 2])
    return _f(K[None])


def _base(seed: int = 5, count: int = 24, **changes: Any) -> SmallScene:
    scene = random_scene(count, 37, 29, seed, backgrounds=_f([[0.2, 0.4, 0.6]]), render_depth=True)
    return scene.with_(**changes)


def _all(count: int, row: Any) -> np.ndarray:
    return np.tile(_f(row), (count, *(1 for _ in np.shape(row))))


def _scales(*row: float, seed: int = 5, spread: float = 1.0) -> SmallScene:
    """All Gaussians with these scales; before the camera, in all orientations."""
    scene = _base(seed)
    means = scene.means * _f([spread, spread, 1])
    return scene.with_(means=means, scales=_all(24, row))


def _quats(factor: float) -> SmallScene:
    scene = _base()
    unit = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    return scene.with_(quats=_f(unit.astype(np.float64) * factor))


def _opacities(value: float) -> SmallScene:
    return _base(opacities=np.full(24, value, np.float32))


_UTM = np.array([499_983.37, 5_411_402.81, 238.29])  # easting, northing, height in metres
_ECEF = np.array([4_201_821.77, 172_347.91, 4_780_136.53])


def _world(origin: np.ndarray) -> SmallScene:
    """Five metres of a street before two cameras turned any way, in float64 survey coordinates."""
    scene = _base(11)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    for viewmat, centre in zip(viewmats, (origin, origin + [0.3, 0.2, 0.1]), strict=True):
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ centre
    rotations = turn.T @ rotation_from_quaternion(scene.quats)
    return scene.with_(
        means=scene.means.astype(np.float64) @ turn + origin,
        quats=np.stack([quaternion_from_rotation(r) for r in rotations]),
        viewmats=viewmats,
        Ks=np.tile(scene.Ks, (2, 1, 1)),
        backgrounds=_f([[0.2, 0.4, 0.6]] * 2),
    )


def rounded(scene: SmallScene) -> SmallScene:
    """What float32 leaves of a scene, cameras too."""
    names = ("means", "quats", "scales", "viewmats", "Ks")
    return scene.with_(**{name: _f(getattr(scene, name)) for name in names})


def in_training_frame(scene: SmallScene) -> SmallScene:
    """As the bench hands a scene to methods, but still float64."""
    frames = [SimpleNamespace(cam_from_world=viewmat) for viewmat in scene.viewmats]
    described: Any = SimpleNamespace(
        select=lambda split: frames, points=SimpleNamespace(xyz=scene.means)
    )
    training_from_world = training_frame(described)
    return scene.with_(
        means=training_from_world.apply(scene.means),
        scales=scene.scales * training_from_world.scale,
        viewmats=training_from_world.apply_to_pose(scene.viewmats),
    )


def at_camera(scene: SmallScene) -> SmallScene:
    """The same images from float64 coordinates whose origin is the first camera."""
    viewmats, means = scene.viewmats.astype(np.float64), scene.means.astype(np.float64)
    origin = -np.linalg.solve(viewmats[0, :3, :3], viewmats[0, :3, 3])
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ origin
    return scene.with_(means=means - origin, viewmats=viewmats)


def _at_near_plane(z: Callable[[np.float32], np.float32]) -> SmallScene:
    near = np.float32(0.01)
    scene = _base(6)
    means = scene.means.copy()
    means[:, :2] *= 0.002
    means[:, 2] = z(near)
    return scene.with_(
        means=means, scales=scene.scales * _f(0.01), options=(("near_plane", float(near)),)
    )


def _far(factor: float, far: float) -> SmallScene:
    scene, k = _base(8), np.float32(factor)
    return scene.with_(
        means=scene.means * k, scales=scene.scales * k, options=(("far_plane", far),)
    )


def _corners() -> SmallScene:
    """Centres on the corners of the image, and a hair to either side."""
    scene = _base(9, viewmats=_f(np.eye(4)[None]))
    fx, fy, cx, cy = (float(scene.Ks[0][i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    means = scene.means.astype(np.float64)
    for i in range(24):
        u, v = 37 * (i % 2), 29 * (i // 2 % 2)
        u, v = u + 1e-3 * (i // 4 % 3 - 1), v + 1e-3 * (i // 12 - 0.5)
        means[i, :2] = means[i, 2] * np.array([(u - cx) / fx, (v - cy) / fy])
    return scene.with_(means=_f(means))


def _pile(count: int, opacity: float) -> SmallScene:
    """All on the middle pixel, at equal depth."""
    g = np.random.default_rng(1)
    return SmallScene(
        means=_all(count, [0, 0, 3]),
        quats=_all(count, [1, 0, 0, 0]),
        scales=np.full((count, 3), 0.01, np.float32),
        opacities=np.full(count, opacity, np.float32),
        colors=_f(g.uniform(0, 1, (count, 3))),
        viewmats=_f(np.eye(4)[None]),
        Ks=_f([[[10, 0, 2.5], [0, 10, 2.5], [0, 0, 1]]]),
        width=5,
        height=5,
        render_depth=True,
    )


def _equal_depth() -> SmallScene:
    scene = _base(12)
    means = scene.means.copy()
    means[:, 2] = 3
    return scene.with_(means=means, scales=scene.scales * 2)


def _focal(f: float, reach: float, **entries: float) -> SmallScene:
    """A focal length in pixels; centres within ``reach`` half images of the axis's image."""
    scene = _base(13)
    K = _camera(f, 37, 29, **entries)
    g = np.random.default_rng(3)
    pixels = g.uniform(-0.1, 1.1, (24, 2)) * [37, 29] * reach
    z = scene.means[:, 2].astype(np.float64)
    means = np.stack([(pixels[:, i] - K[0, i, 2]) / K[0, i, i] * z for i in (0, 1)] + [z], axis=1)
    sizes = np.exp(g.uniform(-1, 1.5, (24, 3))) * z[:, None] / f
    return scene.with_(means=_f(means), scales=_f(sizes), Ks=K)


def _size(count: int, width: int, height: int) -> SmallScene:
    scene = random_scene(
        count, width, height, 14, backgrounds=_f([[0.2, 0.4, 0.6]]), render_depth=True
    )
    K = _camera(20.0, width, height)
    g = np.random.default_rng(4)
    pixels = g.uniform(0, 1, (count, 2)) * [width, height]
    z = scene.means[:, 2].astype(np.float64)
    means = np.stack([(pixels[:, i] - K[0, i, 2]) / K[0, i, i] * z for i in (0, 1)] + [z], axis=1)
    return scene.with_(means=_f(means), Ks=K)


def _with(scene: SmallScene, name: str, index: Any, value: float) -> SmallScene:
    array = np.array(getattr(scene, name))
    array[index] = value
    return scene.with_(**{name: array})


def _single() -> SmallScene:
    scene = _base(2, 1)
    return scene.with_(means=_f([[0.3, 0.2, 3]]), scales=_f([[0.3, 0.1, 0.2]]))


def _opaque() -> SmallScene:
    """Every pixel ends at the cap, in a stack of opaque Gaussians."""
    scene = _base(7)
    return scene.with_(opacities=np.linspace(0.9, 1.0, 24, dtype=np.float32), scales=scene.scales * 8)


_BELOW = np.nextafter(np.float32(1), np.float32(0))

EXTREMES = (
    Extreme("UTM, float64", "w", lambda: _world(_UTM)),
    Extreme("UTM, float32", "w", lambda: rounded(_world(_UTM))),
    Extreme("UTM, training frame", "w", lambda: rounded(in_training_frame(_world(_UTM))),
        truth=lambda: in_training_frame(_world(_UTM))),
    Extreme("ECEF, float64", "w", lambda: _world(_ECEF)),
    Extreme("ECEF, float32", "w", lambda: rounded(_world(_ECEF))),
    Extreme("ECEF, training frame", "w", lambda: rounded(in_training_frame(_world(_ECEF))),
        truth=lambda: in_training_frame(_world(_ECEF))),
    Extreme("scales 1e-8", "w", lambda: _scales(1e-8, 1e-8, 1e-8)),
    Extreme("scales 1e-8, no blur", "w", lambda: _scales(1e-8, 1e-8, 1e-8).with_(options=(("eps2d", 0.0),))),
    Extreme("no blur", "w", lambda: _base().with_(options=(("eps2d", 0.0),))),
    Extreme("scales 1e4", "w", lambda: _scales(1e4, 1e4, 1e4)),
    Extreme("needles 1e8:1", "w", lambda: _scales(1.0, 1e-8, 1e-8)),
    Extreme("pancakes 1e8:1", "w", lambda: _scales(1.0, 1.0, 1e-8)),
    Extreme("needles 1e4 x 1e-4", "w", lambda: _scales(1e4, 1e-4, 1e-4, spread=0.3)),
    Extreme("pancakes 1e4 x 1e-4", "w", lambda: _scales(1e4, 1e4, 1e-4)),
    Extreme("pancakes edge-on", "w", lambda: _scales(1.0, 1e-8, 1.0).with_(quats=_all(24,[1,0,0,0]))),
    Extreme("quaternion 0", "w", lambda: _quats(0.0), CULLED),
    Extreme("quaternions 1e-18", "w", lambda: _quats(1e-18)),
    Extreme("quaternions 1e-25", "w", lambda: _quats(1e-25), CULLED),
    Extreme("quaternions 1e30", "w", lambda: _quats(1e30)),
    Extreme("quaternions 3e38", "w", lambda: _quats(3e38)),
    Extreme("opacity 0", "w", lambda: _opacities(0.0), CULLED),
    Extreme("opacity -0.0", "w", lambda: _opacities(-0.0), CULLED),
    Extreme("opacity 1e-40", "w", lambda: _opacities(1e-40), CULLED),
    Extreme("opacity 1", "w", lambda: _opacities(1.0)),
    Extreme("opacity 1e20", "w", lambda: _opacities(1e20)),
    Extreme("on the near plane", "w", lambda: _at_near_plane(lambda z: z)),
    Extreme("1 ulp before the near plane", "w", lambda: _at_near_plane(lambda z: np.nextafter(z, np.float32(0))), CULLED),
    Extreme("behind the camera", "w", lambda: _at_near_plane(lambda z: -z), CULLED),
    Extreme("at the camera", "w", lambda: _at_near_plane(lambda z: z * 0), CULLED),
    Extreme("distance 1e30", "w", lambda: _far(1e30, 1e36)),
    Extreme("distance 1e-1", "w", lambda: _far(0.01, 1e36)),
    Extreme("distance 3e37", "w", lambda: _far(3e37, 3e38)),
    Extreme("image corners", "w", _corners),
    Extreme("1e5 on one pixel", "w", lambda: _pile(100_000, 0.005), ties=True),
    Extreme("opaque stack", "w", _opaque),
    Extreme("equal depth", "w", _equal_depth, ties=True),
    Extreme("no Gaussian", "w", lambda: _base(2, 0)),
    Extreme("one Gaussian", "w", _single),
    Extreme("1x1 pixel", "w", lambda: _size(17, 1, 1)),
    Extreme("1xN pixels", "w", lambda: _size(150, 1, 301)),
    Extreme("Nx1 pixels", "w", lambda: _size(150, 301, 1)),
    Extreme("odd size", "w", lambda: _size(150, 33, 65)),
    Extreme("long image", "w", lambda: _size(150, 4097, 3)),
    Extreme("focal length 1e-3", "w", lambda: _focal(1e-3, 1.0)),
    Extreme("focal length 1e7", "w", lambda: _focal(1e7, 1.0)),
    Extreme("principal point 1e5 pixels outside", "w", lambda: _focal(40.0, 1.0, cx=-1e5, cy=1e5)),
    Extreme("principal point 1e3 pixels outside", "w", lambda: _focal(40.0, 1.0, cx=-1e3, cy=1e3)),
)
