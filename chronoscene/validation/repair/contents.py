"""Corrected contents of files: the model, ``split.txt`` and ``test.txt``.

Only what has a single possible correction is corrected. Lines that contradict each other, match
several images or cannot be parsed stay as they are: only people know what they mean.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from chronoscene.colmap.raw_model import RawImages, RawPoints
from chronoscene.io.wording import counted
from chronoscene.scene.splits import NameEntry, NameIndex, SplitEntry, parse_split_text
from chronoscene.validation.folder.names import PUNCTUATION, Spellings, spelling
from chronoscene.validation.folder.observations import good_poses, observe
from chronoscene.validation.rules.cs1_poses import UNIT_TOLERANCE
from chronoscene.validation.rules.cs4_periods import doubtful_ids

MIN_KEPT = 0.5
"""Share of the points that must have two observations; otherwise points without tracks are what the
model consists of, as in a laser scan, and stay."""


class Repair(NamedTuple):
    """One thing that was corrected."""

    code: str
    """Code of the rule whose finding is corrected."""
    text: str


def _note(repairs: list[Repair], code: str, number: int, noun: str, what: str) -> None:
    """Add what was done to a number of things, if there were any."""
    if number:
        repairs.append(Repair(code, f"{counted(number, noun)} {what}"))


def repair_model(images: RawImages, points: RawPoints) -> tuple[RawImages, RawPoints, list[Repair]]:
    """A corrected model, and what was done."""
    repairs: list[Repair] = []
    before = points
    images = _unit_quaternions(images, repairs)
    points = _without_broken_observations(images, points, repairs)
    keep = points.finite
    if gone := int(np.count_nonzero(~keep)):
        _note(repairs, "CS502", gone, "point", "without finite coordinates removed")
        points = points.select(keep)
    long = np.diff(points.track_start) >= 2
    if not long.all() and np.count_nonzero(long) >= MIN_KEPT * len(points):
        gone = int(np.count_nonzero(~long))
        _note(repairs, "CS503", gone, "point", "with fewer than two observations removed")
        points = points.select(long)
    return _without_points(images, before, points), points, repairs


def _unit_quaternions(images: RawImages, repairs: list[Repair]) -> RawImages:
    norm = np.where(good_poses(images), np.linalg.norm(images.quaternions, axis=1), 1.0)
    number = int(np.count_nonzero(np.abs(norm - 1) > UNIT_TOLERANCE))
    _note(repairs, "CS122", number, "quaternion", "normalised")
    return replace(images, quaternions=images.quaternions / norm[:, None]) if number else images


def _without_broken_observations(
    images: RawImages, points: RawPoints, repairs: list[Repair]
) -> RawPoints:
    if len(np.unique(images.ids)) < len(images):
        return points  # of two images with one id, one has the observations of both
    seen = observe(images, points)
    finite = np.asarray(np.isfinite(images.keypoint_xy).all(axis=1))
    exists = seen.valid
    sound = exists.copy()
    sound[exists] = finite[seen.keypoint[exists]]
    for code, bad, what in (
        ("CS504", ~exists, "of images or keypoints that do not exist"),
        ("CS510", exists & ~sound, "at positions that are not finite"),
    ):
        _note(repairs, code, int(np.count_nonzero(bad)), "observation", f"{what} removed")
    if sound.all():
        return points
    lengths = np.bincount(seen.point[sound], minlength=len(points))
    return replace(
        points,
        track_start=np.concatenate([[0], np.cumsum(lengths)]),
        track_image=points.track_image[sound],
        track_keypoint=points.track_keypoint[sound],
    )


def _without_points(images: RawImages, before: RawPoints, after: RawPoints) -> RawImages:
    """Detach keypoints from removed points; other disagreement stays as it is."""
    gone = np.setdiff1d(before.ids, after.ids)
    broken = ~np.isfinite(images.keypoint_xy).all(axis=1)
    cleared = np.isin(images.keypoint_point, gone) | (broken & (images.keypoint_point >= 0))
    if not cleared.any():
        return images
    return replace(images, keypoint_point=np.where(cleared, -1, images.keypoint_point))


def repair_split(
    data: bytes,
    text: str,
    names: Sequence[str],
    labelled: Sequence[int] | None,
    others: Sequence[str] = (),
) -> tuple[str, dict[int, int], list[Repair]]:
    """A corrected ``split.txt``.

    Args:
        data: The file.
        text: The decoded file.
        names: Full names of the registered images.
        labelled: Ids in ``periods.json``; None if it is absent.
        others: Impossible image names in the model, whose lines stay.

    Returns:
        The new text; new ids by the old ones; what was done.
    """
    repairs = _line_repairs(data, text)
    entries, problems = parse_split_text(text)
    new_ids = _new_ids(entries, labelled, complete=not problems)
    if any(old != new for old, new in new_ids.items()):
        listed = ", ".join(f"{old} is now {new}" for old, new in list(new_ids.items())[:10])
        repairs.append(Repair("CS401", f"periods numbered from 0: {listed}"))
    lines, unknown, twice, misspelt = _split_lines(text, names, entries, new_ids, others)
    index = NameIndex(names)
    known = set(names)
    short = sum(len(index.find(e.name)) == 1 and e.name not in known for e in entries)
    _note(repairs, "", short, "name", "written in full")
    _note(repairs, "CS305", misspelt, "name", "corrected as in the model")
    _note(repairs, "CS309", unknown, "line", "on images that are not in the model removed")
    _note(repairs, "CS308", twice, "repeated line", "removed")
    return "".join(f"{line}\n" for line in lines if line), new_ids, repairs


def _new_ids(
    entries: Sequence[SplitEntry], labelled: Sequence[int] | None, *, complete: bool
) -> dict[int, int]:
    """Number periods from 0, unless an id may be a typing error, or missing because of one."""
    ids = sorted({entry.period for entry in entries})
    certain = not doubtful_ids(entries) if labelled is None else sorted(labelled) == ids
    return {old: new if certain and complete else old for new, old in enumerate(ids)}


def _split_lines(
    text: str,
    names: Sequence[str],
    entries: Sequence[SplitEntry],
    new_ids: Mapping[int, int],
    others: Sequence[str],
) -> tuple[list[str], int, int, int]:
    """New lines; numbers of lines on unknown images, of repeated lines and of misspelt names."""
    index = NameIndex(names)
    by_line = {entry.line: (entry, index.find(entry.name)) for entry in entries}
    listed = {fits[0] for _, fits in by_line.values() if len(fits) == 1}
    spellings, impossible = Spellings(set(names) - listed), Spellings(others)
    for number, (entry, fits) in by_line.items():
        if not fits and (name := _meant(spellings, entry.name)) is not None:
            by_line[number] = (entry, [name])
    used = {entry.period for entry, fits in by_line.values() if len(fits) == 1}
    placed = {fits[0] for _, fits in by_line.values() if len(fits) == 1}
    if set(names) - placed:
        used = set()  # lines on unknown images may be about images without a line
    lines: list[str] = []
    unknown = twice = misspelt = 0
    done: set[tuple[str, int]] = set()
    for number, line in enumerate(re.split("\r\n|\r|\n", text), start=1):
        if number not in by_line:
            lines.append(" ".join(line.split()))
            continue
        entry, fits = by_line[number]
        name = _one_name(fits, entry.name)
        if not fits and entry.period in used and impossible.find(entry.name) is None:
            unknown += 1
        elif (name, entry.period) in done:
            twice += 1
        else:
            done.add((name, entry.period))
            misspelt += not index.find(entry.name) and bool(fits)
            lines.append(f"{name} {new_ids[entry.period]}")
    return lines, unknown, twice, misspelt


def _line_repairs(data: bytes, text: str) -> list[Repair]:
    repairs = []
    if data[:3] == b"\xef\xbb\xbf" or data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        repairs.append(Repair("CS701", "saved as UTF-8 without a byte order mark"))
    if "\r" in text:
        repairs.append(Repair("CS310", "Unix line endings"))
    lines = re.split("\r\n|\r|\n", text)
    odd = sum(line != " ".join(line.split()) for line in lines)
    odd += sum(not line.strip() for line in lines[:-1])
    if odd:
        repairs.append(Repair("CS701", f"spaces, tabs and empty lines in {counted(odd, 'line')}"))
    return repairs


def plain_table(text: str, names: Sequence[str]) -> tuple[str, list[Repair]]:
    """Replace commas, semicolons and quotes by spaces in lines whose name is an image."""
    index, spellings = NameIndex(names), Spellings(names)
    lines, changed, code = re.split("(\r\n|\r|\n)", text), 0, ""
    for i in range(0, len(lines), 2):
        found = re.fullmatch(r"\s*[\"']?(.+?)[\"']?\s*[,;]\s*[\"']?([0-9]{1,9})[\"']?\s*", lines[i])
        if found and (index.find(found[1]) or _meant(spellings, found[1])):
            code = "CS305" if len(lines[i].split()) > 1 else "CS303"  # as reported
            lines[i] = f"{found[1]} {found[2]}"
            changed += 1
    what = f"spaces instead of commas in {counted(changed, 'line')}"
    return "".join(lines), [Repair(code, what)] if changed else []


def _meant(spellings: Spellings, text: str) -> str | None:
    """The image that a name means up to case, Unicode form, quotes or folders above it."""
    name, full = spellings.find(text), spelling(text.strip(PUNCTUATION))
    if name is None:
        return None
    known = spelling(name)
    same = full in (known, known.rpartition("/")[2]) or full.endswith(f"/{known}")
    return name if same else None


def repair_test(
    names: Sequence[str], entries: Sequence[NameEntry]
) -> tuple[list[str], list[Repair]]:
    """Corrected lines of ``test.txt``; unchanged if none is an image of the model."""
    index, spellings = NameIndex(names), Spellings(names)
    lines: dict[str, None] = {}
    known = set(names)
    unknown = renamed = short = 0
    for entry in entries:
        fits = index.find(entry.name)
        short += len(fits) == 1 and entry.name not in known
        for text in (entry.name, entry.name.rsplit(maxsplit=1)[0]):  # some append the period
            if not fits and (name := _meant(spellings, text)) is not None:
                fits, renamed = [name], renamed + 1
        if fits:
            lines[_one_name(fits, entry.name)] = None
        else:
            unknown += 1
    if not lines:
        return [entry.name for entry in entries], []
    repairs: list[Repair] = []
    _note(repairs, "", short, "name", "in test.txt written in full")
    _note(repairs, "CS324", renamed, "name", "corrected as in the model")
    _note(repairs, "CS324", unknown, "line", "on images that are not in the model removed")
    _note(repairs, "", len(entries) - unknown - len(lines), "repeated line", "removed")
    return list(lines), repairs


def _one_name(fits: Sequence[str], name: str) -> str:
    """The full name, if only one matches and survives being written on a line."""
    if len(fits) != 1 or fits[0] != fits[0].strip() or "\n" in fits[0] or "\r" in fits[0]:
        return name
    return fits[0]
