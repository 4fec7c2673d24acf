"""Camera poses: one independent flight or walk per period."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import ConfigError
from chronoscene.scene import Camera, Frame, Split
from chronoscene.scene.geometry import look_at
from chronoscene.synth.city.world import World
from chronoscene.synth.render.noise import rng_for
from chronoscene.synth.render.renderer import PeriodRenderer
from chronoscene.synth.settings import SynthSettings

UNEQUAL = (1.09, 0.91, 1.0, 1.15, 0.85)
"""Views per period relative to the mean, repeated over the periods."""
TEST_SHARE = 0.15  # Share of test frames
SPLITS: tuple[Split, Split] = ("train", "test")
MAX_TRIES = 60


def make_camera(settings: SynthSettings) -> Camera:
    """The pinhole camera that all frames share."""
    w, h = settings.width, settings.height
    focal = (0.68 if settings.kind == "street" else 0.82) * w
    if not settings.off_centre:
        return Camera(1, "PINHOLE", w, h, (focal, focal, w / 2, h / 2))
    # Rounded to quarters of a pixel: exact in binary, and clearly not the image centre.
    cx, cy = round(4 * 0.56 * w) / 4, round(4 * 0.46 * h) / 4
    return Camera(1, "PINHOLE", w, h, (focal, 1.008 * focal, cx, cy))


def plan_frames(
    settings: SynthSettings, world: World, renderers: Sequence[PeriodRenderer]
) -> tuple[Frame, ...]:
    """All frames, period by period."""
    camera = make_camera(settings)
    route = ROUTES[settings.kind]
    frames: list[Frame] = []
    for period in range(settings.periods):
        count = max(4, round(settings.views * UNEQUAL[period % len(UNEQUAL)]))
        rng = rng_for(settings.seed, "flight", settings.kind, period)
        planned = route(world, count, rng)
        tests = _held_out(count, rng)
        for i, (eye, target) in enumerate(planned):
            pose = _free_pose(eye, target, settings.kind, renderers, camera, rng)
            name, split = f"p{period}_{i:04d}.jpg", SPLITS[i in tests]
            frames.append(Frame(name, len(frames) + 1, camera, pose, period, split))
    return tuple(frames)


def _held_out(count: int, rng: np.random.Generator) -> set[int]:
    """Indices of the test frames: one at random in each of several equal parts of a flight."""
    number = max(1, round(TEST_SHARE * count))
    cuts = np.linspace(0, count, number + 1)
    return {int(rng.integers(np.ceil(a), np.ceil(b))) for a, b in pairwise(cuts)}


def _flight(world: World, count: int, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Two orbits at different heights and an oblique grid."""
    half = float(np.abs(world.core).max())
    shares = [round(0.42 * count), round(0.24 * count)]
    high = rng.uniform(0.66, 0.84) * half
    low = rng.uniform(0.46, 0.58) * half
    radius = rng.uniform(0.85, 1.02) * half
    planned = _orbit(world, shares[0], rng, radius=radius, height=high)
    radius = rng.uniform(0.5, 0.66) * half
    planned += _orbit(world, shares[1], rng, radius=radius, height=low)
    return planned + _grid(world, count - sum(shares), rng, rng.uniform(0.6, 0.75) * half)


def _orbit(
    world: World, count: int, rng: np.random.Generator, *, radius: float, height: float
) -> list[tuple[Array, Array]]:
    """A closed orbit; cameras aim beside the centre, so that the whole core is covered."""
    middle = world.core.mean(axis=0) + rng.normal(0, 0.06 * radius, 2)
    start, way = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
    planned = []
    for i in range(count):
        turn = start + way * 2 * np.pi * (i + rng.uniform(-0.2, 0.2)) / count
        out = np.array([np.cos(turn), np.sin(turn)])
        r = radius * rng.uniform(0.94, 1.06)
        eye = np.array([*(middle + r * out), max(9.0, height * rng.uniform(0.9, 1.1))])
        side = np.array([-out[1], out[0]])
        aim = middle + radius * (rng.uniform(-0.25, 0.2) * out + rng.uniform(-0.25, 0.25) * side)
        planned.append((eye, np.array([*aim, 2.0])))
    return planned


