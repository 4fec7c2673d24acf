"""First stage: the photos with their final names, periods and positions, where the tasks find them.

COLMAP and our format use the pixels as stored. An orientation tag would make viewers and other
loaders rotate them, so it is set to 1 in a copy, without touching the pixels. Files that COLMAP
does not read in colour are written as PNG. All others are links to the originals.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from chronoscene.errors import RegistrationError, SceneError
from chronoscene.geodesy import Georeference
from chronoscene.images.decoding import image_size, load_photo
from chronoscene.images.exif import ExifData, lens_tags, set_upright
from chronoscene.images.masks import MASKS, mask_place
from chronoscene.images.store import place_image
from chronoscene.io.staging import replacing, sha256_of
from chronoscene.io.wording import counted
from chronoscene.registration.context import Context
from chronoscene.registration.photos.captures import Captures, period_date
from chronoscene.registration.photos.gps_priors import Positions, locate
from chronoscene.registration.photos.photo import Capture
from chronoscene.registration.photos.stated import stated
from chronoscene.registration.report.coordinates import local_frame
from chronoscene.registration.result import ANOTHER_PLACE
from chronoscene.scene import Frame, Scene
from chronoscene.scene.cameras import way_to_pinhole
from chronoscene.scene.geometry import camera_centre

_ORIENTATION = 0x0112

ALIKE, SAME_PICTURE, MIN_CONTRAST = 8.0, 4.0, 10.0
"""Grey levels. Photos that were read at a reduced size and differ by less are compared as a whole;
copies of half the size and quality differ by 3.7 then, photos from a tripod at two dates by 13, and
photos in a row by 7. Photos of so little contrast are not compared."""

FAR_METRES = 2_000.0  # Between the positions of a period and all others: it is of another place

_PLAIN_MODES = ("RGB", "L")
_READ_BY_COLMAP = ("JPEG", "PNG", "TIFF", "BMP")


@dataclass(frozen=True, slots=True, eq=False)
class PhotoInputs:
    """Photos for feature extraction, including those of a scene that is extended."""

    captures: Captures
    scene: Scene | None
    """The scene that gets a new period."""
    images: tuple[Capture, ...]
    """New photos under their final names, sorted."""
    periods: dict[str, int]
    """Period of every photo, by name."""
    labels: tuple[str, ...]
    dates: tuple[str | None, ...]
    refused: dict[str, tuple[int, str]]
    """Period and reason of photos that cannot be used, by name."""
    positions: Positions
    """GPS positions of ``images``."""
    georeference: Georeference | None

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames of the scene that is extended."""
        return self.scene.frames if self.scene else ()

    def totals(self) -> list[int]:
        """Photos of each period."""
        periods = np.array(list(self.periods.values()), np.int64)
        return [int(n) for n in np.bincount(periods, minlength=len(self.labels))]

    def sizes(self) -> dict[str, tuple[int, int] | None]:
        """Width and height of every photo, by name; None for those that cannot be used."""
        known = {c.name: (c.width, c.height) for c in self.images}
        return {name: known.get(name) for name in sorted(self.periods)}

    def priors(self) -> dict[str, Any]:
        """Plausible positions: ``enu`` and ``sigma`` by name."""
        found = self.positions
        good = [(i, c.name) for i, c in enumerate(self.images) if found.plausible[i]]
        return {
            "enu": {name: found.enu[i].tolist() for i, name in good},
            "sigma": {name: found.sigma[i].tolist() for i, name in good},
        }

    def focals(self) -> dict[str, tuple[float, float]]:
        """Focal length that each photo states, in pixels, and its relative error, by name."""
        found = ((c.name, stated(c)) for c in self.images)
        return {name: (s.focal, s.focal_error) for name, s in found if s.focal is not None}

    def far(self) -> dict[str, str]:
        """Photos of periods that were taken at another place by their GPS, and how far off."""
        periods = np.array([c.period for c in self.images], np.int64)
        middles = {}
        for p in np.unique(periods).tolist():
            known = self.positions.enu[periods == p, :2]  # heights may be of another kind
            known = known[np.isfinite(known).all(axis=1)]
            if len(known):
                middles[p] = np.median(known, axis=0)
        found = {}
        most = max(middles, key=lambda p: int((periods == p).sum()), default=None)
        for p, middle in middles.items():
            if p == most and self.scene is None:
                continue
            others = [m for q, m in middles.items() if q != p]
            if self.scene is not None and self.georeference is not None:
                others.append(np.zeros(2))
            away = min((float(np.linalg.norm(middle - m)) for m in others), default=0.0)
            if away > FAR_METRES:
                found[p] = f"{away / 1000:,.0f} km from the other dates by GPS: {ANOTHER_PLACE}"
        return {c.name: found[c.period] for c in self.images if c.period in found}

    def dates_of(self, registered: frozenset[str]) -> tuple[str | None, ...]:
        """Dates of the periods, by the photos that are registered."""
        dates = list(self.dates)
        known = [c for c in self.images if c.taken and c.path in self.captures.undisputed]
        for p in {c.period for c in known}:
            mine = [c for c in known if c.period == p]
            if not registered.issuperset(c.name for c in mine):
                days = [c.taken.date() for c in mine if c.taken and c.name in registered]
                dates[p] = period_date(self.labels[p], days)
        return tuple(dates)

    def centres(self) -> dict[str, list[float]]:
        """Known positions of images, in one frame, by name."""
        known = {f.name: camera_centre(f.cam_from_world).tolist() for f in self.frames}
        if self.scene is None or self.georeference is not None:
            known |= self.priors()["enu"]
        return known


