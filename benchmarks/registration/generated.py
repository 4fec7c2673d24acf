"""Registrations whose truth is known, without images: to calibrate the verdict, and to test it.

A city of boxes is seen by rings of cameras at every date, or from one side. Observations are
projections with noise; each period is a model of its own in a frame of its own, and is brought to
the first period by what matches between them, as the route ``separate`` does. What can go wrong
there can be asked for: few matches, matches in one spot, matches of repeated structure that agree
with each other and are all wrong, gross outliers, a period deformed by drift, alignment by GPS
alone, or a plain error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.geodesy import Georeference
from chronoscene.registration.quality.misalignment import measure, transfers
from chronoscene.registration.quality.rays import TrackRays, place, rays_at
from chronoscene.registration.result import HeldOutTracks, Registered
from chronoscene.scene import Camera
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.scene.similarity import Sim3, fit_robustly
from chronoscene.scene.tracks import track_owners

SIDE = 120.0
"""Edge of the city, metres."""

CAMERA = Camera(1, "PINHOLE", 480, 360, (400.0, 400.0, 240.0, 180.0))


@dataclass(frozen=True, slots=True)
class CaseSettings:
    """Settings of a generated registration. Lengths are in metres, angles in degrees."""

    periods: int = 2
    views: int = 14
    """Images of each period."""
    points: int = 3000
    """Points of each period that did not change."""
    changed: float = 0.3
    """Further points of each period alone, as a share of them."""
    ties: int = 300
    """Points matched between a period and the first one (or the one before, in a chain)."""
    arc: float | None = None
    """Length of the arc on which cameras stand beside the city; None for a ring around it."""
    chain: bool = False
    """True if a period matches only the one before it."""
    cluster: float | None = None
    """Radius in which all matches lie; None for everywhere."""
    outliers: float = 0.05
    """Share of the matches that are wrong, each in its own way."""
    repeated: float = 0.0
    """Share of the matches that are wrong by one and the same step."""
    step: float = 6.0
    """Length of the step, in metres."""
    held_out: float = 0.15
    """Share of the matched tracks that is held out."""
    noise: float = 0.4
    """Standard deviation of an observation, pixels."""
    doming: float = 0.0
    """Height by which the edge of the scene rises in the periods after the first."""
    rotation: float = 0.0
    """Error that is added to the last period."""
    shift: float = 0.0
    scale: float = 0.0
    """Added to the scale of 1."""
    by_gps: bool = False
    """True if the last period is aligned by GPS instead of matches."""
    gps_noise: float | None = 3.0
    """Standard deviation of each GPS position; None for no GPS."""
    gps_bias: float = 1.5
    """Standard deviation of the offset that a period's positions share."""
    gps_gross: float = 0.1
    """Share of the positions that is 30 to 300 m off."""
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Generated:
    """A registration and the truth."""

    model: Registered
    truth: Array
    """cam_from_world of its images. [N, 4, 4]"""


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """Observations by all images (O observations)."""

    track: Ints
    image: Ints
    xy: Array


def generate_case(settings: CaseSettings) -> Generated:
    """Make a registration with these settings. Equal settings give equal arrays."""
    rng = np.random.default_rng(settings.seed)
    stable = _city(rng, settings.points)
    tied = _tied(rng, settings, stable)
    truth = np.concatenate([_cameras(rng, settings) for _ in range(settings.periods)])
    periods = np.repeat(np.arange(settings.periods), settings.views)
    sightings, of_two = _observe(rng, settings, stable, tied, truth, periods)
    out = of_two & (rng.random(len(of_two)) < settings.held_out)
    gps = _gps(rng, settings, camera_centre(truth), periods)
    # The errors of a bundle adjustment shrink with the baselines, as points determine both.
    precision = 1.0 if settings.arc is None else settings.arc / SIDE
    poses = _domed(_jittered(rng, truth, precision), truth, periods, stable, settings.doming)
    model = _empty(settings, poses, periods, gps)
    poses = _align(rng, settings, model, _part(sightings, ~out))
    model = replace(model, cam_from_world=poses)
    return Generated(_with_tracks(model, _part(sightings, ~out), _part(sightings, out)), truth)


