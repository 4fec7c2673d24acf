"""One file for the tensors of a model: ``model.compressed``, in the place of ``model.safetensors``.

All numbers are little-endian. A head of 24 bytes: the magic bytes, the version, the CRC-32 of what
follows the head, and the sizes of the first block before and after LZMA. The first block begins
with a list of the tensors in JSON, after its length; then their numbers follow, and the tables of
their symbols (`Writer.raw`). The rest of the file are the symbols (`Writer.words`).
"""

from __future__ import annotations

import lzma
import struct
import zlib
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, NonNegativeInt, TypeAdapter, ValidationError

from chronoscene.compression.columns import Columns
from chronoscene.compression.positions import Grid, from_morton, morton, read_octree, write_octree
from chronoscene.compression.symbols import Reader, Writer
from chronoscene.errors import CheckpointError

TENSOR_FILE = "model.safetensors"
META_FILE = "model.json"
COMPRESSED_FILE = "model.compressed"
MAGIC = b"CSMODEL\n"
VERSION = 1
HEAD = struct.Struct("<8s4I")
MAX_RATIO = 256
"""Bytes of tensors for one byte of a file; models need a tenth of it."""
MEMORY = 2**28
"""Bytes that LZMA may take to decode."""

Tensors = Mapping[str, NDArray[Any]]
Coding = Literal["as is", "half", "grid", "octree", "columns", "integers", "ascending"]


