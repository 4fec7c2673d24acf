"""Smaller scenes: images, periods and points are left out, periods and images renamed.

What is left stays as it was: poses, cameras, split, masks, labels, dates, world, ids of images and
points. The observations of dropped images go, and with them the points that keep fewer than two.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.checks import nearest
from chronoscene.colmap.model import read_model
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import DetectedFormat
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared.colmap_layout import keep_images, write_renamed
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.documents import read_text
from chronoscene.io.wording import shown
from chronoscene.scene import Period, Points, Scene, splits
from chronoscene.scene.splits import NameIndex

Box = tuple[float, float, float, float, float, float]
"""Smallest and largest x, y and z: xmin, ymin, zmin, xmax, ymax, zmax."""

MIN_VIEWS = 2  # Observations that a point needs to have a position


@dataclass(frozen=True, slots=True)
class Edits:
    """Choices of what to leave out and rename. An image stays if all choices allow it."""

    keep: tuple[str, ...] = ()
    """Names or patterns of the only images to keep; none to keep all."""
    drop: tuple[str, ...] = ()
    """Names or patterns of images."""
    keep_periods: tuple[str, ...] = ()
    """Labels or ids of the only periods to keep; none to keep all."""
    drop_periods: tuple[str, ...] = ()
    """Labels or ids."""
    crop: Box | None = None
    """Points outside of this box go, and so do images that observed points, but none in it."""
    rename: Mapping[str, str] = field(default_factory=dict)
    """New labels of periods, by label or id, and new names of images. Periods of one label become
    one period."""


@dataclass(frozen=True, slots=True, eq=False)
class Edited:
    """The result of an edit."""

    scene: Scene
    """The new scene."""
    names: Mapping[str, str]
    """Names of its images in the files of the new scene, by those that they had."""
    images_dropped: int
    images_outside: int
    """Images among them that see nothing in the box."""
    points_outside: int
    points_unseen: int
    """Points that lost observations and have fewer than `MIN_VIEWS` left."""
    renamed: bool
    """True if periods or images have other names, also where ids in place of labels moved up."""


def read_for_edit(detected: DetectedFormat, edits: Edits) -> tuple[Scene, Edits, int, int]:
    """Read a scene, without the images to drop if it cannot be read because of them.

    Returns:
        The scene, what is left to do, and the numbers of images and of points that were left out
        already.

    Raises:
        SceneError: If it cannot be read without them either.
    """
    try:
        return detected.read(), edits, 0, 0
    except SceneError:
        if detected.name != our_format.NAME or not edits.drop:
            raise
        model = read_model(detected.path / our_format.MODEL)
        names = [image.name for image in model.images]
        dropped = find_images(names, edits.drop, "--drop")
        left = keep_images(model, set(names) - dropped)
        scene = our_format.read(detected.path, model=left, empty_periods=True)
        scene = _with_split_of_all(scene, names)
        unseen = _lost_views(model.points, left.points)
        scene = replace(scene, points=scene.points.select(~unseen))
        return scene, replace(edits, drop=()), len(dropped), int(np.count_nonzero(unseen))


def _with_split_of_all(scene: Scene, names: Sequence[str]) -> Scene:
    """Give images the split that they have by the default rule over all names of the model."""
    if scene.split_rule != splits.DEFAULT_RULE:
        return scene
    entries, _ = splits.parse_split_text(read_text(scene.root / our_format.SPLIT))
    tests = splits.default_tests(splits.assign_periods(names, entries)[0])
    return scene.with_frames(
        [replace(f, split=splits.split_of(f.name, tests)) for f in scene.frames]
    )


def edit(
    scene: Scene,
    out: Path,
    edits: Edits,
    *,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> Edited:
    """Write an edited scene in the ChronoScene format.

    Args:
        scene: Any scene; its images need not exist where they are dropped.
        out: Folder that does not exist yet, or is empty.
        edits: What to change.
        image_source: Copy or link the images.
        progress: Called after each image.

    Raises:
        ConfigError: If a name is unknown, or nothing would be left.
        SceneError: If ``out`` is in use, or an image is missing.
    """
    done = apply(scene, edits)
    write_renamed(
        done.scene,
        out,
        done.names,
        texts=our_format.TEXTS,
        image_source=image_source,
        progress=progress,
    )
    return replace(done, scene=our_format.read(out))


def apply(scene: Scene, edits: Edits) -> Edited:
    """Edit a scene in memory; images keep their names.

    Raises:
        ConfigError: If a name is unknown, or nothing would be left.
    """
    kept = _kept_images(scene, edits)
    _check_left(kept, "--keep and --drop", "leave out fewer images or periods")
    inside = np.ones(len(scene.points), bool)
    seeing = kept
    if edits.crop is not None:
        inside = _inside(scene.points, edits.crop)
        seeing = kept & ~_sees_only_outside(scene.points, inside, len(kept))
        _check_left(seeing, "--crop", "choose a larger box")
    points, unseen = _points_of(scene.points, inside, seeing)
    frames = tuple(f for f, stays in zip(scene.frames, seeing.tolist(), strict=True) if stays)
    labels, images = _renames(scene, edits.rename)
    left = {f.period for f in frames}
    periods, number = _merged([p for p in scene.periods if p.id in left], labels)
    new = replace(
        scene,
        frames=tuple(replace(f, period=number[f.period]) for f in frames),
        points=points,
        periods=periods,
        masks={f.name: scene.masks[f.name] for f in frames if f.name in scene.masks},
    )
    return Edited(
        scene=new,
        names={f.name: images.get(f.name, f.name) for f in frames},
        images_dropped=len(scene.frames) - len(frames),
        images_outside=int(np.count_nonzero(kept & ~seeing)),
        points_outside=int(np.count_nonzero(~inside)),
        points_unseen=unseen,
        renamed=bool(edits.rename)
        or any(p.label != periods[number[p.id]].label for p in scene.periods if p.id in left),
    )


def _kept_images(scene: Scene, edits: Edits) -> NDArray[np.bool_]:
    """Return True for the images that all choices of names and periods allow. [F]"""
    names = [frame.name for frame in scene.frames]
    kept = np.ones(len(names), bool)
    for option, patterns in (("--keep", edits.keep), ("--drop", edits.drop)):
        if patterns:
            found = np.isin(names, list(find_images(names, patterns, option)))
            kept &= found if option == "--keep" else ~found
    for option, texts in (
        ("--keep-period", edits.keep_periods),
        ("--drop-period", edits.drop_periods),
    ):
        if texts:
            chosen = list(chosen_periods(scene, texts, option))
            found = np.isin(scene.frame_periods, chosen)
            kept &= found if option == "--keep-period" else ~found
    return kept


def find_images(names: Sequence[str], patterns: Iterable[str], option: str) -> set[str]:
    """Find images by name, by pattern (``a/*.jpg``), or by file name as in ``split.txt``.

    Raises:
        ConfigError: If a text matches nothing, or is a file name of several images.
    """
    index, known, found = NameIndex(names), set(names), set[str]()
    for text in patterns:
        if text in known:
            fits = [text]
        elif any(c in text for c in "*?["):
            fits = [name for name in names if fnmatchcase(name, text)]
        else:
            fits = index.find(text)
            if len(fits) > 1:
                raise ConfigError(
                    option,
                    expected="a name of one image, or a pattern with *",
                    found=f"{text!r}, which matches {shown(fits)}",
                    todo="write the full names below images/",
                )
        if not fits:
            todo = nearest(text, names, otherwise="write names below images/, or patterns with *")
            raise ConfigError(option, expected="the name of an image", found=repr(text), todo=todo)
        found.update(fits)
    return found


def _find_periods(scene: Scene, text: str) -> set[int]:
    """Find periods by their label, else by their id."""
    by_label = {p.id for p in scene.periods if p.label == text}
    return by_label or {p.id for p in scene.periods if str(p.id) == text}


def chosen_periods(scene: Scene, texts: Iterable[str], option: str) -> set[int]:
    """Find all periods that an option names.

    Raises:
        ConfigError: If there is none of a name; lists the periods.
    """
    chosen = set[int]()
    for text in texts:
        found = _find_periods(scene, text)
        if not found:
            labels = [p.label for p in scene.periods]
            listed = ", ".join(p.title for p in scene.periods)
            todo = nearest(text, labels, otherwise="choose one of them")
            raise ConfigError(option, expected=f"a period: {listed}", found=repr(text), todo=todo)
        chosen |= found
    return chosen


def _inside(points: Points, box: Box) -> NDArray[np.bool_]:
    """Return True for points in a box or on its faces. [P]

    Raises:
        ConfigError: If there is none.
    """
    low, high = np.array(box[:3]), np.array(box[3:])
    inside = np.asarray(((points.xyz >= low) & (points.xyz <= high)).all(axis=1))
    if not inside.any():
        finite = points.xyz[points.finite]
        found = "none"
        if len(finite):
            found += " of those between " + " and ".join(
                ",".join(f"{x:.4g}" for x in corner) for corner in (finite.min(0), finite.max(0))
            )
        raise ConfigError(
            "--crop",
            expected="points in the box",
            found=found,
            todo="choose a box in the world of the scene: chronoscene stats --pages shows it",
        )
    return inside


def _sees_only_outside(points: Points, inside: NDArray[np.bool_], frames: int) -> NDArray[np.bool_]:
    """Return True for images that observe points, but none of those inside. [F]"""
    counted = np.repeat(inside, np.diff(points.track_start))
    some = np.bincount(points.track_frame, minlength=frames) > 0
    return some & (np.bincount(points.track_frame[counted], minlength=frames) == 0)


def _points_of(
    points: Points, inside: NDArray[np.bool_], frames: NDArray[np.bool_]
) -> tuple[Points, int]:
    """Keep points inside that the kept frames see; also count those that lost their views."""
    rank = (np.cumsum(frames) - 1).astype(np.int32)
    left = points.select_observations(frames[points.track_frame], rank)
    unseen = inside & _lost_views(points, left)
    return left.select(inside & ~unseen), int(np.count_nonzero(unseen))


def _lost_views(before: Points, after: Points) -> NDArray[np.bool_]:
    """Return True for points that lost observations and have fewer than `MIN_VIEWS` left. [P]"""
    old, new = np.diff(before.track_start), np.diff(after.track_start)
    return np.asarray((new < old) & (new < MIN_VIEWS))


def _renames(scene: Scene, rename: Mapping[str, str]) -> tuple[dict[int, str], dict[str, str]]:
    """Separate new labels, by the ids of the periods, and new names of images, by the old ones.

    Raises:
        ConfigError: If there is neither a period nor an image of a name, or a label is blank.
    """
    names = {f.name for f in scene.frames}
    labels: dict[int, str] = {}
    images: dict[str, str] = {}
    for old, new in rename.items():
        if not new.strip():
            todo = "write OLD=NEW"
            raise ConfigError("--rename", expected="a new name", found=f"{old}={new}", todo=todo)
        if periods := _find_periods(scene, old):
            labels |= dict.fromkeys(periods, new)
        elif old in names:
            images[old] = new
        else:
            known = [*(p.label for p in scene.periods), *names]
            todo = nearest(old, known, otherwise="write labels or ids, or names below images/")
            raise ConfigError(
                "--rename", expected="a period or an image", found=repr(old), todo=todo
            )
    return labels, images


def _merged(
    periods: Sequence[Period], labels: Mapping[int, str]
) -> tuple[tuple[Period, ...], dict[int, int]]:
    """Rename and number periods; those that have one of the new labels in common are merged.

    Returns:
        The periods, and the new id of each old one.
    """
    new_labels = set(labels.values())
    groups: dict[str | int, list[Period]] = {}
    for period in periods:
        label = labels.get(period.id, period.label)
        groups.setdefault(label if label in new_labels else period.id, []).append(period)
    merged: list[Period] = []
    number: dict[int, int] = {}
    for i, (key, group) in enumerate(groups.items()):
        label = key if isinstance(key, str) else group[0].label
        if any(p.label == label == str(p.id) for p in group):
            label = str(i)  # an id in place of a label follows the new numbers
        merged.append(Period(i, label, _common_date([p.date for p in group])))
        number |= {p.id: i for p in group}
    return tuple(merged), number


def _common_date(dates: Sequence[str | None]) -> str | None:
    """Day, month or year that all dates share; None if there is none, or one is not known."""
    for length in (10, 7, 4):
        shared = {date and date[:length] for date in dates}
        if len(shared) == 1:
            return shared.pop()
    return None


def _check_left(kept: NDArray[np.bool_], option: str, todo: str) -> None:
    if not kept.any():
        raise ConfigError(option, expected="an image that stays", found="none", todo=todo)