def gather(captures: Captures, scene: Scene | None, context: Context) -> PhotoInputs:
    """Prepare the photos.

    Raises:
        RegistrationError: If there are too few.
        SceneError: If the scene has distortion.
    """
    stages = context.stages
    refused = [f"{name}: {reason}" for name, _, reason in captures.refused]
    stages.remark("captures", *captures.remarks, *refused)
    digests = {capture.name: sha256_of(capture.path) for capture in captures.images}
    unique, copies, notes = drop_copies(captures.images, digests)
    unique, again, more = drop_saved_again(unique)
    copies, notes = [*copies, *again], [*notes, *more]
    _check_enough(captures, unique, scene, context)
    label, date = _new_period(captures)
    source = unique if scene is None else _as_new_period(unique, scene, label)
    inputs = [
        [c.name, str(c.path.resolve()), digests[original.name], *_mask_inputs(c.mask)]
        for c, original in zip(source, unique, strict=True)
    ]
    if scene is not None:
        inputs += [
            [f.name, str(path), sha256_of(path), *_mask_inputs(scene.masks.get(f.name))]
            for f, path in ((f, scene.image_path(f)) for f in scene.frames)
        ]
    names = stages.run("photos", inputs, lambda: _place(source, scene, notes, context))
    images = renamed(source, names)
    periods = {f.name: f.period for f in (scene.frames if scene else ())}
    positions, georeference = _locate(images, scene, context)
    last = scene.num_periods if scene else None
    labels = tuple(p.label for p in captures.periods)
    dates = tuple(p.date for p in captures.periods)
    if scene is not None:
        labels = (*(p.label for p in scene.periods), label)
        dates = (*(p.date for p in scene.periods), date)
    return PhotoInputs(
        captures=captures,
        scene=scene,
        images=images,
        periods=periods | {c.name: c.period for c in images},
        labels=labels,
        dates=dates,
        refused={
            name: (period if last is None else last, reason)
            for name, period, reason in (*captures.refused, *copies)
        },
        positions=positions,
        georeference=georeference,
    )


def _mask_inputs(mask: Path | None) -> list[str]:
    """Path and digest of a mask, on which the first stage depends."""
    return [] if mask is None else [str(mask.resolve()), sha256_of(mask)]


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
            context.stages.remark("captures", f"period {period.label} has no usable photos")


def _new_period(captures: Captures) -> tuple[str, str | None]:
    """Label of all captures as one period, and its date by `period_date`."""
    periods = captures.periods
    label = periods[0].label if len(periods) == 1 else captures.root.name
    known = [c for c in captures.images if c.path in captures.undisputed]
    return label, period_date(label, [c.taken.date() for c in known if c.taken is not None])