class Entry(BaseModel):
    """A tensor in the file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    type: Literal["float32", "float64", "float16", "int64", "int32", "uint8", "bool"]
    shape: tuple[NonNegativeInt, ...]
    coding: Coding


_ENTRIES = TypeAdapter(tuple[Entry, ...])


def encode(
    tensors: Tensors, grids: Mapping[str, Grid], columns: Mapping[str, Columns] | None
) -> bytes:
    """A model as the bytes of a file; equal models give equal bytes.

    Args:
        tensors: By name. What no rule below is for is stored as half floats, or as it is.
        grids: Of the tensors that are positions [N, 3]. For an octree they ascend along the Morton
            curve.
        columns: Of the tensors to be rounded and coded; None for the plain form without symbols.
    """
    coded = columns is not None
    entries, body = [], Writer()
    for name, tensor in sorted(tensors.items()):
        grid, rule = grids.get(name), (columns or {}).get(name)
        coding = _coding(tensor, grid, rule, coded)
        entries.append(
            Entry.model_validate(
                {"name": name, "type": tensor.dtype.name, "shape": tensor.shape, "coding": coding}
            )
        )
        _write(body, coding, tensor, grid, rule)
    listed, whole = _ENTRIES.dump_json(tuple(entries)), Writer()
    whole.numbers([len(listed)], "u4")
    raw = bytes(whole.raw + listed + body.raw)
    packed = lzma.compress(raw, preset=9 | lzma.PRESET_EXTREME)
    rest = packed + body.words()
    return HEAD.pack(MAGIC, VERSION, zlib.crc32(rest), len(raw), len(packed)) + rest


def _coding(tensor: NDArray[Any], grid: Grid | None, rule: Columns | None, coded: bool) -> Coding:
    if grid is not None:
        if coded:
            return "octree"
        return "grid" if grid.codes(tensor).max() < 2**16 else "as is"
    if rule is not None:
        return "columns"
    if tensor.dtype == np.float32:
        return "half" if np.abs(tensor).max(initial=0) < 65504 else "as is"
    if coded and tensor.size and tensor.dtype in (np.int32, np.int64):
        ascending = tensor.ndim == 1 and (np.diff(tensor) >= 0).all()
        return "ascending" if ascending else "integers"
    return "as is"


def _write(
    writer: Writer, coding: Coding, tensor: NDArray[Any], grid: Grid | None, rule: Columns | None
) -> None:
    match coding:
        case "as is":
            writer.numbers(tensor, tensor.dtype.str[1:])
        case "half":
            writer.numbers(tensor, "f2")
        case "grid" | "octree":
            assert grid is not None
            writer.numbers([*grid.origin, grid.step], "f8")
            codes = grid.codes(tensor)
            if coding == "grid":
                writer.numbers(codes, "u2")
            else:
                write_octree(writer, morton(codes))
        case "columns":
            assert rule is not None
            writer.numbers([rule.basis is not None], "u1")
            if rule.basis is not None:
                writer.numbers(rule.basis, "f2")
            writer.numbers([rule.centre, rule.steps], "f4")
            for column in rule.codes(_rows(tensor)).T:
                writer.symbols(column)
        case "integers":
            for column in _rows(tensor).T:
                writer.symbols(column)
        case "ascending":
            writer.symbols(np.diff(tensor, prepend=0))


def _rows(tensor: NDArray[Any]) -> NDArray[Any]:
    return tensor.reshape(len(tensor), -1)


def decode(data: bytes, place: object = COMPRESSED_FILE) -> dict[str, NDArray[Any]]:
    """The tensors in the bytes of a file, as far as `encode` kept them.

    Args:
        data: Of the file.
        place: Its name in messages.

    Raises:
        CheckpointError: If `encode` did not write this.
        ConfigError: If the package that decodes symbols is not installed.
    """
    head = data[: HEAD.size].ljust(HEAD.size, b"\0")
    magic, version, crc, size, packed_size = HEAD.unpack(head)
    rest, limit = data[HEAD.size :], MAX_RATIO * len(data)
    expected = (MAGIC, VERSION, zlib.crc32(rest))
    if (magic, version, crc) != expected or size > limit or packed_size > len(rest):
        raise CheckpointError(
            place,
            expected=f"a compressed model of version {VERSION}, whole",
            found=f"version {version}" if magic == MAGIC and version != VERSION else "another file",
            todo="the file is damaged or of another program: copy it again",
        )
    raw = _unpack(rest[:packed_size], size)
    reader = Reader(place, raw, rest[packed_size:])
    reader.check(len(raw) == size, "its first block")
    (length,) = reader.numbers(1, "u4")
    try:
        entries = _ENTRIES.validate_json(reader.numbers(length, "u1").tobytes())
    except ValidationError:
        entries = ()
    reader.check(entries, "its list of tensors")
    total = sum(prod(max(size, 1) for size in entry.shape) * 8 for entry in entries)
    reader.check(total <= 2 * limit, "the sizes of its tensors")
    tensors = {entry.name: _read(reader, entry) for entry in entries}
    reader.close()
    return tensors


def _unpack(packed: bytes, size: int) -> bytes:
    """Decompress the first block; a damaged one gives other bytes than ``size``, or none."""
    try:
        return lzma.LZMADecompressor(memlimit=MEMORY).decompress(packed, size + 1)
    except lzma.LZMAError:
        return b""


def _read(reader: Reader, entry: Entry) -> NDArray[Any]:
    shape, count = entry.shape, prod(entry.shape)
    kind, whole = np.dtype(entry.type), entry.coding in ("integers", "ascending")
    reader.check(entry.coding == "as is" or (kind.kind == "i") == whole, "the type of a tensor")
    match entry.coding:
        case "as is":
            values = reader.numbers(count, kind.str[1:])
        case "half":
            values = reader.numbers(count, "f2")
        case "grid" | "octree":
            reader.check(shape[1:] == (3,), "the positions")
            *origin, step = reader.numbers(4, "f8")
            grid = Grid(np.array(origin), step)
            if entry.coding == "grid":
                codes = reader.numbers(count, "u2").reshape(shape).astype(np.int64)
            else:
                codes = from_morton(read_octree(reader, shape[0]))
            values = grid.positions(codes)
        case _:
            reader.check(count, "an empty tensor")
            if entry.coding == "ascending":
                values = np.cumsum(reader.symbols(count))
            else:
                values = _read_columns(reader, entry)
    return values.astype(kind).reshape(shape)


def _read_columns(reader: Reader, entry: Entry) -> NDArray[Any]:
    rows = entry.shape[0] if entry.shape else 1
    width, rule = prod(entry.shape) // rows, None
    if entry.coding == "columns":
        (turned,) = reader.numbers(1, "u1")
        basis = reader.numbers(width * width, "f2").reshape(width, width) if turned else None
        centre, steps = reader.numbers(2 * width, "f4").reshape(2, width)
        rule = Columns(centre, steps, basis)
    codes = np.stack([reader.symbols(rows) for _ in range(width)], axis=1)
    return codes if rule is None else rule.restore(codes)


def read_compressed(path: Path) -> dict[str, NDArray[Any]]:
    """`decode` of a file."""
    return decode(path.read_bytes(), path)
