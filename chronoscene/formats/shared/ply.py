"""Point clouds in PLY files: the vertices with their colours, nothing else."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import SceneError
from chronoscene.scene import Points

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
"""Type names of PLY, old and new, as numpy writes them without the byte order."""

BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}

MOST_HEADER_LINES = 1000

UNKNOWN_COLOUR = 128
"""Grey for points without a colour, in each channel."""

UNKNOWN_ERROR = -1.0
"""What COLMAP stores where no reprojection error was computed."""


def read_points(path: Path) -> Points:
    """Points of a PLY file, with ids 1, 2, ... and without observations.

    Raises:
        SceneError: If the file is missing, damaged, or not a cloud of finite points.
    """
    try:
        with path.open("rb") as file:
            form, count, dtype = _read_header(path, file)
            vertices = _read_vertices(path, file, form, count, dtype)
    except OSError as error:
        raise _error(path, "a PLY file", error.strerror or "an error") from error
    return _to_points(path, vertices)


def write_points(path: Path, points: Points) -> None:
    """Write positions (double) and colours as a binary PLY file."""
    vertices = np.empty(
        len(points),
        [*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))],
    )
    for i, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[colour] = points.xyz[:, i], points.rgb[:, i]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header = "\n".join([*lines, "end_header", ""])
    path.write_bytes(header.encode() + vertices.tobytes())


def _read_header(path: Path, file: BinaryIO) -> tuple[str, int, np.dtype]:
    """Format, number of vertices and their record; leaves the file at the first vertex."""
    if file.readline(100).strip() != b"ply":
        raise _error(path, 'a PLY file, whose first line is "ply"', "another")
    form, element, count = "", "", -1
    fields: list[tuple[str, str]] = []
    for _ in range(MOST_HEADER_LINES):
        match file.readline(1000).decode("ascii", "replace").split():
            case ["end_header"]:
                return form, count, _record(path, form, count, fields)
            case ["format", form, _]:
                pass
            case ["element", element, number] if number.isdecimal():
                if element == "vertex":
                    count = int(number)
                elif count < 0 and number != "0":
                    raise _error(path, "vertices as the first element", repr(element))
            case ["property", kind, name] if element == "vertex" and kind in TYPES:
                fields.append((name, TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise _error(path, "numbers as properties of vertices", "a list or unknown type")
    raise _error(path, "a header of PLY", "none that ends")


def _record(path: Path, form: str, count: int, fields: list[tuple[str, str]]) -> np.dtype:
    names = [name for name, _ in fields]
    if form not in BYTE_ORDERS:
        raise _error(path, f"a format {', '.join(BYTE_ORDERS)}", repr(form))
    if count < 0 or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise _error(path, "vertices with x, y and z", ", ".join(names[:8]) or "none")
    return np.dtype([(name, BYTE_ORDERS[form] + kind) for name, kind in fields])


def _read_vertices(
    path: Path, file: BinaryIO, form: str, count: int, dtype: np.dtype
) -> NDArray[np.void]:
    left = path.stat().st_size - file.tell()
    least = 2 * len(dtype.names or ()) if form == "ascii" else dtype.itemsize
    if left + (form == "ascii") < count * least:  # the last line of a text may have no end
        raise _error(path, f"{count} vertices", f"{left} bytes after the header")
    if form != "ascii":
        return np.frombuffer(file.read(count * dtype.itemsize), dtype, count)
    vertices = np.zeros(count, dtype)
    names = dtype.names or ()
    values = _read_table(path, file, count, len(names)) if count else np.zeros((0, len(names)))
    for i, name in enumerate(names):
        kind = dtype[name]
        if kind.kind in "iu" and not _fits(values[:, i], np.iinfo(kind)):
            raise _error(path, f"whole numbers of type {kind} as {name}", "others")
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
        raise _error(path, f"{columns} numbers for each vertex", "another line") from error
    if values.shape != (rows, columns):
        raise _error(path, f"{rows} vertices", f"{len(values)} lines with numbers")
    return values


def _fits(values: NDArray[np.float64], limits: np.iinfo) -> bool:
    return bool(((values >= limits.min) & (values <= limits.max)).all())


def _to_points(path: Path, vertices: NDArray[np.void]) -> Points:
    names = vertices.dtype.names or ()
    with np.errstate(invalid="ignore"):  # NaN is refused next
        xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    if not np.isfinite(xyz).all():
        raise _error(path, "finite positions", "NaN or infinity")
    rgb = np.full((len(xyz), 3), UNKNOWN_COLOUR, np.uint8)
    if {"red", "green", "blue"} <= set(names):
        colours = [vertices[c] for c in ("red", "green", "blue")]
        if any(c.dtype != np.uint8 for c in colours):
            raise _error(path, "colours of type uchar, 0..255", str(colours[0].dtype))
        rgb = np.stack(colours, axis=-1)
    return replace(
        Points.empty(),
        ids=np.arange(1, len(xyz) + 1),
        xyz=xyz,
        rgb=rgb,
        error=np.full(len(xyz), UNKNOWN_ERROR),
        track_start=np.zeros(len(xyz) + 1, np.int64),
    )


def _error(path: Path, expected: str, found: str) -> SceneError:
    return SceneError(path, expected=expected, found=found, todo="write the point cloud again")
