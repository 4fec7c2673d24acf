"""Binary glTF with the extension KHR_gaussian_splatting: 240 bytes per Gaussian.

All values are float32: the centre, the rotation xyzw, the scales, the opacity, and spherical
harmonics of degree 0 to 3 by degree and order. They are in the frame of the scene; the node turns
it so that up is +y, as glTF has it. The container counts its bytes in 32 bits.

Source: KHR_gaussian_splatting of github.com/KhronosGroup/glTF, ratified; a draft before had the
logarithms of the scales.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.errors import ConfigError
from chronoscene.scene.gaussian_cloud import GaussianCloud

NAME = "KHR_gaussian_splatting"

_HARMONICS = [f"{NAME}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
MAX_BYTES = 2**32 - 1
_BYTES, _REST = 240, 1 << 20  # Of a Gaussian; room for the JSON
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def encode(cloud: GaussianCloud, *, up: ArrayLike) -> bytes:
    """Make a file.

    Args:
        cloud: In the frame of the scene.
        up: Direction that is up in the scene. [3]

    Raises:
        ConfigError: If the file would be larger than the format allows.
    """
    if len(cloud) > (most := (MAX_BYTES - _REST) // _BYTES):
        raise ConfigError(
            "export as glTF",
            expected=f"at most {most:,} Gaussians, as the file ends at 4 GiB",
            found=f"{len(cloud):,}",
            todo="choose another format, such as --to spz or ply",
        )
    quats = cloud.quats[:, [1, 2, 3, 0]] / np.linalg.norm(cloud.quats, axis=1, keepdims=True)
    columns: dict[str, NDArray[np.float32]] = {
        "POSITION": cloud.means,
        f"{NAME}:ROTATION": quats,
        f"{NAME}:SCALE": cloud.scales,
        f"{NAME}:OPACITY": cloud.opacities.clip(0, 1)[:, None],
        **dict(zip(_HARMONICS, cloud.sh_coeffs.swapaxes(0, 1), strict=True)),
    }
    data = [np.ascontiguousarray(column, "<f4").tobytes() for column in columns.values()]
    starts = np.cumsum([0, *map(len, data)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": _ARRAY_BUFFER}
        for start, part in zip(starts, data, strict=False)
    ]
    accessors = [_accessor(i, column) for i, column in enumerate(columns.values())]
    accessors[0] |= {"min": cloud.means.min(axis=0).tolist()}
    accessors[0] |= {"max": cloud.means.max(axis=0).tolist()}
    primitive = {
        "attributes": {name: i for i, name in enumerate(columns)},
        "mode": _POINTS,
        "extensions": {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "ChronoScene", "extras": {"comments": []}},
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _turn_to_y(up)}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return _container(json.dumps(document).encode(), b"".join(data))


def with_comments(data: bytes, comments: Sequence[str]) -> bytes:
    """Put lines into ``asset.extras.comments`` of a file."""
    document, binary = _parts(data)
    document["asset"]["extras"]["comments"] = list(comments)
    return _container(json.dumps(document).encode(), bytes(binary))


def decode(data: bytes) -> GaussianCloud:
    """Read what `encode` made, in the frame of the scene."""
    document, binary = _parts(data)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    count = document["accessors"][0]["count"]

    def column(name: str) -> NDArray[np.float32]:
        view = document["bufferViews"][attributes[name]]
        part = binary[view["byteOffset"] :][: view["byteLength"]]
        return np.frombuffer(part, "<f4").reshape(count, -1)

    return GaussianCloud(
        means=column("POSITION"),
        quats=column(f"{NAME}:ROTATION")[:, [3, 0, 1, 2]],
        scales=column(f"{NAME}:SCALE"),
        opacities=column(f"{NAME}:OPACITY")[:, 0],
        sh_coeffs=np.stack([column(name) for name in _HARMONICS], axis=1),
    )


def _accessor(number: int, column: NDArray[np.float32]) -> dict[str, Any]:
    kind = _TYPES[column.shape[1]]
    return {"bufferView": number, "componentType": _FLOAT, "count": len(column), "type": kind}


def _turn_to_y(up: ArrayLike) -> list[float]:
    """Return the smallest rotation xyzw that takes a direction to +y. [4]"""
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]  # half a turn about x
    quat = np.array([-z, 0.0, x, 1 + y])
    return [float(value) for value in quat / np.linalg.norm(quat)]


def _parts(data: bytes) -> tuple[dict[str, Any], memoryview]:
    """Take a file apart that `_container` made."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), memoryview(data)[28 + length :]


def _container(document: bytes, binary: bytes) -> bytes:
    """Put both parts, filled up to multiples of four bytes, into one file."""
    document += b" " * (-len(document) % 4)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(document) + 8 + len(binary)
    header = struct.pack("<III", _MAGIC, _VERSION, total)
    first, second = (
        struct.pack("<II", len(part), kind) + part
        for part, kind in ((document, _JSON), (binary, _BINARY))
    )
    return header + first + second
