"""Readers of exported files that share no code with chronoscene/splat_files/.

PLY is read by plyfile, glTF by pygltflib. SPZ, SOG and SPLAT are decoded here, one Gaussian after
the other, from the descriptions of the formats.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from math import copysign, exp, isqrt, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData

from chronoscene.scene.gaussian_cloud import GaussianCloud


def read(path: Path) -> GaussianCloud:
    """Read a file in the frame of its scene."""
    readers = {
        ".ply": _read_ply,
        ".spz": _read_spz,
        ".glb": _read_gltf,
        ".sog": _read_sog,
        ".splat": _read_splat,
    }
    return readers[path.suffix](path)


def _read_ply(path: Path) -> GaussianCloud:
    vertices = PlyData.read(path)["vertex"]

    def columns(*names: str) -> NDArray[np.float32]:
        return np.stack([vertices[name] for name in names], axis=-1)

    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15)  # colour by colour
    dc = columns(*(f"f_dc_{i}" for i in range(3)))
    return GaussianCloud(
        means=columns("x", "y", "z"),
        quats=columns(*(f"rot_{i}" for i in range(4))),
        scales=np.exp(columns(*(f"scale_{i}" for i in range(3)))),
        opacities=1 / (1 + np.exp(-columns("opacity")[:, 0])),
        sh_coeffs=np.concatenate([dc[:, None], rest.swapaxes(1, 2)], axis=1),
    )


def _read_spz(path: Path) -> GaussianCloud:
    data = gzip.decompress(path.read_bytes())
    count, bits = struct.unpack_from("<I", data, 8)[0], data[13]
    starts = np.cumsum([16, 9 * count, count, 3 * count, 3 * count, 4 * count]).tolist()
    means, quats, scales, opacities = [], [], [], []
    sh = np.zeros((count, 16, 3))
    for n in range(count):
        at, alpha, colour, scale, turn, harmonic = (
            start + width * n for start, width in zip(starts, (9, 1, 3, 3, 4, 45), strict=True)
        )
        axes = [
            int.from_bytes(data[i : i + 3], "little", signed=True) for i in (at, at + 3, at + 6)
        ]
        x, y, z = (value / 2**bits for value in axes)
        means.append((x, -y, -z))
        opacities.append(data[alpha] / 255)
        scales.append([exp(value / 16 - 10) for value in data[scale : scale + 3]])
        x, y, z, w = _smallest_three(int.from_bytes(data[turn : turn + 4], "little"))
        # Half a turn about x, from RUB to the frame of the scene: (0, 1, 0, 0) times wxyz.
        quats.append((-x, w, -z, y))
        sh[n, 0] = [(value / 255 - 0.5) / 0.15 for value in data[colour : colour + 3]]
        for k in range(15):
            values = data[harmonic + 3 * k : harmonic + 3 * k + 3]
            sh[n, 1 + k] = [harmonic_sign(1 + k) * (value - 128) / 128 for value in values]
    return _cloud(means, quats, scales, opacities, sh)


def _smallest_three(packed: int) -> list[float]:
    """Unpack a quaternion xyzw: from the top, 2 bits for the largest, 10 for each of the others."""
    quat = []
    for shift in (20, 10, 0):
        field = packed >> shift & 1023
        quat.append((-1 if field & 512 else 1) * (field & 511) / 511 / sqrt(2))
    quat.insert(packed >> 30, sqrt(max(0.0, 1 - sum(value**2 for value in quat))))
    return quat


def harmonic_sign(k: int) -> int:
    """Return the sign of the k-th harmonic, of 16, where y and z change theirs.

    For the degree l and the order m, it is (-1)^(l + m) where m >= 0, else (-1)^(l + m + 1).
    """
    degree = isqrt(k)
    order = k - degree * (degree + 1)
    return (-1) ** (degree + order + (order < 0))


def _read_gltf(path: Path) -> GaussianCloud:
    import pygltflib

    gltf = pygltflib.GLTF2().load(str(path))
    blob, primitive = gltf.binary_blob(), gltf.meshes[0].primitives[0]
    attributes = vars(primitive.attributes)

    def column(name: str) -> NDArray[np.float32]:
        accessor = gltf.accessors[attributes[name]]
        view = gltf.bufferViews[accessor.bufferView]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        values = np.frombuffer(blob, "<f4", accessor.count * width, start)
        return values.reshape(accessor.count, width)

    prefix = "KHR_gaussian_splatting"
    sh = [column(f"{prefix}:SH_DEGREE_{d}_COEF_{i}") for d in range(4) for i in range(2 * d + 1)]
    return GaussianCloud(
        means=column("POSITION"),
        quats=np.roll(column(f"{prefix}:ROTATION"), 1, axis=1),
        scales=column(f"{prefix}:SCALE"),
        opacities=column(f"{prefix}:OPACITY")[:, 0],
        sh_coeffs=np.stack(sh, axis=1),
    )


def _read_splat(path: Path) -> GaussianCloud:
    means, quats, scales, opacities, colours = [], [], [], [], []
    for values in struct.iter_unpack("<3f3f4B4B", path.read_bytes()):
        means.append(values[:3])
        scales.append(values[3:6])
        colours.append([(value / 255 - 0.5) / 0.28209479177387814 for value in values[6:9]])
        opacities.append(values[9] / 255)
        quats.append([(value - 128) / 128 for value in values[10:]])
    sh = np.zeros((len(means), 16, 3))
    sh[:, 0] = colours
    return _cloud(means, quats, scales, opacities, sh)


def _read_sog(path: Path) -> GaussianCloud:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def image(part: str, number: int = 0) -> Image.Image:
            return Image.open(io.BytesIO(archive.read(meta[part]["files"][number]))).convert("RGBA")

        low, high, scale_image = image("means"), image("means", 1), image("scales")
        quat_image, colour_image = image("quats"), image("sh0")
        palette_image, label_image = image("shN"), image("shN", 1)
    ranges = list(zip(meta["means"]["mins"], meta["means"]["maxs"], strict=True))
    means, quats, scales, opacities = [], [], [], []
    sh = np.zeros((meta["count"], 16, 3))
    for n in range(meta["count"]):
        at = n % low.width, n // low.width
        mean = []
        for axis, (least, most) in enumerate(ranges):
            level = 256 * high.getpixel(at)[axis] + low.getpixel(at)[axis]
            value = least + (most - least) * level / 65535
            mean.append(copysign(exp(abs(value)) - 1, value))
        means.append(mean)
        scales.append([exp(meta["scales"]["codebook"][i]) for i in scale_image.getpixel(at)[:3]])
        *stored, tag = quat_image.getpixel(at)
        quat = [(value / 255 - 0.5) * 2 / sqrt(2) for value in stored]
        quat.insert(tag - 252, sqrt(max(0.0, 1 - sum(value**2 for value in quat))))
        quats.append(quat)
        *colour, opacity = colour_image.getpixel(at)
        opacities.append(opacity / 255)
        sh[n, 0] = [meta["sh0"]["codebook"][i] for i in colour]
        label = label_image.getpixel(at)[0] + 256 * label_image.getpixel(at)[1]
        for k in range(15):
            entry = palette_image.getpixel((15 * (label % 64) + k, label // 64))
            sh[n, 1 + k] = [meta["shN"]["codebook"][i] for i in entry[:3]]
    return _cloud(means, quats, scales, opacities, sh)


def _cloud(*arrays: Any) -> GaussianCloud:
    return GaussianCloud(*(np.asarray(array, np.float32) for array in arrays))
