"""Third stage: the route, its model, and what became of every photo."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.registration import output
from chronoscene.registration.context import Context
from chronoscene.registration.errors import RegistrationError
from chronoscene.registration.features.matching import Matched
from chronoscene.registration.photos.inputs import Inputs
from chronoscene.registration.reconstruct import assembly
from chronoscene.registration.result import Registered, Route
from chronoscene.scene.geometry import camera_centre

LEAST_CROSS_PAIRS = 3
LEAST_CROSS_MATCHES = 100
"""Verified pairs of images, and matches in them, with which two periods count as connected."""

LEAST_SHARE = 0.6
"""Share of the photos of each period that the joint route must place; else periods are also tried
one by one."""

SAME_PLACE = 0.01
"""Share of the usual distance between neighbours; nobody stands so exactly where he stood."""


def estimate(inputs: Inputs, matched: Matched, context: Context) -> Registered:
    """The route that fits, or the better of two."""
    route = choose_route(inputs, matched, context)
    registered = _run_route(route, inputs, matched, context)
    if route == "joint" and context.options.route is None and len(inputs.labels) > 1:
        registered = _or_separate(registered, inputs, matched, context)
    if inputs.scene is not None:
        remarks = same_places(registered, inputs.scene.num_periods)
        context.stages.remark("route", *remarks)
    counts = output.registered_counts(registered, inputs.totals())
    told = [f"period {c['label']}: {c['registered']} of {c['photos']} photos" for c in counts]
    context.stages.remark("result", f"route {registered.route}", *told)
    return registered


def choose_route(inputs: Inputs, matched: Matched, context: Context) -> Route:
    """The route asked for, or the one that the matches allow."""
    remark = context.stages.remark
    if inputs.scene is not None:
        return "frozen"
    if context.options.route is not None:
        remark("route", f"{context.options.route}: asked for")
        return context.options.route
    if connected_periods(matched, len(inputs.labels)):
        remark("route", "joint: matches connect all periods")
        return "joint"
    remark("route", "separate: matches do not connect all periods")
    return "separate"


def connected_periods(matched: Matched, count: int) -> bool:
    """Whether matches connect all periods, each with enough of them."""
    group = list(range(count))
    for key, pairs in matched.pairs_across.items():
        a, b = (int(part) for part in key.split("-"))
        if pairs >= LEAST_CROSS_PAIRS and matched.matches_across[key] >= LEAST_CROSS_MATCHES:
            old, new = group[b], group[a]
            group = [new if g == old else g for g in group]
    return len(set(group)) == 1


def _or_separate(
    joint: Registered, inputs: Inputs, matched: Matched, context: Context
) -> Registered:
    """The joint model, or that of periods one by one if it has more of the poorest period."""
    shares = _shares(joint, inputs)
    worst = min(shares, key=lambda period: shares[period])
    if shares[worst] >= LEAST_SHARE:
        return joint
    context.stages.remark(
        "route",
        f"the joint model has {shares[worst]:.0%} of the photos of period {worst}: periods are "
        "tried one by one too",
    )
    try:
        other = _run_route("separate", inputs, matched, context)
    except RegistrationError as error:
        context.stages.remark("route", f"periods one by one: {error}")
        return joint
    better = min(_shares(other, inputs).values()) > shares[worst]
    return other if better else joint


def _shares(registered: Registered, inputs: Inputs) -> dict[int, float]:
    """Share of the photos that are registered, by period."""
    return {
        i: float((registered.periods == i).sum()) / total
        for i, total in enumerate(inputs.totals())
        if total
    }


def _run_route(route: Route, inputs: Inputs, matched: Matched, context: Context) -> Registered:
    settings: dict[str, Any] = {"periods": inputs.periods}
    if route == "frozen":
        settings["poses"] = {f.name: f.cam_from_world[:3].tolist() for f in inputs.frames}
    else:
        settings["priors"] = inputs.priors() if inputs.georeference else None
        settings["keep_unplaced"] = context.options.tie_points is not None
    result = _estimate(route, route, settings, context)
    registered = _assemble(route, route, result, inputs, context)
    lost = assembly.reasons(
        inputs.periods,
        set(registered.names),
        matched.keypoints,
        matched.partners,
        result["left"],
    )
    registered = replace(registered, unplaced=frozenset(result["unplaced"]))
    return _with_lost(registered, lost, inputs)


def refined(
    registered: Registered, arguments: Mapping[str, Any], inputs: Inputs, context: Context
) -> Registered:
    """A registration adjusted anew after tie points moved its periods."""
    result = _estimate("refine", "refined", dict(arguments), context)
    again = _assemble(registered.route, "refined", result, inputs, context)
    lost = set(registered.names) - set(again.names)
    reason = "lost when the model was adjusted by tie points"
    return _with_lost(again, dict(registered.unregistered) | dict.fromkeys(lost, reason), inputs)


def _estimate(step: str, name: str, settings: dict[str, Any], context: Context) -> dict[str, Any]:
    """Run a step that estimates, once; stages after it do not depend on it."""

    def action() -> tuple[Any, list[str]]:
        found = context.step(step, settings | context.places(name))
        shutil.rmtree(context.work / f"scratch-{name}", ignore_errors=True)
        numbers = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in found["model"].items())
        return found, [*found["remarks"], numbers]

    before = context.stages.previous
    result = dict(context.stages.run(name, settings, action))
    context.stages.previous = before  # two routes may start from the same matches
    return result


def _assemble(
    route: Route, name: str, result: Mapping[str, Any], inputs: Inputs, context: Context
) -> Registered:
    georeferenced = result["is_georeferenced"] or inputs.scene is not None
    parts = assembly.Assembly(
        periods=inputs.periods,
        labels=inputs.labels,
        dates=inputs.dates,
        positions=assembly.position_map(inputs.images, inputs.positions),
        positions_used=frozenset(result["positions_used"]),
        georeference=inputs.georeference if georeferenced else None,
        route=route,
        images_root=context.photos,
        frozen={f.name: f for f in inputs.frames},
    )
    return assembly.assemble(context.work / f"model-{name}", context.held_out, parts)


def _with_lost(registered: Registered, lost: Mapping[str, str], inputs: Inputs) -> Registered:
    """The same registration with reasons for the photos that it lacks."""
    refused = {name: reason for name, (_, reason) in inputs.refused.items()}
    periods = {name: period for name, (period, _) in inputs.refused.items()}
    return replace(
        registered,
        unregistered={**lost, **refused},
        unregistered_periods={n: inputs.periods[n] for n in lost if n not in periods} | periods,
    )


def same_places(registered: Registered, new_period: int) -> list[str]:
    """New images with the pose of an old one: probably the same photo, undistorted since."""
    new = np.flatnonzero(registered.periods == new_period)
    old = np.flatnonzero(registered.periods != new_period)
    if len(old) < 2:
        return []
    centres = camera_centre(registered.cam_from_world)
    spacing = float(np.median(cKDTree(centres[old]).query(centres[old], k=2)[0][:, 1]))
    distance, nearest = cKDTree(centres[old]).query(centres[new])
    return [
        f"{registered.names[i]} was taken from the very place of {registered.names[old[j]]}: is it "
        "the same photo?"
        for i, j, d in zip(new.tolist(), nearest.tolist(), distance.tolist(), strict=True)
        if d < SAME_PLACE * spacing
    ]