def pose_errors(poses: Array, truth: Array, reference: Mask) -> tuple[Array, Array]:
    """Errors of poses after the frame has been fitted on some of them.

    The rotation of the frame is the mean of those of the reference cameras, its scale and place
    follow from their centres, so that a straight flight does not leave it open.

    Args:
        poses: Estimated cam_from_world. [N, 4, 4]
        truth: [N, 4, 4]
        reference: Cameras that define the frame. [N]

    Returns:
        rotation: Degrees. [N]
        centre: World units of the truth. [N]
    """
    turns = np.einsum("nji,njk->nik", truth[reference, :3, :3], poses[reference, :3, :3])
    u, _, vt = np.linalg.svd(turns.sum(axis=0))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    here, there = camera_centre(poses), camera_centre(truth)
    a = (here[reference] - here[reference].mean(axis=0)) @ rotation.T
    b = there[reference] - there[reference].mean(axis=0)
    scale = float((a * b).sum() / (a * a).sum())
    shift = there[reference].mean(axis=0) - scale * rotation @ here[reference].mean(axis=0)
    moved = Sim3(scale, rotation, shift).apply_to_pose(poses)
    relative = np.einsum("nij,nkj->nik", moved[:, :3, :3], truth[:, :3, :3])
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    sine = np.linalg.norm(relative - np.swapaxes(relative, 1, 2), axis=(1, 2)) / np.sqrt(8)
    distance = np.linalg.norm(camera_centre(moved) - there, axis=1)
    return np.degrees(np.arctan2(sine, cosine)), distance


