"""The task ``resection``: photos with known cameras from surveyed points. Worker process only.

Each photo is placed by three points or more; where three leave several poses, its matches with
photos that are placed already decide. All are then adjusted together, with the control weighted by
its accuracy, clicked tie points and matched features. Features that see no parallax (a camera that
stays in its place) have no depth, but they tie the directions of the photos to each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, islice
from typing import Any

import cv2
import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import RegistrationError
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.control.adjustment import adjust_with_control
from chronoscene.registration.control.precision import standard_deviations
from chronoscene.registration.features.database import keypoints_of, verified_matches
from chronoscene.registration.features.holdout import build_tracks
from chronoscene.registration.reconstruct.consistency import Matches, agreeing_matches
from chronoscene.registration.reconstruct.mapping import Task, drop_bad
from chronoscene.registration.reconstruct.models import image_pose, known_images, set_pose
from chronoscene.scene.tracks import intersect_rays

MAX_TRIPLES = 100  # Of control points, by which a photo is placed
GROSS_PIXELS = 20.0  # A click that is further off does not count
MAX_TRACKS = 2000  # Of features, that tie the photos
SAME = 1e-3  # Difference of the rotation matrices of two poses that count as one
MIN_AGREEMENT = 0.5  # Share of the matches that must agree with one of several poses
MAX_LEFT_OUT = 20  # Control points that are left out one at a time


def resect(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Place photos by control, adjust them, and estimate how well all is known.

    Arguments: ``database``, ``photos``, ``control`` (see `adjust_with_control`), ``ties``
    (likewise, with ``xyz`` and ``sigma`` null), ``out``, ``scratch``, ``threads``.

    Returns:
        That of `Task.finish`, with ``deviations`` of the poses (see `standard_deviations`) and
        ``left_out``: the place of each control point in an adjustment to which its coordinates are
        unknown, and the standard deviations of that; null where it is undetermined.
    """
    task = Task.start(arguments, report)
    model = known_images(task.database)
    names, matches = verified_matches(task.database)
    _place_all(model, arguments["control"], matches, task)
    _add_tracks(model, arguments["control"], matches, task)
    control, ties = (_placed(model, arguments[k]) for k in ("control", "ties"))
    start = pycolmap.Reconstruction(model)
    report("adjusting", 0, 1)
    every = [*control, *ties]
    ids = adjust_with_control(model, every, constant_cameras=True, threads=task.threads)
    deviations, _ = standard_deviations(model, every, ids)
    drop_bad(model)
    if not deviations:
        task.remarks.append("the control does not determine all poses")
    left_out = {}
    for i, point in enumerate(control[:MAX_LEFT_OUT]):
        report("leave-one-out", i, len(control))
        others = [p if p is not point else dict(p) | {"sigma": None} for p in control]
        again = pycolmap.Reconstruction(start)
        left_out[point["name"]] = _without(again, point["name"], [*others, *ties], task.threads)
    placed = {str(model.images[i].name) for i in model.reg_image_ids()}
    task.remarks.append(f"{len(placed)} of {len(names)} photos placed by {len(control)} points")
    return task.finish(model, is_georeferenced=True, deviations=deviations, left_out=left_out)


def _placed(model: pycolmap.Reconstruction, points: Sequence[Any]) -> list[dict[str, Any]]:
    """Points with their clicks in photos that have poses; ties get a place between their rays."""
    posed = {str(model.images[i].name) for i in model.reg_image_ids()}
    found = []
    for point in points:
        clicks = [c for c in point["clicks"] if c[0] in posed]
        xyz = point["xyz"] or _intersect(model, clicks)
        if clicks and xyz is not None:
            found.append(dict(point) | {"clicks": clicks, "xyz": list(xyz)})
    return found


