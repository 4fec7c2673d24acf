"""Change maps between the periods of a finished run: places on its surfaces, with scores.

Colours change with the light, depth does not. A place on a surface of one period is gone at another
one if cameras that see it see farther there:

    geometry = d / (k + n) * sum over n views of max(0, 1/z - 1/z'),

where z and z' are the depths of the two periods at the pixel of the place, d is the usual distance
of cameras, and k views without a change are added, so that one view proves little. The score is the
relative change of depth at the distance d. A view counts if it sees the place, and nothing in front
of it at the other period; near views count more, as errors of depth grow with its square.

Where geometry stays, appearance is what the light does not explain: mean colours of a place at both
periods, without their brightness, differ by more than one affine map for the whole scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.errors import ConfigError
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.methods import Prediction
from chronoscene.scene import Camera
from chronoscene.scene.cameras import project_points, unproject_pixels

Render = Callable[[Camera, Array, float], Prediction]
"""Render a camera with a pose at a period, as `TrainedRun.render`."""

COLUMNS = 160  # Pixels of a row of an image that become places
CELL = 0.01  # Edge of the cells that hold one place each, in usual distances
SAME = 0.1  # Relative difference of depth up to which a camera sees a place
HIDDEN = 0.01  # Relative difference of depth from which something is in front of it
UNCHANGED_VIEWS = 5  # k
NEIGHBOURS = 4  # Places whose mean score a pixel has

GEOMETRY = 0.015
"""Score from which geometry has changed: 1.5 % of the depth at the usual distance."""
APPEARANCE = 0.08
"""Distance of colours, whose channels sum to 1, from which appearance has changed."""

CLASSES = ("unchanged", "unknown", "appearance", "gone", "new")
"""Classes by their number in `ChangeMap.classes`. Gone are places on surfaces of the first period,
new are places on surfaces of the second."""
ALL_PAIRS = 4
"""Number of periods up to which all pairs are compared unless the user chooses."""
_DARK = 0.05  # Added to colours before their brightness is divided out: black has no hue
_ROUNDS = 10  # Of reweighted least squares


@dataclass(frozen=True, eq=False)
class ChangeMap:
    """Places on the surfaces of two periods."""

    periods: tuple[int, int]
    xyz: Array
    """In the world. [N, 3]"""
    later: Mask
    """True for places on a surface of the second period, not of the first. [N]"""
    known: Mask
    """True for places that a training camera of the other period sees. [N]"""
    geometry: Array
    """Score of change, 0 or more; 0 where unknown. [N]"""
    appearance: Array
    """Score of change, 0 or more; 0 where unknown or where geometry has changed. [N]"""

    @cached_property
    def classes(self) -> Ints:
        """Index into `CLASSES`. [N]"""
        kinds = [~self.known, self.geometry >= GEOMETRY, self.appearance >= APPEARANCE]
        return np.select(kinds, [1, np.where(self.later, 4, 3), 2], 0)

    def shares(self) -> dict[str, float]:
        """Return shares of all classes but the first; gone and new are shares of their period."""
        whole = (1, 1, np.mean(~self.later), np.mean(self.later))
        shares = [np.mean(self.classes == i) / part for i, part in enumerate(whole, start=1)]
        return dict(zip(CLASSES[1:], map(float, shares), strict=True))

    @cached_property
    def _sides(self) -> list[tuple[cKDTree, Array]]:
        """Places of each period, and their scores. [n, 2]"""
        scores = np.stack([self.geometry, self.appearance], axis=1)
        return [(cKDTree(self.xyz[rows]), scores[rows]) for rows in (~self.later, self.later)]

    def view_scores(self, viewpoint: Viewpoint, shown: Sequence[Prediction]) -> Array:
        """Return scores of geometry and appearance in a view: the larger of both surfaces.

        Args:
            viewpoint: The camera.
            shown: Its pictures at the first and at the second period.

        Returns:
            [H, W, 2]
        """
        width, height = viewpoint.camera.size
        values = np.zeros((height, width, 2))
        for (tree, scores), prediction in zip(self._sides, shown, strict=True):
            depth = surface_depth(prediction)
            near = range(1, 1 + min(NEIGHBOURS, tree.n))
            _, places = tree.query(back_project(depth, viewpoint), near)
            at = np.isfinite(depth)
            values[at] = np.maximum(values[at], scores[places].mean(axis=1))
        return values


def map_changes(
    render: Render,
    viewpoints: Sequence[Viewpoint],
    periods: tuple[int, int],
    *,
    load_mask: Callable[[Viewpoint], Mask | None] = lambda _: None,
) -> ChangeMap:
    """Compare two periods.

    Args:
        render: Renders the model, with depth in units of the world.
        viewpoints: Training cameras of the two periods.
        periods: The two periods in their order.
        load_mask: Returns the pixels of a photo that count, None if all do: its camera sees nothing
            at the others. [H, W]

    Raises:
        ConfigError: If one of them shows nothing.
    """

    def seen_by(viewpoint: Viewpoint, period: float) -> Prediction:
        shown = render(viewpoint.camera, viewpoint.cam_from_world, period)
        return where_counted(shown, load_mask(viewpoint))

    found: dict[int, list[Array]] = {period: [np.zeros((0, 3))] for period in periods}
    depths = []
    for viewpoint in viewpoints:
        assert viewpoint.period is not None
        depth = surface_depth(seen_by(viewpoint, viewpoint.period))
        step = max(1, round(viewpoint.camera.width / COLUMNS))
        found[int(viewpoint.period)].append(back_project(depth, viewpoint, step))
        depths.append(depth[::step, ::step].ravel())
    places = {period: np.concatenate(parts) for period, parts in found.items()}
    for period, xyz in places.items():
        if not len(xyz):
            raise ConfigError(
                f"period {period}",
                expected="surfaces in its training views",
                found="none",
                todo="compare other periods",
            )
    depth = np.concatenate(depths)
    distance = float(np.median(depth[np.isfinite(depth)]))
    surfaces = [_Surface(_thinned(xyz, CELL * distance)) for xyz in places.values()]
    for viewpoint in viewpoints:
        seen = [seen_by(viewpoint, period) for period in periods]
        for surface, period, shown in zip(surfaces, periods, (seen, seen[::-1]), strict=True):
            surface.look(viewpoint, *shown, is_other=viewpoint.period != period)
    known = np.concatenate([surface.other_views > 0 for surface in surfaces])
    geometry = np.concatenate([distance * surface.score() for surface in surfaces])
    (earlier, later), (later_own, earlier_other) = (surface.mean_colors() for surface in surfaces)
    return ChangeMap(
        periods,
        xyz=np.concatenate([surface.xyz for surface in surfaces]),
        later=np.repeat([False, True], [len(surface.xyz) for surface in surfaces]),
        known=known,
        geometry=np.where(known, geometry, 0),
        appearance=unexplained(
            np.concatenate([earlier, earlier_other]),
            np.concatenate([later, later_own]),
            known & (geometry < GEOMETRY),
        ),
    )


class _Surface:
    """Places on the surfaces of a period, and sums over the views that see them."""

    def __init__(self, xyz: Array) -> None:
        self.xyz = xyz
        self.parallax, self.views = np.zeros(len(xyz)), np.zeros(len(xyz))
        self.other_views = np.zeros(len(xyz))
        self.colors = np.zeros((2, len(xyz), 3))

    def look(
        self, viewpoint: Viewpoint, own: Prediction, other: Prediction, *, is_other: bool
    ) -> None:
        """Compare two pictures of a camera.

        Args:
            viewpoint: The camera.
            own: Picture at the period of the surface.
            other: Picture at the other period.
            is_other: True for a camera of the other period.
        """
        pose = viewpoint.cam_from_world
        local = self.xyz @ pose[:3, :3].T + pose[:3, 3]
        xy = project_points(viewpoint.camera, local)
        with np.errstate(invalid="ignore"):
            places = np.flatnonzero(((xy >= 0) & (xy < viewpoint.camera.size)).all(axis=1))
        column, row = xy[places].astype(int).T
        z, near, far = local[places, 2], *(surface_depth(p)[row, column] for p in (own, other))
        seen = (np.abs(near - z) < SAME * z) & (far >= (1 - HIDDEN) * near)
        places, row, column = places[seen], row[seen], column[seen]
        self.parallax[places] += np.maximum(0, 1 / near[seen] - 1 / far[seen])
        self.views[places] += 1
        self.other_views[places] += is_other
        for total, shown in zip(self.colors, (own, other), strict=True):
            total[places] += shown.rgb[row, column]

    def score(self) -> Array:
        """Score of geometry, per unit of the usual distance. [N]"""
        return self.parallax / (self.views + UNCHANGED_VIEWS)

    def mean_colors(self) -> Array:
        """Mean colours at the period of the surface and at the other one. [2, N, 3]"""
        return self.colors / np.maximum(self.views, 1)[:, None]


def usual_pairs(periods: int) -> list[tuple[int, int]]:
    """Return the pairs that are compared unless the user chooses; they do not grow with the square
    of many periods."""
    numbers = range(periods)
    return list(combinations(numbers, 2) if periods <= ALL_PAIRS else pairwise(numbers))


def where_counted(prediction: Prediction, mask: Mask | None) -> Prediction:
    """Remove the depth of pixels that a mask ignores: a model never learned what is there."""
    if mask is None or prediction.depth is None:
        return prediction
    return replace(prediction, depth=np.where(mask, prediction.depth, 0))


def surface_depth(prediction: Prediction) -> Array:
    """Depth in units of the world, infinite where there is no surface. [H, W]"""
    assert prediction.depth is not None
    return np.where(prediction.depth > 0, prediction.depth, np.inf).astype(np.float64)


def back_project(depth: Array, viewpoint: Viewpoint, step: int = 1) -> Array:
    """Return places in the world at the pixels of every ``step``-th row and column. [n, 3]"""
    rows, columns = np.indices(depth.shape)[:, ::step, ::step].reshape(2, -1)
    z = depth[rows, columns]
    kept = np.isfinite(z)
    xy = np.stack([columns[kept], rows[kept]], axis=1).astype(np.float64) + 0.5
    rays = unproject_pixels(viewpoint.camera, xy)
    local = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * z[kept, None]
    pose = viewpoint.cam_from_world
    return np.asarray((local - pose[:3, 3]) @ pose[:3, :3])


def _thinned(xyz: Array, cell: float) -> Array:
    """Keep one place in each cell of a grid."""
    _, first = np.unique(np.floor(xyz / cell), axis=0, return_index=True)
    return xyz[np.sort(first)]


def unexplained(first: Array, second: Array, counted: Mask) -> Array:
    """Return changes of colours, brightness aside, that one affine map does not explain.

    The map is fitted robustly: distances are small in most places, a few may be large.

    Args:
        first: RGB at the first period. [N, 3]
        second: RGB at the second period. [N, 3]
        counted: Places that count; the others get 0. [N]

    Returns:
        Distance of colours whose channels sum to 1. [N]
    """
    colors = [c[counted] + _DARK for c in (first, second)]
    given, wanted = (c / c.sum(axis=1, keepdims=True) for c in colors)
    given[:, 2] = 1  # the three channels sum to 1, so two are enough beside the constant
    distances = np.ones(len(given))
    for _ in range(_ROUNDS):
        root = 1 / np.sqrt(np.maximum(distances, 1e-3))[:, None]
        solution = np.linalg.lstsq(given * root, wanted * root, rcond=None)[0]
        distances = np.linalg.norm(wanted - given @ solution, axis=1)
    found = np.zeros(len(first))
    found[counted] = distances
    return found