def _grid(
    world: World, count: int, rng: np.random.Generator, height: float
) -> list[tuple[Array, Array]]:
    """Parallel lines over the core with oblique views forward and to the sides."""
    rows = max(2, round(np.sqrt(count)))
    columns = int(np.ceil(count / rows))
    low, high = world.core
    turn = rng.uniform(0, np.pi)
    axis = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    planned = []
    for k in range(count):
        row, column = divmod(k, columns)
        if row % 2:
            column = columns - 1 - column
        f = np.array([(column + 0.5) / columns, (row + 0.5) / rows]) - 0.5
        f = 0.92 * (axis @ f) + rng.normal(0, 0.02, 2)
        place = (low + high) / 2 + f * (high - low)
        heading = turn + (np.pi if row % 2 else 0) + rng.uniform(-0.5, 0.5)
        # Look away from the edge: few views see what lies outside the core.
        toward = -f * 1.1 + 0.25 * np.array([np.cos(heading), np.sin(heading)])
        toward = toward / max(float(np.linalg.norm(toward)), 1e-6)
        z = height * rng.uniform(0.92, 1.08)
        ahead = z * rng.uniform(0.45, 0.95)
        eye = np.array([*place, max(9.0, z)])
        planned.append((eye, np.array([*(place + ahead * toward), 1.0])))
    return planned


def _walk(world: World, count: int, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Along the roads nearest to the centre of the core, looking ahead and to both sides."""
    middle = world.core.mean(axis=0)
    roads = sorted(
        world.roads, key=lambda r: round(float(np.linalg.norm((r[0] + r[1]) / 2 - middle)), 3)
    )
    roads = roads[: int(np.clip(count // 8, 4, len(roads)))]
    lengths = np.array([np.linalg.norm(b - a) for a, b in roads])
    at = (np.arange(count) + rng.uniform(0.2, 0.8)) / count * lengths.sum()
    ends = np.cumsum(lengths)
    order = rng.permutation(len(roads))
    yaws = np.array([0.0, 0.75, -0.75, 0.35, 1.25, -0.35, -1.25])
    planned = []
    for i, s in enumerate(at):
        k = int(np.searchsorted(ends, s, side="right").clip(0, len(roads) - 1))
        a, b = roads[order[k]] if k % 2 else roads[order[k]][::-1]
        f = 0.04 + 0.92 * (s - (ends[k] - lengths[k])) / lengths[k]
        way = (b - a) / np.linalg.norm(b - a)
        side = np.array([-way[1], way[0]])
        place = a + f * (b - a) + rng.uniform(-2.4, 2.4) * side
        yaw = yaws[i % len(yaws)] + rng.normal(0, 0.12)
        toward = np.cos(yaw) * way + np.sin(yaw) * side
        eye = np.array([*place, rng.uniform(1.6, 2.6)])
        planned.append((eye, np.array([*(place + 10 * toward), eye[2] + rng.uniform(-0.3, 2.2)])))
    return planned


def _before(world: World, count: int, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """South of the core, within a few metres, all looking at its middle."""
    half = float(np.abs(world.core).max())
    middle = world.core.mean(axis=0)
    planned = []
    for i in range(count):
        along = (2 * (i + rng.uniform(0, 1)) / count - 1) * 0.07 * half
        place = middle + np.array([along, -0.95 * half + rng.normal(0, 1)])
        eye = np.array([*place, 0.55 * half + rng.normal(0, 1.2)])
        planned.append((eye, np.array([*(middle + rng.normal(0, 0.1 * half, 2)), 4.0])))
    return planned


ROUTES = {"aerial": _flight, "street": _walk, "facing": _before}
"""Ways that cameras go, by kind."""


def _free_pose(
    eye: Array,
    target: Array,
    kind: str,
    renderers: Sequence[PeriodRenderer],
    camera: Camera,
    rng: np.random.Generator,
) -> Array:
    """The planned pose, moved until it is clear of obstacles in all periods.

    All periods count because test views are rendered at every one of them.
    """
    apart = 2.0 if kind == "street" else 6.0
    for attempt in range(MAX_TRIES):
        shift = np.zeros(3)
        if attempt and kind != "street":
            shift = np.array([*rng.normal(0, 1.0 + 0.1 * attempt, 2), 0.9 * attempt])
        elif attempt:
            shift = np.array([*rng.normal(0, 0.25 + 0.05 * attempt, 2), 0.02 * attempt])
        place = eye + shift
        aim = target + (shift if kind == "street" else 0)
        pose = look_at(place, aim, float(rng.normal(0, 0.015)))
        if all(
            r.surfaces.nearest(place[None])[0][0] >= apart * 0.6
            and r.coarse_depth(camera, pose).min() >= apart
            for r in renderers
        ):
            return pose
    raise ConfigError(
        "--seed",
        expected="a city with free space for the cameras",
        found=f"no free position near {np.round(eye, 1).tolist()} after {MAX_TRIES} attempts",
        todo="choose another seed",
    )
