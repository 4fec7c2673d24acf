"""Third stage: the route, its model, and what became of every photo."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from chronoscene.colmap.model import read_model
from chronoscene.errors import RegistrationError
from chronoscene.registration.context import Context
from chronoscene.registration.features.camera_groups import AUTO
from chronoscene.registration.features.correspondences import Matched
from chronoscene.registration.photos.inputs import PhotoInputs
from chronoscene.registration.photos.stated import stated
from chronoscene.registration.result import HeldOutTracks, Registered, Route
from chronoscene.scene import Camera, Points
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.tracks import seen_by_period

MIN_CROSS_PAIRS = 3  # Verified pairs of images that connect two periods
MIN_CROSS_MATCHES = 100  # Matches in these pairs that connect two periods

MIN_SHARE = 0.6
"""Share of the photos of each period that the joint route must register; else the separate route is
tried too."""

SAME_POSITION = 0.01
"""Share of the usual distance between neighbours: nobody returns to a position so exactly."""

FEW_FEATURES = 100


def estimate(inputs: PhotoInputs, matched: Matched, context: Context) -> Registered:
    """The route that fits, or the better of two."""
    route = choose_route(inputs, matched, context)
    registered = _run_route(route, inputs, matched, context)
    if route == "joint" and context.options.route is None and len(inputs.labels) > 1:
        registered = _or_separate(registered, inputs, matched, context)
    if inputs.scene is not None:
        remarks = same_positions(registered, inputs.scene.num_periods)
        context.stages.remark("route", *remarks)
    counts = registered.counts()
    remarks = [f"period {c['label']}: {c['registered']} of {c['photos']} photos" for c in counts]
    context.stages.remark("result", f"route {registered.route}", *remarks)
    return registered


def choose_route(inputs: PhotoInputs, matched: Matched, context: Context) -> Route:
    """The route asked for, or the one that the matches allow."""
    remark = context.stages.remark
    if inputs.scene is not None:
        return "frozen"
    if context.options.route is not None:
        remark("route", f"{context.options.route}: requested")
        return context.options.route
    if connected_periods(matched, set(inputs.periods.values())):
        remark("route", "joint: matches connect all periods")
        return "joint"
    remark("route", "separate: matches do not connect all periods")
    return "separate"


def connected_periods(matched: Matched, periods: Collection[int]) -> bool:
    """Return True if enough matches connect some periods, those that have photos."""
    links = [
        tuple(int(part) for part in key.split("-"))
        for key, pairs in matched.pairs_across.items()
        if pairs >= MIN_CROSS_PAIRS and matched.matches_across[key] >= MIN_CROSS_MATCHES
    ]
    a, b = np.array(links, np.int64).reshape(-1, 2).T
    count = max(periods) + 1
    graph = coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    part = connected_components(graph, directed=False)[1]
    return len(set(part[list(periods)].tolist())) == 1


def _or_separate(
    joint: Registered, inputs: PhotoInputs, matched: Matched, context: Context
) -> Registered:
    """The joint model, or the separate one if it has more of the poorest period."""
    shares = _shares(joint, inputs)
    worst = min(shares, key=lambda period: shares[period])
    if shares[worst] >= MIN_SHARE:
        return joint
    context.stages.remark(
        "route",
        f"the joint model has {shares[worst]:.0%} of the photos of {inputs.labels[worst]}: the "
        "separate route is tried too",
    )
    try:
        other = _run_route("separate", inputs, matched, context)
    except RegistrationError as error:
        context.stages.remark("route", f"separate: {error}")
        return joint
    better = min(_shares(other, inputs).values()) > shares[worst]
    return other if better else joint


def _shares(registered: Registered, inputs: PhotoInputs) -> dict[int, float]:
    """Share of the photos that are registered, by period."""
    return {
        i: float((registered.periods == i).sum()) / total
        for i, total in enumerate(inputs.totals())
        if total
    }


def _run_route(route: Route, inputs: PhotoInputs, matched: Matched, context: Context) -> Registered:
    settings: dict[str, Any] = {"periods": inputs.periods}
    if route == "frozen":
        settings["poses"] = {f.name: f.cam_from_world[:3].tolist() for f in inputs.frames}
    else:
        settings["priors"] = inputs.priors() if inputs.georeference else None
        settings["keep_unplaced"] = context.options.tie_points is not None
        settings["focals"] = inputs.focals()
        settings["full_lens"] = context.options.camera_model == AUTO
    if route == "separate":
        settings["labels"] = list(inputs.labels)
    result = _estimate(route, route, settings, context)
    registered = _assemble(route, route, result, inputs, context)
    missing = set(inputs.periods) - set(registered.names)
    lost = reasons(missing, matched.keypoints, matched.partners, result["left"])
    lost |= dict.fromkeys(missing & matched.absent, "not in the file of features")
    lost |= {name: reason for name, reason in inputs.far().items() if name in lost}
    registered = replace(registered, unplaced=frozenset(result["unplaced"]))
    return _with_lost(registered, lost, inputs)


def refined(
    registered: Registered, arguments: Mapping[str, Any], inputs: PhotoInputs, context: Context
) -> Registered:
    """A registration adjusted again after tie points have moved its periods."""
    settings = dict(arguments) | {"short": registered.short, "held": registered.held}
    result = _estimate("refine", "refined", settings, context)
    again = _assemble(registered.route, "refined", result, inputs, context)
    lost = set(registered.names) - set(again.names)
    reason = "lost when the model was adjusted with tie points"
    return _with_lost(again, dict(registered.unregistered) | dict.fromkeys(lost, reason), inputs)


def resected(
    arguments: Mapping[str, Any], inputs: PhotoInputs, matched: Matched, context: Context
) -> tuple[Registered, dict[str, Any]]:
    """The model that the task ``resection`` makes, and its result."""
    result = _estimate("resection", "resection", dict(arguments), context)
    registered = _assemble("resection", "resection", result, inputs, context)
    reason = "fewer than three clicked control points, or several poses that fit them"
    lost = dict.fromkeys(set(inputs.periods) - set(registered.names), reason)
    return _with_lost(registered, lost, inputs), result


def _estimate(task: str, name: str, settings: dict[str, Any], context: Context) -> dict[str, Any]:
    """Run a task that estimates, once; stages after it do not depend on it."""

    def action() -> tuple[Any, list[str]]:
        found = context.run_task(task, settings | context.places(name))
        shutil.rmtree(context.work / f"scratch-{name}", ignore_errors=True)
        numbers = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in found["model"].items())
        return found, [*found["remarks"], numbers]

    before = context.stages.previous
    result = dict(context.stages.run(name, settings, action))
    context.stages.previous = before  # two routes may start from the same matches
    return result


def _assemble(
    route: Route, name: str, result: Mapping[str, Any], inputs: PhotoInputs, context: Context
) -> Registered:
    """Read a model and what was held out; photos without a pose are left to the caller."""
    model = read_model(context.work / f"model-{name}")
    points = without_twins(model.points)
    names = tuple(image.name for image in model.images)
    periods = np.array([inputs.periods[n] for n in names], np.int64)
    gps = dict(zip((c.name for c in inputs.images), inputs.positions.enu, strict=True))
    kept = {f.name: f for f in inputs.frames}  # poses and cameras of the scene, to the last bit
    spare = max((f.camera.camera_id for f in inputs.frames), default=0)

    def camera(name: str, found: Camera) -> Camera:
        """Cameras of the scene keep their ids; those of new photos get ids after them."""
        if name in kept:
            return kept[name].camera
        return replace(found, camera_id=spare + found.camera_id)

    georeferenced = result["is_georeferenced"] or inputs.scene is not None
    return Registered(
        names=names,
        periods=periods,
        cam_from_world=np.stack([kept.get(i.name, i).cam_from_world for i in model.images]),
        cameras=tuple(camera(i.name, i.camera) for i in model.images),
        points=points.xyz,
        colors=points.rgb,
        track_start=points.track_start,
        track_image=points.track_frame.astype(np.int64),
        track_xy=points.track_xy,
        unregistered={},
        unregistered_periods={},
        route=route,
        gps_enu=np.array([gps.get(n, np.full(3, np.nan)) for n in names]).reshape(-1, 3),
        gps_used=np.isin(names, result["positions_used"]),
        georeference=inputs.georeference if georeferenced else None,
        num_periods=len(inputs.labels),
        labels=inputs.labels,
        dates=inputs.dates_of(frozenset(names)),
        held_out_tracks=read_held_out(context.held_out, names, inputs.periods),
        images_root=str(context.photos),
        stated={c.name: stated(c) for c in inputs.images},
        short=result["short"],
        held=result["held"],
        loose=frozenset(result["loose"]),
    )


def without_twins(points: Points) -> Points:
    """Points of which no two are observed at one pixel of one image; the longer track stays.

    SIFT gives a keypoint several features where it has several orientations, and each of them can
    become a point: the same point twice.
    """
    lengths = np.diff(points.track_start)
    row = np.repeat(np.arange(len(points)), lengths)
    place = np.column_stack([points.track_frame, points.track_xy])
    _, pixel = np.unique(place, axis=0, return_inverse=True)
    count = len(points) + int(pixel.max(initial=-1)) + 1
    graph = coo_matrix((np.ones(len(row)), (row, len(points) + pixel.ravel())), (count, count))
    group = connected_components(graph, directed=False)[1][: len(points)]
    order = np.lexsort((np.arange(len(points)), -lengths, group))
    first = np.unique(group[order], return_index=True)[1]
    keep = np.zeros(len(points), bool)
    keep[order[first]] = True
    return points.select(keep)


def read_held_out(path: Path, names: tuple[str, ...], periods: Mapping[str, int]) -> HeldOutTracks:
    """Held-out tracks that registered images of at least two periods see."""
    with np.load(path) as data:
        known: dict[str, str] = json.loads(bytes(data["names"]).decode())
        track, image, xy = data["track"], data["image"], data["xy"]
    index = {name: i for i, name in enumerate(names)}
    slot = {int(image_id): index.get(name, -1) for image_id, name in known.items()}
    place = np.array([slot[i] for i in image.tolist()], np.int64)
    there = place >= 0
    track, place, xy = track[there], place[there], xy[there]
    if not len(track):
        return HeldOutTracks.empty()
    period = np.array([periods[name] for name in names])[place]
    shape = int(track.max()) + 1, int(period.max()) + 1
    across = (seen_by_period(track, period, shape).sum(axis=1) > 1)[track]
    order = np.lexsort((place[across], track[across]))
    track, place, xy = track[across][order], place[across][order], xy[across][order]
    start = np.append(np.flatnonzero(np.diff(track, prepend=-1)), len(track))
    return HeldOutTracks(start.astype(np.int64), place, xy)


def reasons(
    missing: set[str],
    keypoints: Mapping[str, int],
    partners: Mapping[str, int],
    left: list[list[str]],
) -> dict[str, str]:
    """Reasons why images have no pose, as far as they are known."""
    part_of = {name: len(group) for group in left for name in group}
    found = {}
    for name in sorted(missing):
        count, matched = keypoints.get(name, 0), partners.get(name, 0)
        if count < FEW_FEATURES:
            found[name] = f"only {count} features: blurred, dark, or without texture"
        elif name in part_of:
            found[name] = (
                f"in a submodel of {part_of[name]} images that could not be placed; photos that "
                "show both it and the rest would connect it"
            )
        elif not matched:
            found[name] = f"none of its {count} features are matched in any other photo"
        else:
            found[name] = (
                f"matched with {matched} photos, but too few of the matches agree on a pose; "
                "photos between this one and its neighbours, half a step apart, would connect it"
            )
    return found


def _with_lost(registered: Registered, lost: Mapping[str, str], inputs: PhotoInputs) -> Registered:
    """The same registration with reasons for the photos that it lacks."""
    refused = {name: reason for name, (_, reason) in inputs.refused.items()}
    periods = {name: period for name, (period, _) in inputs.refused.items()}
    return replace(
        registered,
        unregistered={**lost, **refused},
        unregistered_periods={n: inputs.periods[n] for n in lost if n not in periods} | periods,
    )


def same_positions(registered: Registered, new_period: int) -> list[str]:
    """New images at the position of an old one: probably the same photo, undistorted since."""
    new = np.flatnonzero(registered.periods == new_period)
    old = np.flatnonzero(registered.periods != new_period)
    if len(old) < 2:
        return []
    centres = camera_centre(registered.cam_from_world)
    tree = cKDTree(centres[old])
    spacing = float(np.median(tree.query(centres[old], k=2)[0][:, 1]))
    distance, nearest = tree.query(centres[new])
    return [
        f"{registered.names[i]} was taken from the same position as {registered.names[old[j]]}: "
        "are they the same photo?"
        for i, j, d in zip(new.tolist(), nearest.tolist(), distance.tolist(), strict=True)
        if d < SAME_POSITION * spacing
    ]
