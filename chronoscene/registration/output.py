"""Output of a registration: a scene in the ChronoScene format, and files about it beside it."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.images.masks import find_masks
from chronoscene.io.staging import check_not_current, needing_space, replacing, write_text_atomic
from chronoscene.registration.quality.certificate import Certificate, certify
from chronoscene.registration.quality.position import Position, judge_position
from chronoscene.registration.quality.verdict import Verdict, judge
from chronoscene.registration.report.certificate_json import to_json
from chronoscene.registration.report.coordinates import CONTROL, GEOREFERENCE, write_control
from chronoscene.registration.report.page import render_report
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.residuals import with_tie_tracks
from chronoscene.registration.ties.tie_alignment import TieAlignment
from chronoscene.registration.ties.tie_points import TiePoints
from chronoscene.scene import Frame, Period, Points, Scene, WorldFrame
from chronoscene.scene.splits import default_tests, split_of
from chronoscene.scene.tracks import reproject, track_owners

LOG = "registration_log.json"
CERTIFICATE = "registration.json"
PAGE = "registration.html"


def as_scene(registered: Registered, name: str) -> Scene:
    """Make a scene with distorted cameras; periods without a registered image are left out."""
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
    photos = Path(registered.images_root)
    georeference = registered.georeference
    world = WorldFrame(registered.unit, None if georeference is None else georeference.crs)
    return Scene(
        name=name,
        root=photos,
        images_root=photos,
        frames=frames,
        points=as_points(registered),
        periods=tuple(
            Period(number[p], registered.labels[p], registered.dates[p]) for p in present
        ),
        split_rule="every 8th image of each period",
        format=our_format.NAME,
        world=world,
        masks=find_masks(photos.parent, registered.names),
    )


def as_points(registered: Registered) -> Points:
    """Convert the points, with their reprojection errors."""
    return Points(
        ids=np.arange(1, len(registered.points) + 1),
        xyz=registered.points,
        rgb=registered.colors,
        error=point_errors(registered),
        track_start=registered.track_start,
        track_frame=registered.track_image.astype(np.int32),
        track_xy=registered.track_xy,
    )


def point_errors(registered: Registered) -> Array:
    """Mean reprojection error of each point, pixels; 0 without observations. [P]

    An observation behind its camera counts as 0.
    """
    errors = np.zeros(len(registered.track_xy))
    for rows, error, _ in reproject(
        list(zip(registered.cameras, registered.cam_from_world, strict=True)),
        registered.points,
        registered.track_start,
        registered.track_image,
        registered.track_xy,
    ):
        errors[rows] = np.nan_to_num(error, nan=0.0, posinf=0.0)
    point = track_owners(registered.track_start)
    sums = np.bincount(point, weights=errors, minlength=len(registered.points))
    return np.asarray(sums / np.maximum(np.diff(registered.track_start), 1), np.float64)


def check_free(out: Path, *, overwrite: bool) -> None:
    """Refuse a path that is in use, unless it is a registration that may be replaced."""
    check_not_current(out)
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if overwrite and out.is_dir() and (out / LOG).is_file():
        return
    raise SceneError(
        out,
        expected="a new or empty folder",
        found="one that is not empty",
        todo="choose another folder, or --overwrite if it is an earlier registration",
    )


def publish(staged: Path, out: Path) -> None:
    """Move a finished folder to its place, replacing what `check_free` allowed to be replaced."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if staged.stat().st_dev != out.parent.stat().st_dev:
        near = out.with_name(f".{out.name}.{os.getpid()}.partial")
        _copy(staged, near, out)
        shutil.rmtree(staged)
        staged = near
    old = out.with_name(f".{out.name}.{os.getpid()}.old")
    if out.exists():
        out.rename(old)
    staged.rename(out)
    shutil.rmtree(old, ignore_errors=True)