def _as_new_period(captures: Sequence[Capture], scene: Scene, label: str) -> tuple[Capture, ...]:
    """Renumber captures as the period after those of a scene, under names new to the scene.

    They are still new to it where `place_photos` changes them.
    """
    taken = {f.name for f in scene.frames}
    new = []
    for capture in captures:
        name = capture.name if "/" in capture.name else f"{label}/{capture.name}"
        while not taken.isdisjoint((name, plain := re.sub(r"\s", "_", name), f"{plain}.png")):
            name = f"new/{name}"
        taken.add(name)
        new.append(replace(capture, name=name, period=scene.num_periods))
    return tuple(new)


def _place(
    captures: Sequence[Capture], scene: Scene | None, remarks: Sequence[str], context: Context
) -> tuple[list[str], list[str]]:
    """Place photos, those of the scene, and their masks in the work folder."""
    for folder in (context.photos, context.work / MASKS):
        shutil.rmtree(folder, ignore_errors=True)
    names, notes = place_photos(captures, context.photos)
    masks = dict(zip(names, (c.mask for c in captures), strict=True))
    for frame in scene.frames if scene else ():
        assert scene is not None
        _check_pinhole(scene, frame)
        path, target = scene.image_path(frame), context.photos / frame.name
        if _is_plain(path):
            place_image(path, target, "symlink")
        else:  # COLMAP and all that read the new scene go by the content, not by the extension
            target.parent.mkdir(parents=True, exist_ok=True)
            _convert(path, target, ExifData())
        masks[frame.name] = scene.masks.get(frame.name)
    found = {name: mask for name, mask in masks.items() if mask is not None}
    for name, mask in found.items():
        place_image(mask, context.work / mask_place(name), "symlink")
    if found:
        notes.append(f"masks of {counted(len(found), 'photo')}: no features where they are 0")
    return names, [*remarks, *notes]


def _locate(
    images: Sequence[Capture], scene: Scene | None, context: Context
) -> tuple[Positions, Georeference | None]:
    """Locate photos in the frame of the scene if it is georeferenced, else in their own."""
    frame = None if scene is None else local_frame(scene)
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
            expected="an undistorted image, of the same size as its camera",
            found=f"{camera.model} {camera.width} x {camera.height}, file {size[0]} x {size[1]}",
            todo=f"{way_to_pinhole(camera)} first",
        )


def drop_copies(
    captures: Sequence[Capture], digests: dict[str, str]
) -> tuple[tuple[Capture, ...], list[tuple[str, int, str]], list[str]]:
    """Keep one copy of each photo, that of the earliest period.

    A photo belongs to one date. The same file in two periods would link them by meaningless
    matches.

    Args:
        captures: Photos of all periods.
        digests: SHA-256 of their files, by name.

    Returns:
        kept: Captures, sorted by name.
        refused: Name, period and reason of each copy.
        remarks: For the log.
    """
    first: dict[str, Capture] = {}
    kept, refused = [], []
    for capture in sorted(captures, key=lambda c: (c.period, c.name)):
        original = first.setdefault(digests[capture.name], capture)
        if original is capture:
            kept.append(capture)
            continue
        where = "in an earlier period" if original.period != capture.period else "in this period"
        reason = f"the same file as {original.name} {where}: a photo belongs to one date"
        refused.append((capture.name, capture.period, reason))
    kept.sort(key=lambda c: c.name)
    across = sum("earlier period" in reason for *_, reason in refused)
    remarks = [f"{across} photos are copies of photos from an earlier period"] if across else []
    return tuple(kept), refused, remarks


def drop_saved_again(
    captures: Sequence[Capture],
) -> tuple[tuple[Capture, ...], list[tuple[str, int, str]], list[str]]:
    """Drop photos that are pictures of an earlier period, saved again by another program.

    Returns:
        What `drop_copies` does.
    """
    looks = [np.frombuffer(c.look, np.uint8).astype(np.float32) for c in captures]
    distinct = [i for i, look in enumerate(looks) if len(look) and look.std() > MIN_CONTRAST]
    stack = np.stack([looks[i] for i in distinct]) if distinct else np.zeros((0, 1), np.float32)
    period = np.array([captures[i].period for i in distinct], np.int64)
    refused = []
    for k, i in enumerate(distinct):
        rms = np.sqrt(np.mean((stack - stack[k]) ** 2, axis=1))
        alike = np.flatnonzero((rms < ALIKE) & (period < period[k]))
        same = [j for j in alike.tolist() if _same_picture(captures[distinct[j]], captures[i])]
        if same:
            first = captures[distinct[same[0]]].name
            reason = f"the same picture as {first}, saved again: a photo belongs to one date"
            refused.append((captures[i].name, captures[i].period, reason))
    gone = {name for name, *_ in refused}
    remarks = [f"pictures of an earlier period, saved again: {len(gone)}"] if gone else []
    return tuple(c for c in captures if c.name not in gone), refused, remarks