def _place_all(
    model: pycolmap.Reconstruction, control: Sequence[Any], matches: Matches, task: Task
) -> None:
    """Place the photos with the fewest possible poses first."""
    xyz = {str(p["name"]): np.array(p["xyz"]) for p in control}
    clicks: dict[str, list[tuple[str, Array]]] = {}
    for point in control:
        for name, x, y in point["clicks"]:
            clicks.setdefault(name, []).append((str(point["name"]), np.array([x, y])))
    waiting = {}
    for image_id, image in model.images.items():
        mine = clicks.get(str(image.name), [])
        world = np.array([xyz[name] for name, _ in mine]).reshape(-1, 3)
        pixels = np.array([xy for _, xy in mine]).reshape(-1, 2)
        waiting[image_id] = poses_of(model.cameras[image.camera_id], world, pixels)
    for image_id in sorted(waiting, key=lambda i: (len(waiting[i]), i)):
        poses = waiting[image_id]
        name = str(model.images[image_id].name)
        if not poses:
            task.remarks.append(f"{name}: not placed; three clicked control points are needed")
            continue
        chosen: Array | None = poses[0]
        why = ""
        if len(poses) > 1:
            chosen, why = _choose(model, image_id, poses, matches)
        if chosen is None:
            task.remarks.append(f"{name}: not placed; three points allow {len(poses)} poses, and "
                                "no matches with other photos decide: click a fourth")  # fmt: skip
            continue
        set_pose(model, image_id, pycolmap.Rigid3d(chosen))
        task.remarks.extend([f"{name}: {why}"] if why else [])
    if not model.num_reg_images():
        raise RegistrationError(
            "resection", expected="photos with three clicked control points or more",
            found="none", todo="click more control points: chronoscene mark",
        )  # fmt: skip


def poses_of(camera: pycolmap.Camera, world: Array, pixels: Array) -> list[Array]:
    """Poses of a photo that its control points allow: one from four points on. [3, 4] each

    Args:
        camera: With its distortion.
        world: [N, 3]
        pixels: [N, 2]
    """
    if len(world) < 3:
        return []
    rays = np.asarray(camera.cam_from_img(pixels), np.float64)
    focal, centre = float(camera.mean_focal_length()), world.mean(axis=0)
    scored = []
    for rows in islice(combinations(range(len(world)), 3), MAX_TRIPLES):
        three = list(rows)
        _, turns, moves = cv2.solveP3P(
            (world - centre)[three], rays[three], np.eye(3), None, cv2.SOLVEPNP_AP3P
        )
        for turn, move in zip(turns, moves, strict=True):
            rotation = cv2.Rodrigues(turn)[0]
            local = (world - centre) @ rotation.T + move.T
            if np.isfinite(local).all() and (local[:, 2] > 0).all():
                error = np.linalg.norm(local[:, :2] / local[:, 2:] - rays, axis=1) * focal
                pose = np.column_stack([rotation, move.ravel() - rotation @ centre])
                scored.append((float(np.minimum(error, GROSS_PIXELS).sum()), pose))
    scored.sort(key=lambda found: found[0])
    if len(world) > 3:
        return [pose for _, pose in scored[:1]]
    different: list[Array] = []
    for _, pose in scored:
        if all(np.abs(pose[:, :3] - other[:, :3]).max() > SAME for other in different):
            different.append(pose)
    return different


def _choose(
    model: pycolmap.Reconstruction, image_id: int, poses: Sequence[Array], matches: Matches
) -> tuple[Array | None, str]:
    """The pose that most matches agree with; of equal ones that nearest to a photo they join."""
    posed = set(model.reg_image_ids())
    joined = {(a, b): rows for (a, b), rows in matches.items()
              if (a == image_id and b in posed) or (b == image_id and a in posed)}  # fmt: skip
    if not joined:
        return None, ""
    partners = {a if b == image_id else b for a, b in joined}
    centres = np.array([model.images[i].projection_center() for i in sorted(partners)])
    scores = []
    for pose in poses:
        set_pose(model, image_id, pycolmap.Rigid3d(pose))
        agreeing = sum(int(m.sum()) for m in agreeing_matches(model, joined).values())
        distance = np.linalg.norm(centres + pose[:, :3].T @ pose[:, 3], axis=1).min()
        scores.append((round(-agreeing / sum(map(len, joined.values())), 1), float(distance)))
        model.deregister_frame(model.images[image_id].frame_id)
    best = min(range(len(poses)), key=lambda i: scores[i])
    if -scores[best][0] < MIN_AGREEMENT:
        return None, ""
    return poses[best], (
        f"three points allow {len(poses)} poses; {-scores[best][0]:.0%} of the matches with "
        f"{len(partners)} placed photos agree with the one chosen"
    )


