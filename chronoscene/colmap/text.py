"""Text models, line by line, so that a finding can name the line.

Fields are separated by blanks. Cameras: ``id model width height params...``. Images take two lines:
``id qw qx qy qz tx ty tz camera_id name``, then ``x y point_id`` for each keypoint (an empty line
for none). Points: ``id x y z r g b error``, then ``image_id keypoint_index`` for each observation.
Rigs and frames: the fields of `chronoscene.colmap.binary`, a sensor is ``CAMERA <id>``. Empty lines
and lines that begin with ``#`` are skipped where a new record may begin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from chronoscene.arrays import Array, Ints
from chronoscene.colmap.raw_model import (
    CAMERA,
    IDENTITY,
    Damage,
    DamagedError,
    Pose,
    RawFrame,
    RawImages,
    RawPoints,
    RawRigs,
    Sensor,
)
from chronoscene.io.wording import quote
from chronoscene.scene.cameras import CAMERA_MODELS, Camera

BLOCK = 20_000  # Lines that are split into fields at a time, to bound the memory
MAX_DAMAGES = 100  # Damaged lines of one file that are listed

_IMAGE_LINE = '"<id> <qw> <qx> <qy> <qz> <tx> <ty> <tz> <camera id> <name>" separated by blanks'
_KEYPOINT_LINE = '"<x> <y> <point id>" for each keypoint'
_POINT_LINE = '"<id> <x> <y> <z> <r> <g> <b> <error>" and pairs "<image id> <keypoint>"'

Line = tuple[int, str]
"""Number from 1, and the text without surrounding blanks."""

Fields = deque[str]
"""Fields of a line, consumed from the left."""


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras in the order of the file.

    Raises:
        DamagedError: With every damaged line.
    """
    cameras, damages = [], []
    for number, line in _records(_lines(path)):
        camera = _camera(line.split())
        if isinstance(camera, Camera):
            cameras.append(camera)
        else:
            damages.append(_damage(path, (number, line), camera))
    _raise_any(damages)
    return tuple(cameras)


def _camera(fields: list[str]) -> Camera | str:
    """Parse the camera of a line; a string is the form that was expected."""
    if len(fields) < 4 or fields[1] not in CAMERA_MODELS:
        return '"<id> <model> <width> <height> <parameters>" with a model of COLMAP'
    count = len(CAMERA_MODELS[fields[1]].params)
    try:
        camera_id, width, height = (int(fields[i]) for i in (0, 2, 3))
        params = tuple(float(text) for text in fields[4:])
    except ValueError:
        return "numbers after the name of the camera model"
    if len(params) != count:
        return f"{count} parameters for {fields[1]}"
    if not 0 <= camera_id < 2**32:
        return "a camera id of 32 bits"
    return Camera(camera_id, fields[1], width, height, params)


