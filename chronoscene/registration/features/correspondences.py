"""Second stage: features, verified matches and held-out tracks, each task done once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from chronoscene.registration.context import Context
from chronoscene.registration.features import METHOD
from chronoscene.registration.features.camera_groups import camera_groups, scene_groups
from chronoscene.registration.features.given.source import describe, find_sources
from chronoscene.registration.photos.inputs import PhotoInputs
from chronoscene.registration.photos.known_cameras import known_groups


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Counts of features and matches, by which the route is chosen."""

    keypoints: Mapping[str, int]
    """Number of features by name."""
    partners: Mapping[str, int]
    """Number of photos with verified matches by name."""
    pairs_across: Mapping[str, int]
    """Verified pairs of photos between two periods, by ``"0-1"``."""
    matches_across: Mapping[str, int]
    made_by: str = METHOD
    """Name of the features, and of the matches where they were given."""
    absent: frozenset[str] = frozenset()
    """Photos that the given file of features lacks."""


def find_matches(inputs: PhotoInputs, context: Context) -> Matched:
    """Extract features, match photos, and hold out tracks, unless an earlier run did."""
    given = find_sources(context.options.features, context.options.matches)
    setting = {} if given is None else {"given": given}  # without, records are as they were before
    features = _features(inputs, context, setting)
    found = _matches(inputs, context, setting)
    return Matched(
        keypoints=features["keypoints"],
        partners=found["partners"],
        pairs_across=found["verified_pairs_across"],
        matches_across=found["matches_across"],
        made_by=METHOD if given is None else describe(given),
        absent=frozenset(features.get("absent", ())),
    )


def _features(inputs: PhotoInputs, context: Context, given: Mapping[str, Any]) -> dict[str, Any]:
    options = context.options
    if options.cameras is not None:
        groups = known_groups(options.cameras, inputs.images)
    else:
        groups = camera_groups(inputs.images, options.camera_model, options.calibration)
    if inputs.scene is not None:
        groups = scene_groups(inputs.scene) + groups
    return extract_features(groups, context, given)


def extract_features(
    groups: Sequence[Mapping[str, Any]], context: Context, given: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Extract the features of groups of photos that share a camera; see `extraction.extract`."""
    options = context.options
    settings = {
        "method": METHOD,
        "groups": groups,
        "max_image_size": options.max_image_size,
        "max_features": options.max_features,
        **(given or {}),
    }
    places = {
        "database": str(context.database),
        "photos": str(context.photos),
        "threads": context.threads,
    }

    def extract() -> tuple[Any, list[str]]:
        # The database may be made anew: pairs that an earlier one had are missing in it then.
        (context.work / "stage-matches.json").unlink(missing_ok=True)
        found = context.run_task("features", settings | places)
        count = len(found["keypoints"])
        remark = (
            f"{sum(found['keypoints'].values())} features in {count} photos, {len(groups)} "
            f"cameras, {sum(found['focal_known'].values())} with a focal length from EXIF or the "
            "scene"
        )
        lost = [f"{name}: not in the file of features" for name in found["absent"]]
        return found, [remark, *lost, *found["remarks"]]

    return dict(context.stages.run("features", settings, extract))


def _matches(inputs: PhotoInputs, context: Context, given: Mapping[str, Any]) -> dict[str, Any]:
    options = context.options
    centres = inputs.centres()
    taken = {c.name: c.taken.isoformat() for c in inputs.images if c.taken is not None}
    images = [
        {"name": name, "period": period, "enu": centres.get(name), "taken": taken.get(name)}
        for name, period in sorted(inputs.periods.items())
    ]
    settings = {
        "images": images,
        "exhaustive_limit": options.exhaustive_limit,
        "periods": inputs.periods,
        "share": options.held_out,
        "seed": options.seed,
        **given,
    }
    places = {
        "database": str(context.database),
        "pairs": str(context.work / "pairs.txt"),
        "out": str(context.mapping_database),
        "held_out": str(context.held_out),
        "threads": context.threads,
    }

    def match() -> tuple[Any, list[str]]:
        found = context.run_task("matches", settings | places)
        kinds = ", ".join(f"{n} {kind}" for kind, n in found["kinds"].items())
        pairs, verified, inliers = (found[k] for k in ("pairs", "verified", "inliers"))
        remarks = [
            f"{pairs} pairs ({kinds}), {found['across_periods']} across periods",
            f"{verified} of {pairs} pairs verified, {inliers} matches",
            f"{found['held_out']} of {found['tracks_of_several_periods']} tracks of several "
            "periods held out",
        ]
        for key, count in found["verified_pairs_across"].items():
            a, b = (inputs.labels[int(period)] for period in key.split("-"))
            shared = found["matches_across"][key]
            remarks.append(f"periods {a} and {b}: {count} verified pairs, {shared} matches")
        return found, remarks

    return dict(context.stages.run("matches", settings, match))
