"""The result as a scene in the ChronoScene format, beside it what was decided and where it lies."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared.writing import Progress
from chronoscene.io.staging import write_text_atomic
from chronoscene.registration.result import Registered
from chronoscene.scene import Frame, Period, Points, Scene, WorldFrame
from chronoscene.scene.splits import default_tests, split_of
from chronoscene.scene.tracks import reproject, track_owners
from chronoscene.undistort import undistort

LOG = "registration_log.json"
GEOREFERENCE = "georeference.json"

OURS = (LOG, GEOREFERENCE, "registration.json")


def as_scene(registered: Registered, name: str) -> Scene:
    """A scene with the cameras as they are; periods without a registered image are left out."""
    present = sorted(set(registered.periods.tolist()))
    number = {period: i for i, period in enumerate(present)}
    periods = {
        n: number[p] for n, p in zip(registered.names, registered.periods.tolist(), strict=True)
    }
    tests = default_tests(periods)
    frames = tuple(
        Frame(n, i + 1, camera, pose, periods[n], split_of(n, tests))
        for i, (n, camera, pose) in enumerate(
            zip(registered.names, registered.cameras, registered.cam_from_world, strict=True)
        )
    )
    georeference = registered.georeference
    world = WorldFrame() if georeference is None else WorldFrame("metre", georeference.crs)
    return Scene(
        name=name,
        root=Path(registered.images_root),
        images_root=Path(registered.images_root),
        frames=frames,
        points=as_points(registered),
        periods=tuple(
            Period(number[p], registered.labels[p], registered.dates[p]) for p in present
        ),
        split_rule="every 8th image of each period",
        format=our_format.NAME,
        world=world,
    )


def as_points(registered: Registered) -> Points:
    """The points with their errors."""
    return Points(
        ids=np.arange(1, len(registered.points) + 1),
        xyz=registered.points,
        rgb=registered.colors,
        error=point_errors(registered),
        track_start=registered.track_start,
        track_frame=registered.track_image.astype(np.int32),
        track_xy=registered.track_xy,
    )


def point_errors(registered: Registered) -> np.ndarray:
    """Mean reprojection error of each point, pixels; 0 without observations. [P]"""
    errors = observation_errors(registered)
    point = track_owners(registered.track_start)
    sums = np.bincount(point, weights=errors, minlength=len(registered.points))
    return np.asarray(sums / np.maximum(np.diff(registered.track_start), 1), np.float64)


def observation_errors(registered: Registered) -> np.ndarray:
    """Reprojection error of each observation, pixels; 0 behind a camera. [O]"""
    offset, _ = reproject(
        list(zip(registered.cameras, registered.cam_from_world, strict=True)),
        registered.points,
        registered.track_start,
        registered.track_image,
        registered.track_xy,
    )
    errors = np.linalg.norm(offset, axis=1)
    return np.where(np.isfinite(errors), errors, 0.0)


def check_free(out: Path, *, overwrite: bool) -> None:
    """Refuse a place that holds something else than a registration that may be replaced."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if overwrite and out.is_dir() and (out / LOG).is_file():
        return
    raise SceneError(
        out,
        expected="a new or empty folder",
        found="one in use",
        todo="choose another folder, or --overwrite if it is an earlier registration",
    )


def write_scene(scene: Scene, staged: Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Undistort a scene into a folder that is not its last place; counts for the log."""
    shutil.rmtree(staged, ignore_errors=True)
    done = undistort(scene, staged, progress=progress)
    return {
        "images": len(done.scene.frames),
        "points": len(done.scene.points),
        "observations_lost": done.observations_lost,
        "points_lost": done.points_lost,
    }


def write_extras(staged: Path, registered: Registered, log: Mapping[str, Any]) -> None:
    """Log and georeference."""
    write_text_atomic(staged / LOG, json.dumps(log, indent=1, ensure_ascii=False) + "\n")
    if registered.georeference is not None:
        frame = asdict(registered.georeference) | {"crs": registered.georeference.crs}
        write_text_atomic(staged / GEOREFERENCE, json.dumps(frame, indent=1) + "\n")


def publish(staged: Path, out: Path) -> None:
    """Move a finished folder to its place, replacing what `check_free` allowed to be replaced."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if staged.stat().st_dev != out.parent.stat().st_dev:
        near = out.with_name(f".{out.name}.{os.getpid()}.partial")
        shutil.copytree(staged, near)
        shutil.rmtree(staged)
        staged = near
    old = out.with_name(f".{out.name}.{os.getpid()}.old")
    if out.exists():
        out.rename(old)
    staged.rename(out)
    shutil.rmtree(old, ignore_errors=True)


def add_period(scene: Scene, registered: Registered, name: str) -> Scene:
    """The scene with the new period: its own frames as they are, new ones after them.

    Points of the scene stay, with their ids. New points are those that a new image sees; where one
    is an observation of a point of the scene at the same pixel, its new observations join that
    point instead.
    """
    from chronoscene.registration.reconstruct.extend_tracks import extend_tracks

    new = as_scene(registered, name)
    old_names = {f.name for f in scene.frames}
    added_period = scene.num_periods
    spare = 1 + max(f.image_id for f in scene.frames)
    added = [f for f in new.frames if f.name not in old_names]
    tests = default_tests({f.name: 0 for f in added})
    fresh = [
        replace(f, image_id=spare + i, period=added_period, split=split_of(f.name, tests))
        for i, f in enumerate(added)
    ]
    frames = tuple(sorted((*scene.frames, *fresh), key=lambda f: f.name))
    points = extend_tracks(scene, new, frames)
    label = registered.labels[added_period]
    period = Period(added_period, label, registered.dates[added_period])
    return replace(
        new, frames=frames, points=points, periods=(*scene.periods, period), world=scene.world
    )