def read_images(path: Path) -> RawImages:
    """Images in the order of the file.

    Raises:
        DamagedError: With every damaged line.
    """
    heads, names, keypoint_lines, damages = [], [], [], []
    lines = _lines(path)
    for number, line in _records(lines):
        keypoint_lines.append(next(lines, (number + 1, "")))
        fields = line.split(maxsplit=9)
        try:
            ids = float(int(fields[0])), float(int(fields[8]))
            heads.append([ids[0], *map(float, fields[1:8]), ids[1]])
            names.append(fields[9])
        except (ValueError, IndexError, OverflowError):
            damages.append(_damage(path, (number, line), _IMAGE_LINE))
    values, lengths = _numbers(path, keypoint_lines, _KEYPOINT_LINE, lambda n: n % 3 == 0, damages)
    _raise_any(damages)
    infinite = np.flatnonzero(~np.isfinite(values))
    rows = np.unique(np.searchsorted(np.cumsum(lengths), infinite, "right"))
    finite = "finite positions of keypoints"  # COLMAP stops reading at others
    _raise_any([_damage(path, keypoint_lines[row], finite) for row in rows])
    table = np.array(heads, np.float64).reshape(-1, 9)
    keypoints = values.reshape(-1, 3)
    return RawImages(
        ids=_integers(table[:, 0]),
        names=tuple(names),
        quaternions=table[:, 1:5],
        translations=table[:, 5:8],
        camera_ids=_integers(table[:, 8]),
        keypoint_start=np.concatenate([[0], np.cumsum(lengths // 3)]),
        keypoint_xy=np.ascontiguousarray(keypoints[:, :2]),
        keypoint_point=_integers(keypoints[:, 2]),
    )


def read_long_names(path: Path) -> dict[int, str]:
    """Names with blanks, by image id: COLMAP's own reader cuts them at the first blank."""
    names = {}
    lines = _lines(path)
    for _, line in _records(lines):
        next(lines, None)  # keypoints
        fields = line.split(maxsplit=9)
        if len(fields) == 10 and " " in fields[9] and fields[0].isdecimal():
            names[int(fields[0])] = fields[9]
    return names


def read_points(path: Path) -> RawPoints:
    """Points sorted by id.

    Raises:
        DamagedError: With every damaged line, or with duplicate ids.
    """
    damages: list[Damage] = []
    lines = list(_records(_lines(path)))
    values, lengths = _numbers(path, lines, _POINT_LINE, lambda n: n >= 8 and n % 2 == 0, damages)
    _raise_any(damages)
    start = np.concatenate([[0], np.cumsum(lengths)])
    heads = values[start[:-1, None] + np.arange(8)]
    rgb = heads[:, 4:7]
    is_colour = ((rgb >= 0) & (rgb <= 255) & (rgb == np.floor(rgb))).all(axis=1)
    bad = np.flatnonzero(~is_colour)
    _raise_any([_damage(path, lines[row], "a colour of three 0..255") for row in bad])
    order = np.argsort(heads[:, 0], kind="stable")
    ids = _integers(heads[order, 0])
    if len(twice := ids[1:][ids[1:] == ids[:-1]]):
        raise DamagedError(Damage(path.name, "each point once", f"point id {twice[0]} twice"))
    pairs = (lengths[order] - 8) // 2
    track_start = np.concatenate([[0], np.cumsum(pairs)])
    at = np.repeat(start[:-1][order] + 8 - 2 * track_start[:-1], pairs)
    at += 2 * np.arange(track_start[-1])
    return RawPoints(
        ids=ids,
        xyz=np.ascontiguousarray(heads[order, 1:4]),
        rgb=rgb[order].astype(np.uint8),
        error=heads[order, 7].copy(),
        track_start=track_start,
        track_image=_integers(values[at]),
        track_keypoint=_integers(values[at + 1]),
    )


def read_rigs(folder: Path) -> RawRigs | None:
    """``rigs.txt`` and ``frames.txt``; None where one is absent or damaged (COLMAP reports it)."""
    rigs, frames = folder / "rigs.txt", folder / "frames.txt"
    if not (rigs.is_file() and frames.is_file()):
        return None
    try:
        return RawRigs(dict(map(_rig, _fields(rigs))), tuple(map(_frame, _fields(frames))))
    except (OSError, ValueError, IndexError, OverflowError):
        return None


def _fields(path: Path) -> Iterator[Fields]:
    for line in path.read_text(encoding="utf-8").split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            yield deque(line.split())


def _rig(fields: Fields) -> tuple[int, dict[Sensor, Pose | None]]:
    rig_id, count = int(fields.popleft()), int(fields.popleft())
    sensors: dict[Sensor, Pose | None] = {}
    if count > 0:
        sensors[_sensor(fields)] = IDENTITY
    for _ in range(count - 1):  # ends with the fields
        sensor, known = _sensor(fields), int(fields.popleft())
        sensors[sensor] = _pose(fields) if known else None
    return rig_id, sensors


def _frame(fields: Fields) -> RawFrame:
    frame_id, rig_id = int(fields.popleft()), int(fields.popleft())
    pose, count = _pose(fields), int(fields.popleft())
    data = [(_sensor(fields), int(fields.popleft())) for _ in range(count)]
    return RawFrame(frame_id, rig_id, pose, tuple(data))


def _pose(fields: Fields) -> Pose:
    return tuple(float(fields.popleft()) for _ in range(7))


def _sensor(fields: Fields) -> Sensor:
    kind = fields.popleft()
    return (CAMERA if kind == "CAMERA" else 1), int(fields.popleft())


def _lines(path: Path) -> Iterator[Line]:
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    yield from ((i, line.strip()) for i, line in enumerate(text.split("\n"), start=1))


def _records(lines: Iterator[Line]) -> Iterator[Line]:
    """Iterate over lines that begin a record; the caller may take more lines from ``lines``."""
    for number, line in lines:
        if line and not line.startswith("#"):
            yield number, line


def _numbers(
    path: Path,
    lines: Sequence[Line],
    expected: str,
    fits: Callable[[int], bool],
    damages: list[Damage],
) -> tuple[Array, Ints]:
    """Parse all numbers of some lines, one after the other, and count those of each line.

    Lines that are not numbers, or of a number that does not fit, are added to ``damages``.
    """
    blocks, lengths = [np.zeros(0)], [np.zeros(0, np.int64)]
    for first in range(0, len(lines), BLOCK):
        block = lines[first : first + BLOCK]
        fields = [line.split() for _, line in block]
        counts = list(map(len, fields))
        try:
            blocks.append(np.array(list(chain.from_iterable(fields)), np.float64))
            bad = [i for i, count in enumerate(counts) if not fits(count)]
        except ValueError:
            bad = [i for i, row in enumerate(fields) if not (fits(len(row)) and _all_numbers(row))]
        damages.extend(_damage(path, block[i], expected) for i in bad)
        lengths.append(np.array(counts, np.int64))
    return np.concatenate(blocks), np.concatenate(lengths)


def _integers(values: Array) -> Ints:
    """Cast without a warning; values that are not finite become numbers that are no valid ids."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.int64)


def _all_numbers(fields: Sequence[str]) -> bool:
    try:
        np.array(fields, np.float64)
    except ValueError:
        return False
    return True


def _damage(path: Path, line: Line, expected: str) -> Damage:
    return Damage(f"{path.name}:{line[0]}", expected, quote(line[1]))


def _raise_any(damages: list[Damage]) -> None:
    if len(damages) > MAX_DAMAGES:
        file = damages[0].file.split(":")[0]
        more = Damage(file, "records", f"{len(damages) - MAX_DAMAGES} more damaged lines")
        raise DamagedError(*damages[:MAX_DAMAGES], more)
    if damages:
        raise DamagedError(*damages)