def _city(rng: np.random.Generator, count: int) -> Array:
    """Points on rolling ground, walls and roofs. [count, 3]"""
    ground = rng.uniform(-SIDE / 2, SIDE / 2, (count // 3, 2))
    relief = 2 * np.sin(ground[:, 0] / 25) * np.cos(ground[:, 1] / 31)
    parts = [np.column_stack([ground, relief])]
    rest = count - len(ground)
    middle = rng.uniform(-SIDE / 2, SIDE / 2, (25, 2))
    size, height = rng.uniform(5, 12, (25, 2)), rng.uniform(6, 25, 25)
    box = rng.integers(0, 25, rest)
    u = rng.uniform(-0.5, 0.5, (rest, 3))
    face = rng.integers(0, 5, rest)
    for axis in (0, 1):
        for sign in (0, 1):
            u[face == 2 * axis + sign, axis] = sign - 0.5
    u[face == 4, 2] = 0.5
    walls = np.column_stack([u[:, :2] * size[box] + middle[box], (u[:, 2] + 0.5) * height[box]])
    return np.concatenate([*parts, walls])


def _tied(rng: np.random.Generator, settings: CaseSettings, points: Array) -> Mask:
    """Draw the points that are matched in each period. [P, T]"""
    tied = np.zeros((len(points), settings.periods), bool)
    for b in range(1, settings.periods):
        a = b - 1 if settings.chain else 0
        # A point of a chain is matched between two periods only.
        free = np.flatnonzero(~tied.any(axis=1)) if settings.chain else np.arange(len(points))
        if settings.cluster is not None:
            middle = points[rng.choice(free)]
            free = free[np.linalg.norm((points[free] - middle)[:, :2], axis=1) < settings.cluster]
        chosen = rng.choice(free, min(settings.ties, len(free)), replace=False)
        tied[chosen, a] = tied[chosen, b] = True
    return tied


def _cameras(rng: np.random.Generator, settings: CaseSettings) -> Array:
    """Cameras around the city, or on an arc, that look at places near its middle. [V, 4, 4]"""
    views, arc = settings.views, settings.arc
    angle = 2 * np.pi * (np.arange(views) + rng.uniform(0, 1)) / views
    radius = rng.uniform(60, 80) + rng.normal(0, 4, views)
    height = rng.uniform(50, 75) + rng.normal(0, 4, views)
    if arc is not None:
        angle = arc / 90 * rng.uniform(-0.5, 0.5, views)
        radius, height = 90 + rng.normal(0, 0.1 * arc, views), 45 + rng.normal(0, 0.1 * arc, views)
    centre = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    target = np.column_stack([rng.normal(0, 8, (views, 2)), np.zeros(views)])
    forward = target - centre
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    shift = -np.einsum("nij,nj->ni", rotation, centre)
    return np.stack(
        [pose_from_rotation_translation(r, t) for r, t in zip(rotation, shift, strict=True)]
    )


def _observe(
    rng: np.random.Generator,
    settings: CaseSettings,
    stable: Array,
    tied: Mask,
    poses: Array,
    periods: Ints,
) -> tuple[_Sightings, Mask]:
    """Return the tracks of all images, and a mask of those that two periods see."""
    step = rng.normal(size=3) * [1.0, 1.0, 0.0]
    step *= settings.step / np.linalg.norm(step)
    found: list[tuple[Ints, Ints, Array]] = []
    total = len(stable) * (settings.periods + 1)
    for p in range(settings.periods):
        own = _city(rng, int(settings.changed * len(stable)))
        where = stable.copy()
        if p > 0:
            kind = rng.random(len(stable))
            fooled = tied[:, p] & (kind < settings.repeated)
            where[fooled] += step
            lost = tied[:, p] & (kind > 1 - settings.outliers)
            where[lost] += rng.normal(0, 15, (int(lost.sum()), 3))
        key = np.arange(len(stable)) * (settings.periods + 1)
        key += np.where(tied[:, p], settings.periods, p)
        key = np.concatenate([key, total + np.arange(len(own))])
        total += len(own)
        for i in np.flatnonzero(periods == p):
            seen, xy = _see(rng, poses[i], np.concatenate([where, own]), settings.noise)
            found.append((key[seen], np.full(len(xy), i), xy))
    keys, image, xy = (np.concatenate(x) for x in zip(*found, strict=True))
    _, track = np.unique(keys, return_inverse=True)
    order = np.lexsort([image, track])
    track, image, xy = track[order], image[order], xy[order]
    seen_in = np.zeros((track.max() + 1, settings.periods), bool)
    seen_in[track, periods[image]] = True
    return _Sightings(track, image, xy), seen_in.sum(axis=1) > 1


def _see(rng: np.random.Generator, pose: Array, points: Array, noise: float) -> tuple[Ints, Array]:
    """Points that an image sees, most of them, and where."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    f, _, cx, cy = CAMERA.params
    xy = f * local[:, :2] / local[:, 2:] + [cx, cy]
    inside = (local[:, 2] > 1) & (xy > 0).all(axis=1) & (xy < [480, 360]).all(axis=1)
    seen = np.flatnonzero(inside & (rng.random(len(points)) < 0.4))
    return seen, xy[seen] + rng.normal(0, noise, (len(seen), 2))


def _part(sightings: _Sightings, tracks: Mask) -> _Sightings:
    keep = tracks[sightings.track]
    return _Sightings(sightings.track[keep], sightings.image[keep], sightings.xy[keep])


def _jittered(rng: np.random.Generator, poses: Array, precision: float) -> Array:
    """Poses as a bundle adjustment leaves them: a hundredth of a degree and two centimetres off.

    Args:
        rng: Source of the errors.
        poses: True ones. [N, 4, 4]
        precision: Factor of both.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.01 * precision, (len(poses), 3))))
    turn = turn.as_matrix()
    out = poses.copy()
    centre = camera_centre(poses) + rng.normal(0, 0.02 * precision, (len(poses), 3))
    out[:, :3, :3] = turn @ poses[:, :3, :3]
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], centre)
    return out


