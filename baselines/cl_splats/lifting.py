"""From changed pixels to Gaussians: which are optimised, which are new, and where they may be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from baselines.cl_splats.changes import changed_pixels
from baselines.cl_splats.config import CLSplatsConfig
from baselines.cl_splats.model import PeriodModel
from chronoscene.arrays import Array, Mask
from chronoscene.gaussians.model import initialise
from chronoscene.methods import Prediction, TrainingSet, TrainingView, View
from chronoscene.training.devices import to_device
from chronoscene.training.drawing import Splats, weights_in

_STREAM = 9  # Keeps the points apart from other draws of the same seed
_SEEN = 0.5
"""Pixels that a Gaussian must add to a view to be seen there."""
_BEHIND = 1.02
"""Times the depth of what is shown: behind that, a point is hidden."""
_HITS = 2
"""Views in which a new point must be in a changed pixel."""
_CERTAIN = 0.9
"""Share of the views that see a drawn point in which it must be in a changed pixel: what changed
lies on most rays of changed pixels at one place only."""
_NEAREST = 0.5
"""Times the depth of what is shown: no point is drawn before that. Few views see what is close to a
camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A photo of the new period beside what the model before shows of it."""

    view: TrainingView
    photo: NDArray[np.uint8]
    """[H, W, 3]"""
    counts: Mask
    """Pixels of the photo that count. [H, W]"""
    changed: Mask
    """Changed pixels, all of which count. [H, W]"""
    depth: NDArray[np.floating]
    """Depth of the render; infinite where it shows nothing. [H, W]"""


@torch.no_grad()
def begin_period(
    model: PeriodModel,
    train: TrainingSet,
    render: Callable[[View, float], Prediction],
    config: CLSplatsConfig,
    *,
    extent: float,
    seed: int,
) -> None:
    """Find what has changed, and leave the model with what is to be optimised.

    Args:
        model: At the end of the training on the period before.
        train: Its views are of the new period alone.
        render: Shows the model.
        config: Of both.
        extent: That margins of spheres are multiples of.
        seed: Of the points that are drawn.
    """
    period = train.views[0].period
    found = [compare(train, i, render, model.period, config) for i in range(len(train.views))]
    splats = model.splats(train.views[0], model.period)  # those of all views but for their colours
    rows = model.rows(model.period)[vote(splats, found, config)]
    generator = np.random.default_rng((seed, _STREAM, period))
    positions, colors = new_points(splats, found, train, config, generator)
    new = {name: tensor[:0] for name, tensor in model.parameters.items()}
    if len(positions):
        points = replace(train, points=positions.astype(np.float32), colors=colors)
        new = initialise(points, opacity=config.initial_opacity, scale=config.initial_scale)
    model.begin(period, rows, new)
    means = model.parameters["means"].detach().cpu().numpy()
    spheres = enclose(means.astype(np.float64), config, extent)
    model.spheres = torch.from_numpy(spheres.astype(np.float32)).to(splats.means.device)


def compare(
    train: TrainingSet,
    index: int,
    render: Callable[[View, float], Prediction],
    period: int,
    config: CLSplatsConfig,
) -> Comparison:
    """A training view as the model shows it at an earlier period, beside its photo."""
    train.expect(range(index, len(train.views)))
    view, photo, mask = train.views[index], train.load_image(index), train.load_mask(index)
    prediction = render(view, period)
    assert prediction.depth is not None
    changed = changed_pixels(prediction.rgb, photo, mask, config)
    counts = np.ones_like(changed) if mask is None else mask
    depth = np.where(prediction.depth > 0, prediction.depth, np.inf)
    return Comparison(view, photo, counts, changed & counts, depth)


def vote(splats: Splats, found: Sequence[Comparison], config: CLSplatsConfig) -> Tensor:
    """Gaussians that have changed in most of the views that see them. bool [N]

    A view sees a Gaussian by what it adds to the image; that has changed there if the larger part
    of this is in changed pixels. A Gaussian behind others has no vote.

    Args:
        splats: The Gaussians; their colours do not matter. [N]
        found: Of the views.
        config: Says how many are most.
    """
    seen = torch.zeros(len(splats.means), device=splats.means.device)
    changed = torch.zeros_like(seen)
    for item in found:
        pixels = np.stack([item.counts, item.changed, item.changed], -1).astype(np.float32)
        weights = weights_in(
            splats,
            item.view,
            to_device(pixels, seen.device),
            near_plane=config.near_plane,
            antialiased=config.antialiased,
        )
        sees = weights[:, 0] > _SEEN
        seen += sees
        changed += sees & (weights[:, 1] > 0.5 * weights[:, 0])
    return changed > config.vote_share * seen


def new_points(
    splats: Splats,
    found: Sequence[Comparison],
    train: TrainingSet,
    config: CLSplatsConfig,
    generator: np.random.Generator,
) -> tuple[Array, NDArray[np.uint8]]:
    """Starting positions of new Gaussians, and their colours. [n, 3], [n, 3]

    Sparse points that the new period alone sees, and points drawn on the rays of changed pixels, in
    front of what the render shows there and away from its Gaussians. Those stay that lie in changed
    pixels in most of the views that see them.
    """
    period = train.views[0].period
    seen = train.point_periods
    fresh = seen[:, period] & ~seen[:, :period].any(1) & np.isfinite(train.points).all(1)
    drawn, colors = _draw(found, config, generator)
    means, scales = (t.detach().cpu().numpy() for t in (splats.means, splats.scales.amax(1)))
    if len(drawn) and len(means):
        distances, nearest = cKDTree(means).query(drawn)
        free = distances > scales[nearest]
        drawn, colors = drawn[free], colors[free]
    points = np.concatenate([train.points[fresh].astype(np.float64), drawn])
    colors = np.concatenate([train.colors[fresh], colors])
    hits, sights = np.zeros(len(points)), np.zeros(len(points))
    for item in found:
        hit, sight = _look(points, item)
        hits += hit
        sights += sight
    least = np.where(np.arange(len(points)) < fresh.sum(), config.vote_share, _CERTAIN)
    kept = (hits >= _HITS) & (hits > least * sights)
    return points[kept], colors[kept]


def _draw(
    found: Sequence[Comparison], config: CLSplatsConfig, generator: np.random.Generator
) -> tuple[Array, NDArray[np.uint8]]:
    """Points on rays of changed pixels, and the colours of the pixels. [n, 3], [n, 3]"""
    pixels = [np.argwhere(item.changed & np.isfinite(item.depth)) for item in found]
    counts = np.array([len(places) for places in pixels])
    if not (config.samples and counts.any()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    points, colors = [], []
    shares = generator.multinomial(config.samples, counts / counts.sum())
    for item, places, share in zip(found, pixels, shares, strict=True):
        if not share:
            continue
        y, x = places[generator.integers(len(places), size=share)].T
        depth = generator.uniform(_NEAREST, 1.0, share) * item.depth[y, x]
        K, pose = item.view.K, item.view.cam_from_world
        rays = ((x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(share))
        inside = depth[:, None] * np.stack(rays, -1) - pose[:3, 3]
        # No product of matrices: its bits depend on how it shares its work.
        points.append((inside[:, :, None] * pose[:3, :3]).sum(1))
        colors.append(item.photo[y, x])
    return np.concatenate(points), np.concatenate(colors)


def _look(points: Array, item: Comparison) -> tuple[Mask, Mask]:
    """Masks of the points in changed pixels of a view, and of those that it sees. [n], [n]"""
    K, pose = item.view.K, item.view.cam_from_world
    x, y, z = ((points[:, None] * pose[:3, :3]).sum(-1) + pose[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    inside = (z > 0) & (u >= 0) & (u < item.view.width) & (v >= 0) & (v < item.view.height)
    column, row = (np.where(inside, place, 0).astype(int) for place in (u, v))
    hit = inside & item.changed[row, column]
    hidden = z > _BEHIND * item.depth[row, column]
    return hit, hit | (inside & item.counts[row, column] & ~hidden)


def enclose(means: Array, config: CLSplatsConfig, extent: float) -> Array:
    """Spheres around clusters of points: centre and radius. [N, 3] -> [S, 4]

    Cells of a grid that touch are in one cluster.
    """
    if not len(means):
        return np.zeros((0, 4))
    edge = max(config.sphere_link * float(np.ptp(means, axis=0).max()), 1e-9)
    cells, cell = np.unique(np.floor(means / edge), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(cells), len(cells)))
    count, label = connected_components(links, directed=False)
    cluster, spheres = label[cell.ravel()], []
    for number in range(count):
        own = means[cluster == number]
        centre = own.mean(0)
        radius = np.quantile(np.linalg.norm(own - centre, axis=1), config.sphere_share)
        spheres.append([*centre, radius + config.sphere_margin * extent])
    return np.array(spheres)
