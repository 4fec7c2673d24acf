"""Point clouds in PLY files: the vertices with their colours, nothing else.

plyfile reads headers and writes files. The vertices are read here, because plyfile takes text value
by value, reads whatever follows the vertices, and reserves memory for all elements that a header
announces.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from chronoscene.errors import SceneError
from chronoscene.io.documents import plain_file
from chronoscene.scene import Points

MAX_HEADER_BYTES = 100_000
COLOURS = ("red", "green", "blue")


def read_points(path: Path) -> Points:
    """Points of a PLY file, with ids 1, 2, ... and without observations.

    Raises:
        SceneError: If the file is missing, damaged, or not a cloud of finite points.
    """
    try:
        with plain_file(path).open("rb") as file:
            vertices = _read_vertices(path, file)
    except OSError as error:
        raise _error(path, "a PLY file", error.strerror or "an error") from error
    return _to_points(path, vertices)


def count_vertices(path: Path) -> int:
    """Number of vertices of a PLY file, whatever they have; reads the header alone.

    Raises:
        SceneError: If it is no such file.
    """
    try:
        with plain_file(path).open("rb") as file:
            return _read_header(path, file)[1]
    except OSError as error:
        raise _error(path, "a PLY file", error.strerror or "an error") from error


def write_points(path: Path, points: Points) -> None:
    """Write positions (double) and colours as a binary PLY file."""
    write_vertices(path, points.xyz, points.rgb)


def write_vertices(
    path: Path,
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    comments: Sequence[str] = (),
    **columns: NDArray[Any],
) -> None:
    """Write positions (double), colours, and further columns as a binary PLY file.

    Args:
        path: The file.
        xyz: [N, 3]
        rgb: [N, 3]
        comments: For the header.
        columns: By their names; of a type that PLY has. [N]
    """
    columns = (
        dict(zip("xyz", xyz.T, strict=True)) | dict(zip(COLOURS, rgb.T, strict=True)) | columns
    )
    vertices = np.empty(len(xyz), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        vertices[name] = column
    element = PlyElement.describe(vertices, "vertex")
    PlyData([element], byte_order="<", comments=list(comments)).write(path)


def _read_header(path: Path, file: BinaryIO) -> tuple[bool, int, np.dtype]:
    """Return True for text, the number of vertices, their record; stop at the first vertex."""
    start = file.read(MAX_HEADER_BYTES)
    if not re.match(rb"ply\s*\n", start):
        raise _error(path, 'a PLY file, whose first line is "ply"', "a different first line")
    found = re.search(rb"\nend_header[ \t\r]*\n", start)
    if found is None:
        raise _error(path, "a header of PLY", "no end_header")
    file.seek(found.end())
    lines = [line.strip() for line in start[: found.end()].decode("ascii", "replace").split("\n")]
    counts: dict[str, int] = {}
    for i, line in enumerate(lines):
        if line.startswith("element"):
            element = re.fullmatch(r"element\s+(\S+)\s+([0-9]{1,100})", line)
            if element is None:
                raise _error(path, "elements with a name and a number", repr(line[:40]))
            counts.setdefault(element[1], int(element[2]))
            lines[i] = f"element {element[1]} 0"  # plyfile gets the header alone
    try:
        header = PlyData.read(io.BytesIO("\n".join(lines).encode("ascii", "replace")))
    except (PlyParseError, ValueError) as error:
        raise _error(path, "a header of PLY", str(error)) from error
    if "vertex" not in counts:
        raise _error(path, "vertices with x, y and z", "none")
    first = next((name for name, count in counts.items() if count or name == "vertex"))
    if first != "vertex":
        raise _error(path, "vertices as the first element", repr(first))
    properties = header["vertex"].properties
    names = [p.name for p in properties]
    if any(isinstance(p, PlyListProperty) for p in properties):
        raise _error(path, "numbers as properties of vertices", "a list")
    if not {"x", "y", "z"} <= set(names):
        raise _error(path, "vertices with x, y and z", ", ".join(names[:8]) or "none")
    order = "=" if header.text else header.byte_order
    return header.text, counts["vertex"], np.dtype([(p.name, p.dtype(order)) for p in properties])


def _read_vertices(path: Path, file: BinaryIO) -> NDArray[np.void]:
    is_text, count, dtype = _read_header(path, file)
    names = dtype.names or ()
    left = path.stat().st_size - file.tell()
    min_size = 2 * len(names) if is_text else dtype.itemsize
    if left + is_text < count * min_size:  # the last line of a text may have no end
        raise _error(path, f"{count} vertices", f"{left} bytes after the header")
    if not is_text:
        return np.frombuffer(file.read(count * dtype.itemsize), dtype, count)
    vertices = np.zeros(count, dtype)
    values = _read_table(path, file, count, len(names)) if count else np.zeros((0, len(names)))
    for i, name in enumerate(names):
        kind = dtype[name]
        if kind.kind in "iu" and not _fits(values[:, i], np.iinfo(kind)):
            raise _error(path, f"whole numbers of type {kind} as {name}", "other values")
        with np.errstate(over="ignore"):  # infinite then, and refused where it matters
            vertices[name] = values[:, i]
    return vertices


def _read_table(path: Path, file: BinaryIO, rows: int, columns: int) -> NDArray[np.float64]:
    """Numbers of a text, a vertex on each line. [rows, columns]"""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there are none: they are counted below
            values = np.loadtxt(
                file,
                comments=None,
                usecols=range(columns),
                max_rows=rows,
                ndmin=2,
                encoding="ascii",
            )
    except ValueError as error:  # UnicodeDecodeError is one
        raise _error(path, f"{columns} numbers for each vertex", "a different line") from error
    if values.shape != (rows, columns):
        raise _error(path, f"{rows} vertices", f"{len(values)} lines with numbers")
    return values


def _fits(values: NDArray[np.float64], limits: np.iinfo) -> bool:
    return bool(((values >= limits.min) & (values <= limits.max)).all())


def _to_points(path: Path, vertices: NDArray[np.void]) -> Points:
    with np.errstate(invalid="ignore"):  # NaN is refused next
        xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    if not np.isfinite(xyz).all():
        raise _error(path, "finite positions", "NaN or infinity")
    rgb = np.full((len(xyz), 3), 128, np.uint8)  # grey for points without a colour
    if set(COLOURS) <= set(vertices.dtype.names or ()):
        colours = [vertices[c] for c in COLOURS]
        if any(c.dtype != np.uint8 for c in colours):
            raise _error(path, "colours of type uchar, 0..255", str(colours[0].dtype))
        rgb = np.stack(colours, axis=-1)
    return replace(
        Points.empty(),
        ids=np.arange(1, len(xyz) + 1),
        xyz=xyz,
        rgb=rgb,
        error=np.full(len(xyz), -1.0),  # what COLMAP stores where no error was computed
        track_start=np.zeros(len(xyz) + 1, np.int64),
    )


def _error(path: Path, expected: str, found: str) -> SceneError:
    return SceneError(path, expected=expected, found=found, todo="write the point cloud again")
