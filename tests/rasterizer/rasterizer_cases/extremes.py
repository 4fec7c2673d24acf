"""The registry of numerical extremes: how to build each, what must happen and why.

All Gaussians of a scene are extreme alike, so that the largest magnitude, by which errors are
divided, is an extreme one too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from chronoscene.harness.plan.parts import training_frame
from chronoscene.scene import Camera, Frame, Points
from chronoscene.scene.geometry import quaternion_from_rotation, rotation_from_quaternion

from .scenes import SmallScene, random_scene

AGREES, CULLED = "agrees", "culled"


@dataclass(frozen=True)
class Extreme:
    """One extreme."""

    name: str
    why: str
    """Outcome and its reason, for the README."""
    build: Callable[[], SmallScene]
    outcome: str = AGREES
    """AGREES with the reference; CULLED: the background and gradients of zero; or how the error
    begins."""
    truth: Callable[[], SmallScene] | None = None
    """Scene for the reference, if it is not the same numbers."""
    fixed: bool = False
    """Positions may not be rounded otherwise: depths are equal or at a plane on purpose."""
    seen: float = 0.01
    """Least mean opacity of the image: a comparison of nothing shows nothing."""

    @property
    def compared(self) -> bool:
        """True if there are errors to measure."""
        return self.outcome == AGREES


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


UTM = np.array([499_983.37, 5_411_402.81, 238.29])  # easting, northing, height in metres
ECEF = np.array([4_201_821.77, 172_347.91, 4_780_136.53])


def world(origin: np.ndarray) -> SmallScene:
    """Five metres of a street before two cameras turned any way, in float64 survey coordinates."""
    scene = _base(11)
    scene = scene.with_(scales=scene.scales * 2)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    for viewmat, centre in zip(viewmats, (origin, origin + 0.2), strict=True):
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
    """Round a scene, cameras too, to float32."""
    names = ("means", "quats", "scales", "viewmats", "Ks")
    return scene.with_(**{name: _f(getattr(scene, name)) for name in names})


def in_training_frame(scene: SmallScene) -> SmallScene:
    """Move a scene into the training frame, as the bench does, but keep float64."""
    (fx, _, cx), (_, fy, cy), _ = scene.Ks[0].tolist()
    camera = Camera(1, "PINHOLE", scene.width, scene.height, (fx, fy, cx, cy))
    frames = [Frame(f"{i}", i, camera, pose, 0, "train") for i, pose in enumerate(scene.viewmats)]
    points = replace(Points.empty(), ids=np.arange(len(scene.means)), xyz=scene.means)
    described: Any = SimpleNamespace(num_periods=1, select=lambda split: frames, points=points)
    training_from_world = training_frame(described)
    return scene.with_(
        means=training_from_world.apply(scene.means),
        scales=scene.scales * training_from_world.scale,
        viewmats=training_from_world.apply_to_pose(scene.viewmats),
    )


def _at_near_plane(ulps: int) -> SmallScene:
    """Centres so many units of the last place behind the near plane."""
    near = np.float32(0.01)
    scene = _base(6)
    means = scene.means.copy()
    means[:, :2] *= 0.002
    means[:, 2] = near + ulps * np.spacing(near)
    return scene.with_(
        means=means, scales=scene.scales * _f(0.01), options=(("near_plane", float(near)),)
    )


def _behind() -> SmallScene:
    scene = _base(6)
    return scene.with_(means=scene.means * _f([1, 1, -1]))


def _times(factor: float) -> SmallScene:
    """A scene of another unit of length."""
    scene, k = _base(8), np.float32(factor)
    planes = (("near_plane", 1e-18), ("far_plane", 1e18))
    return scene.with_(means=scene.means * k, scales=scene.scales * k, options=planes)


def _corners() -> SmallScene:
    """Centres on the corners of the image, and a hair to either side."""
    scene, i = _base(9), np.arange(24)
    corners = np.stack([37 * (i % 2), 29 * (i // 2 % 2)], axis=1)
    hairs = 1e-3 * np.stack([i // 4 % 3 - 1.0, i // 12 - 0.5], axis=1)
    return _seen_at(scene, corners + hairs, scene.Ks, scene.scales)


def _pile(count: int, opacity: float) -> SmallScene:
    """All on one pixel, at equal depth."""
    g = np.random.default_rng(1)
    return SmallScene(
        means=_all(count, [0.02, -0.03, 3]),
        quats=_all(count, [1, 0, 0, 0]),
        scales=np.full((count, 3), 0.01, np.float32),
        opacities=np.full(count, opacity, np.float32),
        colors=_f(g.uniform(0, 1, (count, 3))),
        viewmats=_f(np.eye(4)[None]),
        Ks=_f([[[10, 0, 1.5], [0, 10, 1.5], [0, 0, 1]]]),
        width=3,
        height=3,
        render_depth=True,
    )


def _equal_depth() -> SmallScene:
    scene = _base(12)
    means = scene.means.copy()
    means[:, 2] = 3
    return scene.with_(means=means, scales=scene.scales * 2)


def _focal(f: float, **entries: float) -> SmallScene:
    """A focal length in pixels; Gaussians of a few pixels."""
    scene, g = _base(13), np.random.default_rng(3)
    pixels = g.uniform(-0.1, 1.1, (24, 2)) * [37, 29]
    sizes = np.exp(g.uniform(-1, 1.5, (24, 3))) * scene.means[:, 2:] / f
    return _seen_at(scene, pixels, _camera(f, 37, 29, **entries), sizes)


def _size(count: int, width: int, height: int) -> SmallScene:
    """Gaussians of some pixels all over an image."""
    scene = random_scene(
        count, width, height, 14, backgrounds=_f([[0.2, 0.4, 0.6]]), render_depth=True
    )
    # Evenly spaced depths: two of a few hundred drawn at random may be equal but for rounding.
    depths = np.random.default_rng(5).permutation(np.linspace(2, 6, count))
    scene = scene.with_(means=_f(np.stack([depths] * 3, axis=1)))
    K = _camera(max(20.0, 0.1 * max(width, height)), width, height)
    pixels = np.random.default_rng(4).uniform(0, 1, (count, 2)) * [width, height]
    return _seen_at(scene, pixels, K, 20 / K[0, 0, 0] * scene.scales)


def _seen_at(
    scene: SmallScene, pixels: np.ndarray, K: np.ndarray, scales: np.ndarray
) -> SmallScene:
    """Gaussians moved so that their centres are at the given pixels. [N, 2]"""
    z = scene.means[:, 2].astype(np.float64)
    sideways = (pixels - K[0, :2, 2]) / K[0, [0, 1], [0, 1]] * z[:, None]
    means = np.concatenate([sideways, z[:, None]], axis=1)
    return scene.with_(means=_f(means), scales=_f(scales), Ks=K)


def _single() -> SmallScene:
    scene = _base(2, 1)
    return scene.with_(means=_f([[0.3, 0.2, 3]]), scales=_f([[0.3, 0.1, 0.2]]))


def _opaque() -> SmallScene:
    """Every pixel ends at the cap, in a stack of opaque Gaussians."""
    scene = _base(7)
    opacities = np.linspace(0.9, 1.0, 24, dtype=np.float32)
    return scene.with_(opacities=opacities, scales=scene.scales * 8)


def _edge_on() -> SmallScene:
    """Pancakes that contain the ray to their centre, or nearly."""
    return _scales(1.0, 1e-8, 1.0).with_(quats=_all(24, [1, 0, 0, 0]))


def _spoiled(name: str, *places: Any, value: float = np.nan) -> SmallScene:
    """A scene with bad numbers at some places."""
    scene = _base()
    array = np.array(getattr(scene, name))
    for place in places:
        array[place] = value
    return scene.with_(**{name: array})


def _survey(name: str, origin: np.ndarray) -> tuple[Extreme, ...]:
    """A world in survey coordinates in three ways."""
    return (
        Extreme(
            f"{name} coordinates, float64",
            "Right: the first camera becomes the origin before the numbers are cast to float32.",
            lambda: world(origin),
        ),
        Extreme(
            f"{name} coordinates, float32",
            "Right for the numbers given, which rounding has already moved by up to 0.25 m: the "
            "camera's centre is subtracted in two parts, so nothing more is lost.",
            lambda: rounded(world(origin)),
        ),
        Extreme(
            f"{name} coordinates, training frame",
            "Right: `chronoscene bench` recentres in float64, then casts.",
            lambda: rounded(in_training_frame(world(origin))),
            truth=lambda: in_training_frame(world(origin)),
        ),
    )


_NO_BLUR = (("eps2d", 0.0),)
_POINT = (
    "Right: as a point, whose image is the blur; gradients of the scales are as tiny as they are."
)
_HUGE = "Right: the image is covered evenly."
_THIN = "Right: neither pass has a difference in which the thin axis would vanish."
_UNIT = "Right: the length of a quaternion has no influence; it is scaled before it is squared."
_FAINT = "Culled: an opacity of 1/255 or less is nowhere seen."
_PLACE = "Error: it names the argument and the first index."
_SIZED = "Right: pixels outside the image are finished from the start."

EXTREMES = (
    *_survey("UTM", UTM),
    *_survey("ECEF", ECEF),
    Extreme("scales 1e-8", _POINT, lambda: _scales(1e-8, 1e-8, 1e-8), seen=0.005),
    Extreme(
        "scales 1e-8 without blur",
        "Right: nothing is seen, for no centre of a pixel is hit.",
        lambda: _scales(1e-8, 1e-8, 1e-8).with_(options=_NO_BLUR),
        seen=0,
    ),
    Extreme("scales 0", _POINT, lambda: _scales(0, 0, 0), seen=0.005),
    Extreme("scales 1e4", _HUGE, lambda: _scales(1e4, 1e4, 1e4)),
    Extreme(
        "scales 1e16",
        "Culled: half an extent of 1e15 pixels or more is not drawn.",
        lambda: _scales(1e16, 1e16, 1e16),
        CULLED,
    ),
    Extreme("needles 1 by 1e-8", _THIN, lambda: _scales(1.0, 1e-8, 1e-8)),
    Extreme("needles 1e4 by 1e-4", _THIN, lambda: _scales(1e4, 1e-4, 1e-4, spread=0.3)),
    Extreme("pancakes 1 by 1e-8", _THIN, lambda: _scales(1.0, 1.0, 1e-8)),
    Extreme(
        "pancakes 1 by 1e-8 without blur",
        _THIN,
        lambda: _scales(1.0, 1.0, 1e-8).with_(options=_NO_BLUR),
    ),
    Extreme("pancakes 1e4 by 1e-4", _THIN, lambda: _scales(1e4, 1e4, 1e-4)),
    Extreme("pancakes seen edge-on", _THIN, _edge_on),
    Extreme("quaternion 0", "Culled: it has no direction.", lambda: _quats(0.0), CULLED),
    Extreme("quaternions of length 1e-18", _UNIT, lambda: _quats(1e-18)),
    Extreme("quaternions of length 3e38", _UNIT, lambda: _quats(3e38)),
    Extreme(
        "quaternions of length 1e-25",
        "Culled: below 2⁻⁶⁶ the gradient, which grows with one over the length, has no bound.",
        lambda: _quats(1e-25),
        CULLED,
    ),
    Extreme("opacity 0", _FAINT, lambda: _opacities(0.0), CULLED),
    Extreme("opacity -0.0", _FAINT, lambda: _opacities(-0.0), CULLED),
    Extreme("opacity 1e-40", _FAINT, lambda: _opacities(1e-40), CULLED),
    Extreme("opacity 1", "Right: alpha is capped at 0.999.", lambda: _opacities(1.0)),
    Extreme(
        "opacity 1e20",
        "Right by the equation: alpha is capped wherever it is seen, the ellipse is larger.",
        lambda: _opacities(1e20),
    ),
    Extreme("on the near plane", "Right: it is drawn.", lambda: _at_near_plane(0), fixed=True),
    Extreme(
        "1 ulp before the near plane",
        "Culled. A plane is rounded to float32 as depths are.",
        lambda: _at_near_plane(-1),
        CULLED,
    ),
    Extreme("behind the camera", "Culled: not in front of it.", _behind, CULLED),
    Extreme(
        "at the camera's centre",
        "Culled, likewise.",
        lambda: _base(6).with_(means=_all(24, [0, 0, 0])),
        CULLED,
    ),
    Extreme(
        "a world 1e17 times as large", "Right: no square of a length appears.", lambda: _times(1e17)
    ),
    Extreme("a world 1e-17 times as large", "Right, likewise.", lambda: _times(1e-17)),
    Extreme(
        "a far plane of 3e38",
        "Error: depths above 1e18 overflow in the gradient of the depth image.",
        lambda: _base().with_(options=(("far_plane", 3e38),)),
        "near_plane, far_plane: expected 1e-18 <= near_plane < far_plane <= 1e+18",
    ),
    Extreme(
        "on the corners of the image", "Right: each is drawn as far as it is inside.", _corners
    ),
    Extreme(
        "1e5 on one pixel",
        "Right: the pixel ends after some 1,800; those behind have gradient 0.",
        lambda: _pile(100_000, 0.005),
        fixed=True,
    ),
    Extreme(
        "a stack of opaque Gaussians",
        "Right: light is never below 1e-4, where a pixel ends, so it cannot underflow.",
        _opaque,
    ),
    Extreme(
        "all at equal depth",
        "Right: drawn in the order of the input. Equal means equal in float32.",
        _equal_depth,
        fixed=True,
    ),
    Extreme("no Gaussian", "Right: the background.", lambda: _base(2, 0), CULLED),
    Extreme("one Gaussian", "Right: as any other.", _single),
    Extreme("an image of 1 x 1", _SIZED, lambda: _size(17, 1, 1)),
    Extreme("an image of 1 x 301", _SIZED, lambda: _size(150, 1, 301)),
    Extreme("an image of 301 x 1", _SIZED, lambda: _size(150, 301, 1)),
    Extreme("an image of 33 x 65", _SIZED, lambda: _size(150, 33, 65)),
    Extreme("an image of 8191 x 1", _SIZED, lambda: _size(100, 8191, 1)),
    Extreme(
        "an image of 65537 x 1",
        "Error: so far from the corner float32 places centres to 0.008 pixels only.",
        lambda: _base(width=65537, height=1),
        "width: expected 1 to 65536 whole pixels, found 65537",
    ),
    Extreme("a focal length of 1e7", "Right: a view of 0.0002 degrees.", lambda: _focal(1e7)),
    Extreme(
        "a focal length of 1/1000 of the width",
        "Right: a view of 179.8 degrees.",
        lambda: _focal(0.0371),
    ),
    Extreme(
        "a focal length of 1/10000 of the width",
        "Error: the image of a large Gaussian would be a difference of equal numbers.",
        lambda: _focal(0.00371),
        "Ks[0]: expected focal lengths of at least 0.001 of the image's width and height",
    ),
    Extreme(
        "a principal point 1e3 pixels outside",
        "Right: nothing supposes it to be inside.",
        lambda: _focal(40.0, cx=-1e3, cy=1e3),
    ),
    Extreme(
        "a principal point 1e5 pixels outside",
        "Right, to the 0.006 pixels that the rounding of an input is worth there.",
        lambda: _focal(40.0, cx=-1e5, cy=1e5),
    ),
    Extreme(
        "nan in means",
        _PLACE,
        lambda: _spoiled("means", (3, 1), (7, 0)),
        "means[3, 1]: expected a finite number, found nan",
    ),
    Extreme(
        "an infinite scale",
        _PLACE,
        lambda: _spoiled("scales", (5, 2), (9, 0), value=np.inf),
        "scales[5, 2]: expected a finite number, found inf",
    ),
    Extreme(
        "nan in backgrounds",
        _PLACE,
        lambda: _spoiled("backgrounds", (0, 2)),
        "backgrounds[0, 2]: expected a finite number, found nan",
    ),
    Extreme(
        "a singular camera",
        _PLACE,
        lambda: _spoiled("viewmats", (0, slice(0, 3), 0), value=0.0),
        "viewmats[0]: expected a rotation in the upper left 3 x 3",
    ),
    Extreme(
        "nan in all colours, not checked",
        "Culled, if `check_finite=False` switches the check off.",
        lambda: _spoiled("colors", (slice(None), 1)),
        CULLED,
    ),
)
