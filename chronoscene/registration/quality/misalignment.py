"""Misalignment of two periods, measured on tracks that took no part in the estimation.

A track is placed by its images of one period alone and projected into its images of the other, in
both directions. The similarity that would bring the periods together, and how surely it is known,
follow from the residuals: a registration is as good as the largest motion they do not exclude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.quality.rays import PlacedPoints, TrackRays, place, project
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3, fit_robustly

MIN_TRACKS = 12  # Fewer tracks do not determine seven unknowns and their spread

SPENT = 9
"""Tracks that a covariance costs: seven unknowns were fitted, and the t distribution of what is
left has a variance from two more on."""

STEPS = 12
DRAWS = 400  # Random motions that give the spread of an angle or a distance

GROSS_PIXELS = 20.0
"""Median residual above which the search starts from the positions of the points."""

CORE = 0.25
"""Share of the smallest residuals that gives the noise where false ties may be many."""

CONTRADICTS = 0.99  # Probability within which two estimates of seven parameters differ

MANY = 1e9  # Degrees of freedom of a covariance that is known

MAX_SEEN = 500  # Observations by which a change in depth is measured

NOISE_FLOOR = 0.1  # Pixels: no feature is located better, even if a few residuals are smaller


@dataclass(frozen=True, slots=True, eq=False)
class Transfers:
    """Points placed by one period, with the rays of another (O observations)."""

    rays: TrackRays
    xyz: Array
    """[O, 3]"""
    covariance: Array
    """Covariance of the points, for observations of one pixel. [O, 3, 3]"""
    backward: Mask
    """True if the point was placed by the later of the two periods. [O]"""

    def __len__(self) -> int:
        return len(self.rays)

    def where(self, mask: Mask) -> Transfers:
        """Some of the observations."""
        return Transfers(
            self.rays.where(mask), self.xyz[mask], self.covariance[mask], self.backward[mask]
        )


@dataclass(frozen=True, slots=True)
class Interval:
    """Non-negative quantity with its 95% interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Misalignment:
    """Similarity between two periods, measured on tracks; the identity if they are aligned."""

    tracks: int
    """Tracks that agree with it."""
    similarity: Sim3
    """Brings the points of the first period to where the second one sees them."""
    rotation: Interval
    """Degrees."""
    shift: Interval
    """Median displacement of the cameras of both periods, or change in the depth of the points that
    they see if that is larger, in world units."""
    motion: Motion
    """The estimate again, with its covariance."""
    noise: float = 0.0
    """Median residual of the observations that agree with it, in units of what the placing of the
    point leaves open: pixels of one observation. What a deformed period adds to it stays."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Seven parameters of a small similarity about a point, as of `generators`."""

    step: Array
    """[7]"""
    covariance: Array
    """[7, 7]"""
    middle: Array
    """[3]"""
    centres: Array
    """Cameras whose displacement is measured. [C, 3]"""
    seen: Array
    """Points and the cameras that see them, whose depth is measured. [2, O, 3]"""
    freedom: float = MANY
    """Degrees of freedom of the covariance."""

    @classmethod
    def none(cls, xyz: Array, cameras: Array, centres: Array) -> Motion:
        """The identity, in a form that takes the parameters of another estimate.

        Args:
            xyz: Points whose depth is measured. [O, 3]
            cameras: Those that see them. [O, 3]
            centres: Cameras whose displacement is measured. [C, 3]
        """
        middle = np.median(xyz, axis=0)
        return cls(np.zeros(7), np.eye(7), middle, centres, np.stack([xyz, cameras]))

    def similarity(self, step: Array) -> Sim3:
        """Motion with other parameters."""
        return _compose(step, Sim3.identity(), self.middle)

    def _displacements(self, moves: _Moves) -> Array:
        """Displacements of cameras or points by similarities, see `Misalignment.shift`. [D]"""
        moved = np.linalg.norm(moves.apply(self.centres) - self.centres, axis=2)
        points, cameras = self.seen
        rays = points - cameras
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
        depth = np.abs(np.einsum("dni,ni->dn", moves.apply(points) - points, rays))
        return np.asarray(np.maximum(np.median(moved, axis=1), np.median(depth, axis=1)))

    def about(self, middle: Array) -> Motion:
        """The same motion with parameters about another point."""
        moved = np.eye(7)
        moved[:3] = generators((middle - self.middle)[None])[0]
        step, covariance = moved @ self.step, moved @ self.covariance @ moved.T
        return replace(self, step=step, covariance=covariance, middle=middle)

    def joined(self, other: Motion) -> Motion | None:
        """Both estimates weighted by their information; None if they contradict each other."""
        from scipy.stats import f

        other = other.about(self.middle)
        gap = self.step - other.step
        freedom = min(self.freedom, other.freedom)
        limit = 7 * float(f.ppf(CONTRADICTS, 7, freedom)) * (1 - 2 / freedom)  # Hotelling 1931
        if gap @ np.linalg.solve(self.covariance + other.covariance, gap) > limit:
            return None
        mine, its = np.linalg.inv(self.covariance), np.linalg.inv(other.covariance)
        covariance = np.linalg.inv(mine + its)
        return replace(
            self, step=covariance @ (mine @ self.step + its @ other.step), covariance=covariance
        )

    def intervals(self, similarity: Sim3 | None = None) -> tuple[Interval, Interval]:
        """Rotation and displacement of an estimate with this covariance."""
        similarity = self.similarity(self.step) if similarity is None else similarity
        rng = np.random.default_rng(0)
        steps = rng.multivariate_normal(np.zeros(7), self.covariance, DRAWS, method="eigh")
        drawn = _composed(steps, similarity, self.middle)
        noise = _composed(steps, Sim3.identity(), self.middle)
        found = _one(similarity)
        return (
            _interval(*(rotation_angle(moves.rotation) for moves in (found, drawn, noise))),
            _interval(*(self._displacements(moves) for moves in (found, drawn, noise))),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Moves:
    """Several similarities, as `Sim3` is one: [D], [D, 3, 3], [D, 3]."""

    scale: Array
    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """Transform points by each of them. [N, 3] -> [D, N, 3]"""
        linear = self.scale[:, None, None] * self.rotation
        return np.asarray(points @ linear.transpose(0, 2, 1) + self.translation[:, None])


def _one(similarity: Sim3) -> _Moves:
    return _Moves(
        np.array([similarity.scale]), similarity.rotation[None], similarity.translation[None]
    )


def transfers(
    rays: TrackRays,
    period: Ints,
    a: int,
    b: int,
    placed: tuple[PlacedPoints, PlacedPoints] | None = None,
) -> tuple[Transfers, PlacedPoints, PlacedPoints]:
    """Transfer tracks between two periods in both directions; also the points of each period.

    Args:
        rays: Observations of tracks.
        period: Of each image. [N]
        a: Earlier period.
        b: Later period.
        placed: The points that a and b place, if they are known.
    """
    of_a, of_b = rays.where(period[rays.image] == a), rays.where(period[rays.image] == b)
    placed_a, placed_b = placed or (place(of_a), place(of_b))
    forward, backward = _seen(placed_a, of_b), _seen(placed_b, of_a)
    both = Transfers(
        rays=TrackRays.join(forward[0], backward[0]),
        xyz=np.concatenate([forward[1], backward[1]]),
        covariance=np.concatenate([forward[2], backward[2]]),
        backward=np.repeat([False, True], [len(forward[0]), len(backward[0])]),
    )
    return both, placed_a, placed_b


def _seen(placed: PlacedPoints, rays: TrackRays) -> tuple[TrackRays, Array, Array]:
    found, slot = placed.find(rays.track)
    return rays.where(found), placed.xyz[slot], placed.covariance[slot]


def transfer_errors(moved: Transfers) -> tuple[Array, Array, Array]:
    """Residual in pixels, its expected standard deviation for noise of one pixel, and metres.

    Returns:
        error: Inf behind the camera. [O]
        expected: Grows where a point is placed badly: of the projected point and the pixel. [O]
        distance: The residual at the depth of the point, in world units. [O]
    """
    residual, jacobian, depth = project(moved.rays, moved.xyz)
    error = np.linalg.norm(residual, axis=1)
    distance = np.where(depth > 0, error * depth / moved.rays.focal.mean(axis=1), np.inf)
    error = np.where(np.isfinite(error), error, np.inf)
    return error, np.sqrt(transfer_variance(jacobian, moved.covariance)), distance


def transfer_variance(jacobian: Array, covariance: Array) -> Array:
    """Mean variance per axis of a transferred point and its observation, for unit noise. [O]"""
    spread = np.einsum("nki,nij,nkj->n", jacobian, covariance, jacobian)
    return np.asarray(1.0 + np.nan_to_num(spread, nan=1e12) / 2)


def measure(
    moved: Transfers,
    placed_a: PlacedPoints,
    placed_b: PlacedPoints,
    centres: Array,
    core: float = CORE,
) -> Misalignment | None:
    """Estimate the similarity between two periods, with its uncertainty.

    Weights are those of a Cauchy distribution; the spread is that of a sandwich estimator whose
    groups are tracks and images, so that ten images of one point do not count as ten points, nor
    the points of one image as independent of its pose.

    Args:
        moved: From `transfers`.
        placed_a: Points as the first period places them.
        placed_b: Points as the second period places them.
        centres: Cameras whose motion is reported. [C, 3]
        core: Share of the smallest residuals that gives the noise.

    Returns:
        None with fewer than `MIN_TRACKS` tracks, or if they do not determine the motion.

    Source: Huber 1967 (sandwich); Cameron, Gelbach and Miller 2011 (two kinds of groups).
    """
    if len(np.unique(moved.rays.track)) < MIN_TRACKS:
        return None
    middle = np.median(moved.xyz, axis=0)
    similarity = _begin(moved, placed_a, placed_b)
    for _ in range(STEPS):
        residual, jacobian = _residuals(moved, similarity, middle)
        weight, _ = _weights(residual, jacobian[1], core)
        normal, gradient = _sum(residual, jacobian[0], weight)
        try:
            step: Array = np.asarray(-np.linalg.solve(normal, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        similarity = _compose(step, similarity, middle)
        if np.abs(step).max() < 1e-10:
            break
    return _describe(moved, similarity, middle, centres, core)


def _begin(moved: Transfers, placed_a: PlacedPoints, placed_b: PlacedPoints) -> Sim3:
    """Start from the identity, or from a fit to the points if the periods are far apart."""
    error = transfer_errors(moved)[0]
    if np.median(error) < GROSS_PIXELS:
        return Sim3.identity()
    found, slot = placed_b.find(placed_a.track)
    if found.sum() < MIN_TRACKS:
        return Sim3.identity()
    fitted = fit_robustly(placed_a.xyz[found], placed_b.xyz[slot])
    return Sim3.identity() if fitted is None else fitted[0].to_sim3()


def _residuals(
    moved: Transfers, similarity: Sim3, middle: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Residuals under a similarity; their derivatives by its seven parameters and variances."""
    inverse = similarity.inverse()
    back = moved.backward
    xyz = np.where(back[:, None], inverse.apply(moved.xyz), similarity.apply(moved.xyz))
    residual, by_point, _ = project(moved.rays, xyz)
    # Left perturbation: S <- exp(d) S. The inverse changes as S^-1 exp(-d).
    at = np.where(back[:, None], moved.xyz, xyz) - middle
    by_motion = generators(at)
    linear = -inverse.scale * inverse.rotation
    by_motion = np.where(back[:, None, None], linear @ by_motion, by_motion)
    variance = transfer_variance(by_point, moved.covariance)
    return residual, (np.einsum("nki,nij->nkj", by_point, by_motion), variance)


def generators(x: Array) -> Array:
    """Derivative of ``t + w x p + s p`` by (t, w, s) at points. [O, 3] -> [O, 3, 7]"""
    out = np.zeros((len(x), 3, 7))
    out[:, [0, 1, 2], [0, 1, 2]] = 1.0
    out[:, 0, 4], out[:, 0, 5] = x[:, 2], -x[:, 1]
    out[:, 1, 3], out[:, 1, 5] = -x[:, 2], x[:, 0]
    out[:, 2, 3], out[:, 2, 4] = x[:, 1], -x[:, 0]
    out[:, :, 6] = x
    return out


def _weights(residual: Array, variance: Array, core: float) -> tuple[Array, float]:
    """Weights of observations, zero behind the camera, and the noise in pixels per axis."""
    square = (residual**2).sum(axis=1) / variance
    seen = np.isfinite(square)
    # By the quantiles of a Rayleigh distribution, in standard deviations per axis.
    scale = np.sqrt(-2 * np.log(1 - core))
    noise = np.sqrt(np.quantile(square[seen], core)) / scale if seen.any() else 1.0
    noise = max(float(noise), NOISE_FLOOR)
    weight = 1.0 / (variance * noise**2 * (1.0 + square / (2.0 * noise) ** 2))
    return np.where(seen, np.nan_to_num(weight), 0.0), noise


def _sum(residual: Array, jacobian: Array, weight: Array) -> tuple[Array, Array]:
    residual, jacobian = np.nan_to_num(residual), np.nan_to_num(jacobian)
    normal = np.einsum("nki,n,nkj->ij", jacobian, weight, jacobian)
    return normal, np.einsum("nki,n,nk->i", jacobian, weight, residual)


def _compose(step: Array, similarity: Sim3, middle: Array) -> Sim3:
    """``exp(step)`` about a point, after a similarity."""
    moves = _composed(step[None], similarity, middle)
    return Sim3(float(moves.scale[0]), moves.rotation[0], moves.translation[0])


def _composed(steps: Array, similarity: Sim3, middle: Array) -> _Moves:
    """`_compose` of each of several steps. [D, 7]"""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(steps[:, 3:6]).as_matrix()
    grow = np.exp(np.clip(steps[:, 6], -1.0, 1.0))
    linear = grow[:, None, None] * turn
    return _Moves(
        grow * similarity.scale,
        turn @ similarity.rotation,
        linear @ (similarity.translation - middle) + middle + steps[:, :3],
    )


def _describe(
    moved: Transfers, similarity: Sim3, middle: Array, centres: Array, core: float
) -> Misalignment | None:
    residual, (jacobian, variance) = _residuals(moved, similarity, middle)
    weight, noise = _weights(residual, variance, core)
    finite = np.nan_to_num(residual), np.nan_to_num(jacobian)
    covariance = _sandwich(moved.rays, *finite, weight, _bread(*finite, weight))
    if covariance is None:
        return None
    some = slice(None, None, len(moved) // MAX_SEEN + 1)
    motion = Motion(
        step=_parameters(similarity, middle),
        covariance=covariance,
        middle=middle,
        centres=centres,
        seen=np.stack([moved.xyz[some], camera_centre(moved.rays.pose[some])]),
        freedom=len(np.unique(moved.rays.track)) - 7,
    )
    error = np.linalg.norm(residual, axis=1) / np.sqrt(variance)
    agreeing = error < 3 * noise
    tracks = len(np.unique(moved.rays.track[agreeing]))
    return Misalignment(
        tracks, similarity, *motion.intervals(similarity), motion, _usual(error, 3 * noise)
    )


def _usual(error: Array, reach: float) -> float:
    """Median of errors within three deviations, of a Rayleigh distribution with that median."""
    median = 0.0
    for _ in range(5):
        inner = error[error < reach]
        median = float(np.median(inner)) if len(inner) else median
        reach = 3 * median / np.sqrt(2 * np.log(2))
    return median


def _parameters(similarity: Sim3, middle: Array) -> Array:
    """Inverse of `_compose`, after the identity. [7]"""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(similarity.rotation).as_rotvec()
    shift = similarity.apply(middle) - middle
    return np.concatenate([shift, turn, [np.log(similarity.scale)]])


def _bread(residual: Array, jacobian: Array, weight: Array) -> Array:
    """Derivative of the weighted sum of residuals by the seven parameters. [7, 7]

    Weights fall with the residual r, ``w = 1 / (v + r^2 / 4)`` for a variance v, so that one that
    grows by dr pulls by less than ``w dr`` more: by ``w (I - w r r^T / 2) dr``.

    Args:
        residual: [O, 2]
        jacobian: [O, 2, 7]
        weight: [O]
    """
    normal, _ = _sum(residual, jacobian, weight)
    along = np.einsum("nki,nk->ni", jacobian, residual)
    curved = normal - np.einsum("ni,n,nj->ij", along, weight**2 / 2, along)
    # Where almost all is false, no maximum is near, and nothing is certain anyway.
    return np.asarray(curved if np.linalg.eigvalsh(curved)[0] > 0 else normal)


def _sandwich(
    rays: TrackRays, residual: Array, jacobian: Array, weight: Array, normal: Array
) -> Array | None:
    """Covariance of the seven parameters, grouped by track, and by image.

    Observations of a track share the error of its point, those of an image that of its pose.
    """
    from scipy.linalg import eigh

    score = np.einsum("nki,n,nk->ni", jacobian, weight, residual)
    sums, by_image = _grouped(score, rays.track), _grouped(score, rays.image)
    groups = len(sums)
    if groups <= SPENT or np.linalg.cond(normal) > 1e16:
        return None
    meat = sums.T @ sums * groups / (groups - SPENT)
    try:
        shared, axes = eigh(by_image.T @ by_image - score.T @ score, meat)
    except np.linalg.LinAlgError:
        return None
    # A pose errs where points are seen, and as much where they are placed by the same image.
    some = meat @ axes * np.sqrt(4 * np.maximum(shared, 0.0))
    bread = np.linalg.inv(normal)
    covariance = bread @ (meat + some @ some.T) @ bread
    # The noise of the pixels alone is a lower bound: few tracks can agree by chance.
    size = float(np.trace(covariance / np.maximum(np.diag(bread), 1e-300)[:, None])) / 7
    return np.asarray((1.0 / size if 0 < size < 1 else 1.0) * covariance)


def _grouped(score: Array, group: Ints) -> Array:
    """Sums over groups. [O, 7] -> [G, 7]"""
    _, slot = np.unique(group, return_inverse=True)
    return np.stack([np.bincount(slot, column) for column in score.T], axis=1)


def _interval(estimate: Array, drawn: Array, noise: Array) -> Interval:
    """Interval of a non-negative quantity; its lower end is the excess over noise alone.

    Args:
        estimate: [1]
        drawn: Of motions about the estimate. [D]
        noise: Of motions about none. [D]
    """
    value, high = float(estimate[0]), float(np.percentile(drawn, 97.5))
    return Interval(
        value, low=max(0.0, value - float(np.percentile(noise, 95))), high=max(value, high)
    )


def rotation_angle(rotation: Array) -> Array:
    """Angles of rotations in degrees, exact for small ones too. [..., 3, 3] -> [...]"""
    axis = rotation[..., [2, 0, 1], [1, 2, 0]] - rotation[..., [1, 2, 0], [2, 0, 1]]
    cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=-1), cosine))
