"""Second stage: features, matches, and what of them is held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from chronoscene.registration.context import Calibration, Context
from chronoscene.registration.features import METHOD
from chronoscene.registration.photos.inputs import Inputs
from chronoscene.registration.photos.photo import Capture
from chronoscene.scene import Frame, Scene

MIN_PHOTOS = 20
"""Photos with which a camera is calibrated for each date alone. Lenses are refocused and dropped
between dates; but few photos, of flat ground from one height above all, leave the focal length
open, and calibrate worse than last year's lens fits."""

SAME_VISIT = timedelta(days=1)
"""Periods that follow each other within this time share what was not touched in between."""


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """What is known of the photos before any pose."""

    keypoints: Mapping[str, int]
    """Number of features by name."""
    partners: Mapping[str, int]
    """Number of photos with verified matches by name."""
    pairs_across: Mapping[str, int]
    """Verified pairs of photos between two periods, by ``"0-1"``."""
    matches_across: Mapping[str, int]


def find_matches(inputs: Inputs, context: Context) -> Matched:
    """Extract, match and hold out; each is done once."""
    features = _features(inputs, context)
    found = _matches(inputs, context)
    return Matched(
        keypoints=features["keypoints"],
        partners=found["partners"],
        pairs_across=found["verified_pairs_across"],
        matches_across=found["matches_across"],
    )


def _features(inputs: Inputs, context: Context) -> dict[str, Any]:
    options = context.options
    groups = camera_groups(inputs.images, options.camera_model, options.calibration)
    if inputs.scene is not None:
        groups = scene_groups(inputs.scene) + groups
    settings = {
        "method": METHOD,
        "groups": groups,
        "max_image_size": options.max_image_size,
        "max_features": options.max_features,
    }
    places = {
        "database": str(context.database),
        "photos": str(context.photos),
        "threads": context.threads,
    }

    def extract() -> tuple[Any, list[str]]:
        # The database may be replaced: pairs that an earlier one had may be missing in it.
        (context.work / "stage-matches.json").unlink(missing_ok=True)
        found = context.step("features", settings | places)
        count = len(found["keypoints"])
        remark = (
            f"{sum(found['keypoints'].values())} features in {count} photos, {len(groups)} "
            f"cameras, {sum(found['focal_known'].values())} with a focal length from EXIF or the "
            "scene"
        )
        return found, [remark, *_reused(found["carried"], count, "photos: features")]

    return dict(context.stages.run("features", settings, extract))


def _reused(count: int, total: int, what: str) -> list[str]:
    return [f"{count} of {total} {what} reused from the previous run"] if count else []


def _matches(inputs: Inputs, context: Context) -> dict[str, Any]:
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
    }
    places = {
        "database": str(context.database),
        "pairs": str(context.work / "pairs.txt"),
        "scratch": str(context.work),
        "out": str(context.mapping_database),
        "held_out": str(context.held_out),
        "threads": context.threads,
    }

    def match() -> tuple[Any, list[str]]:
        found = context.step("matches", settings | places)
        kinds = ", ".join(f"{n} {kind}" for kind, n in found["kinds"].items())
        pairs, verified, inliers = (found[k] for k in ("pairs", "verified", "inliers"))
        told = [
            f"{pairs} pairs ({kinds}), {found['across_periods']} across periods",
            f"{verified} of {pairs} pairs verified, {inliers} matches",
            *_reused(found["carried"], pairs, "pairs: matches"),
            f"{found['held_out']} of {found['tracks_of_several_periods']} tracks of several "
            "periods held out",
        ]
        told += [
            f"periods {key}: {count} verified pairs, {found['matches_across'][key]} matches"
            for key, count in found["verified_pairs_across"].items()
        ]
        return found, told

    return dict(context.stages.run("matches", settings, match))


def scene_groups(scene: Scene) -> list[dict[str, Any]]:
    """The cameras of a scene with their images, as they are."""
    by_camera: dict[int, list[Frame]] = {}
    for frame in scene.frames:
        by_camera.setdefault(frame.camera.camera_id, []).append(frame)
    return [
        {
            "names": sorted(f.name for f in frames),
            "model": frames[0].camera.model,
            "params": list(frames[0].camera.params),
        }
        for frames in by_camera.values()
    ]


def camera_groups(
    captures: Sequence[Capture], model: str, calibration: Calibration = "auto"
) -> list[dict[str, Any]]:
    """Lists of names that share a camera, for `features.extraction.extract`.

    Photos share one if make, model, size and focal length agree. With ``auto``, photos of different
    visits do not, where each has enough of them (`MIN_PHOTOS`). Initial focal lengths are
    left to COLMAP, which knows the sensors of many cameras.
    """
    by_lens: dict[tuple[Any, ...], list[Capture]] = {}
    for capture in captures:
        by_lens.setdefault(_lens(capture), []).append(capture)
    groups = [g for members in by_lens.values() for g in _SPLITTERS[calibration](members)]
    return [
        {"names": sorted(names), "model": model, "params": None}
        for names in sorted(([c.name for c in group] for group in groups), key=min)
    ]


def _lens(capture: Capture) -> tuple[Any, ...]:
    exif = capture.exif
    return (exif.make, exif.model, capture.width, capture.height, exif.focal_mm, exif.focal_35mm)


def _periods(captures: Sequence[Capture]) -> list[list[Capture]]:
    by_period: dict[int, list[Capture]] = {}
    for capture in captures:
        by_period.setdefault(capture.period, []).append(capture)
    return [by_period[p] for p in sorted(by_period)]


def _visits(captures: Sequence[Capture]) -> list[list[Capture]]:
    """The photos of each visit that has enough of them, and those of all others together."""
    visits: list[list[Capture]] = []
    undated = []
    dated: list[tuple[datetime, datetime, list[Capture]]] = []
    for members in _periods(captures):
        times = [c.taken for c in members if c.taken is not None]
        if times:
            dated.append((min(times), max(times), members))
        else:
            undated.append(members)
    end: datetime | None = None
    for first, last, members in sorted(dated, key=lambda d: d[0]):
        if end is not None and first - end <= SAME_VISIT:
            visits[-1] += members
        else:
            visits.append(list(members))
        end = last if end is None else max(end, last)
    visits += undated
    few = [c for members in visits if len(members) < MIN_PHOTOS for c in members]
    return [m for m in visits if len(m) >= MIN_PHOTOS] + ([few] if few else [])


_SPLITTERS: dict[Calibration, Callable[[Sequence[Capture]], list[list[Capture]]]] = {
    "auto": _visits,
    "per-period": _periods,
    "shared": lambda captures: [list(captures)],
}