def _copy(source: Path, near: Path, out: Path) -> None:
    """Copy a folder to a temporary place beside ``out``, whole or not at all."""

    def copy(file: str, target: str) -> None:
        with needing_space(out):
            shutil.copy2(file, target)

    try:
        shutil.copytree(source, near, copy_function=copy)
    except BaseException:
        shutil.rmtree(near, ignore_errors=True)
        raise


def copy_records(scene: Scene, out: Path, *, certificate: bool = True) -> tuple[str, ...]:
    """Copy what ``register`` wrote about a scene to another scene in the same frame.

    That is ``georeference.json``, and the certificate if the scene was read with the periods that
    it describes. Links that lead out of the scene are left out.

    Args:
        scene: Any scene.
        out: Folder of the other one.
        certificate: False if the other one has other names of periods or images.

    Returns:
        Names of the files that were copied.
    """
    described = certificate and scene.format == our_format.NAME
    names = (GEOREFERENCE, CERTIFICATE) if described else (GEOREFERENCE,)
    root, copied = scene.root.resolve(), list[str]()
    for name in names:
        source = (root / name).resolve()
        if source.is_file() and source.is_relative_to(root):
            with replacing(out / name) as partial:
                shutil.copyfile(source, partial)
            copied.append(name)
    return tuple(copied)


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """Certificate of a registration, and the two verdicts on it."""

    certificate: Certificate
    verdict: Verdict
    """On the alignment of the periods with each other."""
    position: Position
    """On position and scale in the world."""
    ties: tuple[str, ...] = ()
    """Remarks on tie points and control: what was done with them, and what was left out."""

    @property
    def failed(self) -> bool:
        """True if one of the verdicts is fail."""
        return "fail" in (self.verdict.level, self.position.level)

    @property
    def summary(self) -> str:
        """Both verdicts and what to do, for the end of the command."""
        verdict, position = self.verdict, self.position
        lines = [f"alignment of the periods: {verdict.level}. {verdict.text}"]
        lines += [f"  to do: {todo}" for todo in verdict.todo[:3]]
        lines.append(f"absolute position: {position.level}. {position.text}")
        lines += [f"  {name}: {rmse.text}" for name, rmse in position.lines]
        if position.scale_error is not None:
            lines.append(f"  scale: known to {position.scale_error:.2%} by GPS")
        lines += [f"  {c.what}: {c.text}" for c in position.metadata]
        lines += [f"  tie points: {remark}" for remark in self.ties[:5]]
        if len(self.ties) > 5:
            lines.append(f"  ... and {len(self.ties) - 5} more; see {LOG}")
        lines += [f"  to do: {todo}" for todo in position.todo[:3]]
        return "\n".join(lines) + "\n"


def inspect_registration(
    model: Registered,
    folder: Path,
    *,
    page: bool = False,
    ties: TieAlignment | None = None,
    tie_points: TiePoints | None = None,
    title: str | None = None,
) -> Inspection:
    """Write ``registration.json``, errors of surveyed points, and a page if asked for.

    Args:
        model: The registration, after alignment by tie points.
        folder: An existing folder.
        page: True to write the page.
        ties: Result of the alignment by tie points.
        tie_points: Clicked points that count as ties.
        title: Title of the page; None for the name of the folder.
    """
    model = model if tie_points is None else with_tie_tracks(model, tie_points)
    certificate = certify(model)
    verdict, position = judge(certificate), judge_position(model, ties)
    data = to_json(certificate, verdict, position, ties)
    write_text_atomic(folder / CERTIFICATE, json.dumps(data, indent=1, allow_nan=False) + "\n")
    if ties is not None and any(r.role != "tie" for r in ties.residuals):
        write_control(folder / CONTROL, ties.residuals)
    if page:
        title = title or f"Registration of {folder.resolve().name}"
        text = render_report(model, certificate, verdict, position, ties=ties, title=title)
        write_text_atomic(folder / PAGE, text)
    return Inspection(certificate, verdict, position, () if ties is None else ties.remarks)