def _add_tracks(
    model: pycolmap.Reconstruction, control: Sequence[Any], matches: Matches, task: Task
) -> None:
    """Add matched features as points; without parallax at the depth of the control."""
    posed = set(model.reg_image_ids())
    good = agreeing_matches(model, matches)
    kept = {pair: rows[good[pair]] for pair, rows in matches.items() if pair in good}
    kept = {pair: rows for pair, rows in kept.items() if len(rows)}
    if not kept:
        return
    tracks = build_tracks(
        kept, {i: p for i, p in keypoints_of(task.database).items() if i in posed}
    )
    centres = np.array([model.images[i].projection_center() for i in sorted(posed)])
    middle = np.mean([p["xyz"] for p in control], axis=0)
    far = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    order = np.argsort(tracks.track, kind="stable")
    count = 0
    for rows in np.split(order, np.flatnonzero(np.diff(tracks.track[order])) + 1):
        images = tracks.image[rows].tolist()
        if len(set(images)) != len(rows) or count == MAX_TRACKS:
            continue
        track = pycolmap.Track()
        clicks = []
        for image, keypoint in zip(images, tracks.keypoint[rows].tolist(), strict=True):
            track.add_element(image, keypoint)
            xy = model.images[image].points2D[keypoint].xy
            clicks.append([str(model.images[image].name), *xy.tolist()])
        xyz = _intersect(model, clicks, far)
        if xyz is not None:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
            count += 1
    task.remarks.append(f"{count} tracks of features tie the photos")


def _rays(model: pycolmap.Reconstruction, clicks: Sequence[Any]) -> Iterator[tuple[Array, Array]]:
    """Centre and direction of the ray of each click."""
    ids = {str(image.name): i for i, image in model.images.items()}
    for name, x, y in clicks:
        image = model.images[ids[name]]
        camera = model.cameras[image.camera_id]
        (ray,) = np.asarray(camera.cam_from_img(np.array([[x, y]], np.float64)))
        pose = image_pose(image)
        direction = pose[:3, :3].T @ np.append(ray, 1)
        yield -pose[:3, :3].T @ pose[:3, 3], direction / np.linalg.norm(direction)


def _intersect(
    model: pycolmap.Reconstruction, clicks: Sequence[Any], far: float | None = None
) -> Array | None:
    """Place nearest to the rays of clicks; that at distance ``far`` if they are almost parallel."""
    rays = list(_rays(model, clicks))
    if len(rays) < 2:
        return None
    centres, directions = (np.array(part) for part in zip(*rays, strict=True))
    (place,), (parallax,) = intersect_rays(directions, centres, np.zeros(1, np.int64))
    if len(rays) * parallax < 1e-4:  # half a degree between two rays
        return None if far is None else np.asarray(centres[0] + far * directions[0])
    return np.asarray(place)


def _without(
    model: pycolmap.Reconstruction, name: str, control: Sequence[Any], threads: int
) -> tuple[list[float], list[float]] | None:
    """Place of a control point, and its deviations, where nothing but its clicks is known."""
    if sum(point["sigma"] is not None for point in control) < 3:
        return None
    ids = adjust_with_control(model, control, constant_cameras=True, threads=threads)
    _, spreads = standard_deviations(model, control, ids)
    return (model.points3D[ids[name]].xyz.tolist(), spreads[name]) if spreads else None