def _domed(poses: Array, truth: Array, periods: Ints, points: Array, height: float) -> Array:
    """Poses of later periods in a domed world: dz = height (r / (SIDE / 2))^2.

    Cameras rise with it and turn to the displaced points: what bundle adjustment makes of slightly
    wrong lens distortion.
    """
    from scipy.spatial.transform import Rotation

    def raised(x: Array) -> Array:
        lift = height * (x[:, :2] ** 2).sum(axis=1) / (SIDE / 2) ** 2
        return np.asarray(x + lift[:, None] * [0.0, 0.0, 1.0])

    out = poses.copy()
    for i in np.flatnonzero(periods > 0) if height else ():
        local = points[::10] @ truth[i, :3, :3].T + truth[i, :3, 3]
        seen = local[:, 2] > 1
        centre = raised(camera_centre(poses[i])[None])[0]
        there = raised(points[::10])[seen] - centre
        here = local[seen] / np.linalg.norm(local[seen], axis=1, keepdims=True)
        there /= np.linalg.norm(there, axis=1, keepdims=True)
        out[i, :3, :3] = Rotation.align_vectors(here, there)[0].as_matrix()
        out[i, :3, 3] = -out[i, :3, :3] @ centre
    return out


def _gps(rng: np.random.Generator, settings: CaseSettings, centres: Array, periods: Ints) -> Array:
    if settings.gps_noise is None:
        return np.full_like(centres, np.nan)
    bias = rng.normal(0, settings.gps_bias, (settings.periods, 3))[periods]
    gps = centres + bias + rng.normal(0, settings.gps_noise, centres.shape)
    gross = rng.random(len(centres)) < settings.gps_gross
    far = rng.normal(size=centres.shape)
    far *= rng.uniform(30, 300, (len(far), 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    return np.asarray(gps + np.where(gross[:, None], far, 0.0))


def _empty(settings: CaseSettings, poses: Array, periods: Ints, gps: Array) -> Registered:
    return Registered(
        names=tuple(f"t{p}/{i:04d}.jpg" for i, p in enumerate(periods)),
        periods=periods,
        cam_from_world=poses,
        cameras=(CAMERA,) * len(periods),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        track_start=np.zeros(1, np.int64),
        track_image=np.zeros(0, np.int64),
        track_xy=np.zeros((0, 2)),
        unregistered={},
        unregistered_periods={},
        route="separate",
        gps_enu=gps,
        gps_used=np.asarray(np.isfinite(gps).all(axis=1)),
        georeference=None
        if settings.gps_noise is None
        else Georeference(51.0, 11.0, 200.0, "as stated"),
        num_periods=settings.periods,
        labels=tuple(str(2016 + p) for p in range(settings.periods)),
        dates=tuple(str(2016 + p) for p in range(settings.periods)),
        held_out_tracks=HeldOutTracks.empty(),
        images_root="",
    )


def _starts(track: Ints) -> Ints:
    first = np.flatnonzero(np.concatenate([[True], track[1:] != track[:-1]]))
    return np.append(first, len(track))


def _align(
    rng: np.random.Generator, settings: CaseSettings, model: Registered, seen: _Sightings
) -> Array:
    """Bring each period from a frame of its own to another; then add the error asked for."""
    poses = model.cam_from_world.copy()
    last = settings.periods - 1
    for b in range(1, settings.periods):
        a = b - 1 if settings.chain else 0
        mine = model.periods == b
        own = _random_frame(rng).apply_to_pose(poses[mine])
        poses[mine] = own
        if settings.by_gps and b == last:
            found = _by_gps(own, model.gps_enu[mine])
        else:
            found = _by_ties(replace(model, cam_from_world=poses), seen, a, b)
        if found is None:  # nothing to go by: a frame as good as any other
            found = _random_frame(rng)
        poses[mine] = found.apply_to_pose(own)
        if b == last:
            poses[mine] = _error(rng, settings, poses[mine]).apply_to_pose(poses[mine])
    return poses


def _random_frame(rng: np.random.Generator) -> Sim3:
    from scipy.spatial.transform import Rotation

    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return Sim3(float(np.exp(rng.normal(0, 0.5))), turn, rng.normal(0, 50, 3))


def _by_gps(poses: Array, gps: Array) -> Sim3 | None:
    fitted = fit_robustly(camera_centre(poses), gps)
    return None if fitted is None else fitted[0].to_sim3()


def _by_ties(model: Registered, seen: _Sightings, a: int, b: int) -> Sim3 | None:
    """Robust similarity between matched points, refined on their reprojection."""
    rays = rays_at(model, track_owners(_starts(seen.track)), seen.image, seen.xy).finite()
    rays = rays.where(np.isin(model.periods[rays.image], (a, b)))
    moved, placed_a, placed_b = transfers(rays, model.periods, a, b)
    found, slot = placed_b.find(placed_a.track)
    if found.sum() < 4:
        return None
    fitted = fit_robustly(placed_b.xyz[slot], placed_a.xyz[found])
    if fitted is None:
        return None
    first = fitted[0].to_sim3()
    poses = model.cam_from_world.copy()
    mine = model.periods == b
    poses[mine] = first.apply_to_pose(poses[mine])
    moved, placed_a, placed_b = transfers(replace_poses(rays, poses), model.periods, a, b)
    refined = measure(moved, placed_a, placed_b, camera_centre(poses[mine]), core=0.5)
    if refined is None:
        return first
    return refined.similarity.inverse() @ first


def replace_poses(rays: TrackRays, poses: Array) -> TrackRays:
    """Return the observations with the poses of moved cameras."""
    return replace(rays, pose=poses[rays.image])


def _error(rng: np.random.Generator, settings: CaseSettings, poses: Array) -> Sim3:
    """The error that was asked for, about the middle of the cameras where they stand on an arc."""
    from scipy.spatial.transform import Rotation

    axis, way = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(settings.rotation) * axis / np.linalg.norm(axis))
    grow, rotation = 1 + settings.scale, turn.as_matrix()
    shift = settings.shift * way / np.linalg.norm(way)
    if settings.arc is not None:  # so that a scale moves points and no camera
        middle = camera_centre(poses).mean(axis=0)
        shift = shift + middle - grow * rotation @ middle
    return Sim3(grow, rotation, shift)


def _with_tracks(model: Registered, seen: _Sightings, held: _Sightings) -> Registered:
    """Place the points by all their images; what does not fit is split into its periods."""
    rays = rays_at(model, track_owners(_starts(seen.track)), seen.image, seen.xy).finite()
    order = np.repeat(np.arange(len(np.unique(seen.track))), np.diff(_starts(seen.track)))
    fits = np.isin(order, place(rays).track)
    key = order * (model.num_periods + 1)
    key += np.where(fits, model.num_periods, model.periods[seen.image])
    by_key = np.lexsort([seen.image, key])
    key, image, xy = key[by_key], seen.image[by_key], seen.xy[by_key]
    start = _starts(key)
    placed = place(rays_at(model, track_owners(start), image, xy).finite())
    number = np.repeat(np.arange(len(start) - 1), np.diff(start))
    kept = np.isin(number, placed.track)
    model = replace(
        model,
        points=placed.xyz,
        colors=np.full((len(placed.xyz), 3), 128, np.uint8),
        track_start=_starts(number[kept]) if kept.any() else np.zeros(1, np.int64),
        track_image=image[kept],
        track_xy=xy[kept],
    )
    if not len(held.track):
        return model
    tracks = HeldOutTracks(_starts(held.track), held.image, held.xy)
    return replace(model, held_out_tracks=tracks)
