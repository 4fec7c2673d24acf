"""First stage: which photos there are, under which names, of which periods, and where."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from chronoscene.errors import RegistrationError, SceneError
from chronoscene.geodesy import Georeference, from_crs
from chronoscene.images.store import image_size
from chronoscene.registration.context import Context
from chronoscene.registration.photos import prepare
from chronoscene.registration.photos.captures import Captures
from chronoscene.registration.photos.gps_priors import Positions, locate
from chronoscene.registration.photos.photo import Capture
from chronoscene.scene import Frame, Scene
from chronoscene.scene.geometry import camera_centre


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Photos as they go into the features, those of a scene that grows among them."""

    captures: Captures
    scene: Scene | None
    """The scene that gets a new period."""
    images: tuple[Capture, ...]
    """New photos under the names that they have from now on, sorted."""
    periods: dict[str, int]
    """Of all photos, by name."""
    labels: tuple[str, ...]
    dates: tuple[str | None, ...]
    refused: dict[str, tuple[int, str]]
    """Period and reason of photos that cannot be used, by name."""
    positions: Positions
    """Of ``images``."""
    georeference: Georeference | None

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Those of the scene that grows."""
        return self.scene.frames if self.scene else ()

    def totals(self) -> list[int]:
        """Photos of each period."""
        counts = [0] * len(self.labels)
        for period in self.periods.values():
            counts[period] += 1
        return counts

    def priors(self) -> dict[str, Any]:
        """Positions that are believed: ``enu`` and ``sigma`` by name."""
        found = self.positions
        rows = [
            (capture.name, enu.tolist(), sigma.tolist())
            for capture, enu, sigma, good in zip(
                self.images, found.enu, found.sigma, found.believed, strict=True
            )
            if good
        ]
        return {"enu": {n: e for n, e, _ in rows}, "sigma": {n: s for n, _, s in rows}}

    def centres(self) -> dict[str, list[float]]:
        """Where images were taken, as far as known, in one frame."""
        known = {f.name: camera_centre(f.cam_from_world).tolist() for f in self.frames}
        if self.scene is None or self.georeference is not None:
            known |= self.priors()["enu"]
        return known


def gather(captures: Captures, scene: Scene | None, context: Context) -> Inputs:
    """Prepare the photos.

    Raises:
        RegistrationError: If there are too few.
        SceneError: If the scene has distortion.
    """
    stages = context.stages
    told = [f"{name}: {reason}" for name, _, reason in captures.refused]
    stages.remark("captures", *captures.remarks, *told)
    unique = prepare.drop_copies(captures.images, prepare.content_digests(captures.images))
    _check_enough(captures, unique.captures, scene, context)
    label, date = _new_period(captures)
    source = unique.captures
    if scene is not None:
        source = _as_new_period(unique.captures, scene, label)
    digests = [unique.digests[c.name] for c in unique.captures]
    inputs = [[c.name, str(c.path.resolve()), d] for c, d in zip(source, digests, strict=True)]
    if scene is not None:
        inputs += [[f.name, str(scene.image_path(f))] for f in scene.frames]
    names = stages.run("photos", inputs, lambda: _place(source, scene, unique.remarks, context))
    images = prepare.renamed(source, names)
    periods = {f.name: f.period for f in (scene.frames if scene else ())}
    positions, georeference = _locate(images, scene, context)
    last = scene.num_periods if scene else None
    labels = tuple(p.label for p in captures.periods)
    dates = tuple(p.date for p in captures.periods)
    if scene is not None:
        labels = (*(p.label for p in scene.periods), label)
        dates = (*(p.date for p in scene.periods), date)
    return Inputs(
        captures=captures,
        scene=scene,
        images=images,
        periods=periods | {c.name: c.period for c in images},
        labels=labels,
        dates=dates,
        refused={
            name: (period if last is None else last, reason)
            for name, period, reason in (*captures.refused, *unique.refused)
        },
        positions=positions,
        georeference=georeference,
    )


def _check_enough(
    captures: Captures, usable: Sequence[Capture], scene: Scene | None, context: Context
) -> None:
    if len(usable) < 2 and scene is None:
        raise RegistrationError(
            captures.root,
            expected="at least two photos",
            found=f"{len(usable)} that can be used",
            todo="add photos that overlap",
        )
    present = {c.period for c in usable}
    for i, period in enumerate(captures.periods):
        if i not in present:
            context.stages.remark("captures", f"period {period.label} has no photo left")


def _new_period(captures: Captures) -> tuple[str, str | None]:
    """Label and date of all captures together: the date as far as they share it."""
    periods = captures.periods
    label = periods[0].label if len(periods) == 1 else captures.root.name
    days = sorted(c.taken.date().isoformat() for c in captures.images if c.taken is not None)
    if not days:
        return label, None
    return label, days[0] if days[0] == days[-1] else days[0][:4]


def _as_new_period(captures: Sequence[Capture], scene: Scene, label: str) -> tuple[Capture, ...]:
    """Captures as the one period after those of a scene, under names that it does not have."""
    taken = {f.name for f in scene.frames}
    new = []
    for capture in captures:
        name = capture.name if "/" in capture.name else f"{label}/{capture.name}"
        while name in taken:
            name = f"new/{name}"
        taken.add(name)
        new.append(replace(capture, name=name, period=scene.num_periods))
    return tuple(new)


def _place(
    captures: Sequence[Capture], scene: Scene | None, remarks: Sequence[str], context: Context
) -> tuple[list[str], list[str]]:
    """Put photos, and those of the scene, where the steps look for them."""
    shutil.rmtree(context.photos, ignore_errors=True)
    names, told = prepare.place_photos(captures, context.photos)
    for frame in scene.frames if scene else ():
        assert scene is not None
        _check_pinhole(scene, frame)
        prepare.link(scene.image_path(frame), context.photos / frame.name)
    return names, [*remarks, *told]


def _locate(
    images: Sequence[Capture], scene: Scene | None, context: Context
) -> tuple[Positions, Georeference | None]:
    """Positions in the frame of the scene if it has a place, else in one of their own."""
    frame = from_crs(scene.world.crs) if scene and scene.world.unit == "metre" else None
    positions = locate(images, frame)
    context.stages.remark("positions", *positions.remarks)
    return positions, positions.georeference if scene is None else frame


def _check_pinhole(scene: Scene, frame: Frame) -> None:
    """Refuse a scene whose cameras would have to change."""
    camera = frame.camera
    size = image_size(scene.image_path(frame))
    if not camera.is_pinhole or size != (camera.width, camera.height):
        raise SceneError(
            scene.image_path(frame),
            expected="an image of the size of its camera, without distortion",
            found=f"{camera.model} {camera.width} x {camera.height}, file {size[0]} x {size[1]}",
            todo="write the scene with chronoscene undistort first",
        )