def _same_picture(a: Capture, b: Capture) -> bool:
    """Return True if two photos differ by their compression and size only."""
    grey = []
    for capture in (a, b):
        with Image.open(capture.path) as image:
            small = image.convert("L").resize((64, 64), Image.Resampling.BOX)
        grey.append(np.asarray(small, np.float64))
    return float(np.sqrt(np.mean((grey[0] - grey[1]) ** 2))) < SAME_PICTURE


def place_photos(captures: Sequence[Capture], folder: Path) -> tuple[list[str], list[str]]:
    """Place all captures below a folder.

    Returns:
        The name of each capture there, and remarks. Names differ only where a file is converted,
        or has blanks in its name.
    """
    names, turned, converted = [], 0, 0
    plain = plain_names([c.name for c in captures])
    for capture, name in zip(captures, plain, strict=True):
        target = place_photo(capture.path, folder / name, capture.exif)
        converted += target != folder / name
        turned += target == folder / name and not target.is_symlink()
        names.append(target.relative_to(folder).as_posix())
    remarks = []
    if turned:
        remarks.append(f"{turned} photos have an orientation tag: set to 1, pixels left as stored")
    if converted:
        remarks.append(f"{converted} files converted to PNG: COLMAP does not read them as they are")
    if renamings := sum(a != c.name for a, c in zip(plain, captures, strict=True)):
        remarks.append(f"spaces in the names of {renamings} photos replaced by underscores")
    return names, remarks


def place_photo(path: Path, target: Path, exif: ExifData) -> Path:
    """Place a photo where COLMAP reads the pixels that we do, in colour, and its focal length.

    Returns:
        ``target``, with another extension if the photo is converted. A link, where that will do.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if not _is_plain(path):
        target = target.with_name(f"{target.name}.png")
        _convert(path, target, exif)
    elif exif.orientation != 1 and path.suffix.lower() in (".jpg", ".jpeg"):
        data = path.read_bytes()
        with replacing(target) as partial:
            partial.write_bytes(set_upright(data) or data)
    else:
        place_image(path, target, "symlink")
    return target


def _convert(path: Path, target: Path, exif: ExifData) -> None:
    """Write a photo as PNG, with the tags of its lens."""
    image, mask = load_photo(path)
    if mask is not None:
        image[~mask] = 0  # nothing is to be found in what is transparent
    with replacing(target) as partial:
        Image.fromarray(image).save(partial, format="PNG", exif=lens_tags(exif))


def plain_names(names: Sequence[str]) -> list[str]:
    """Replace blanks, which COLMAP's lists and other loaders do not allow, in unique names."""
    taken, plain = set(names), []
    for name in names:
        new = re.sub(r"\s", "_", name)
        path = PurePosixPath(new)
        number = 2
        while new != name and new in taken:
            new = str(path.with_stem(f"{path.stem}_{number}"))
            number += 1
        taken.add(new)
        plain.append(new)
    return plain


def renamed(captures: Sequence[Capture], names: Sequence[str]) -> tuple[Capture, ...]:
    """Rename captures as `place_photos` did, and sort them."""
    changed = [replace(c, name=name) for c, name in zip(captures, names, strict=True)]
    return tuple(sorted(changed, key=lambda c: c.name))


def _is_plain(path: Path) -> bool:
    """Return True if COLMAP reads a file in colour, as it is stored."""
    with Image.open(path) as image:
        read = image.format in _READ_BY_COLMAP and image.mode in _PLAIN_MODES
        plain = read and getattr(image, "n_frames", 1) == 1
        turned_tiff = image.format == "TIFF" and image.getexif().get(_ORIENTATION, 1) != 1
    return plain and not turned_tiff
