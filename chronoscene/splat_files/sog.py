"""SOG, version 2: lossless WebP images and a JSON file in a ZIP archive; PlayCanvas's format.

A pixel of each image belongs to one Gaussian. Its centre has 16 bits per axis, on a logarithmic
scale; the three smaller components of the rotation have 8 bits each, the opacity 8; scales and
constant coefficients are numbers of a table with 256 values. The other coefficients are one row of
a palette that all Gaussians share, found by k-means.

Source: the description of the format at developer.playcanvas.com.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files.rotations import with_largest, without_largest

PALETTE_COLUMNS = 64
"""Rows of the palette in a line of its image."""
MAX_PALETTE = 65_536

_LARGEST = 252
"""Alpha of a rotation whose largest component is w; 253 to 255 for x, y, z."""
_ROUNDS = 6
"""Rounds of k-means."""


def encode(cloud: GaussianCloud, *, antialiased: bool) -> bytes:
    """Make a file.

    Args:
        cloud: One Gaussian at least.
        antialiased: Whether a viewer is to draw with the filter of Mip-Splatting.
    """
    log_means = np.sign(cloud.means) * np.log1p(np.abs(cloud.means.astype(np.float64)))
    low, high = log_means.min(axis=0), log_means.max(axis=0)
    levels = np.rint((log_means - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    scales, scale_table = _to_table(np.log(cloud.scales.clip(1e-30)))
    colours, colour_table = _to_table(cloud.sh_coeffs[:, 0])
    opacities = np.rint(cloud.opacities * 255).clip(0, 255).astype(np.uint8)
    palette, labels = _cluster(cloud.sh_coeffs[:, 1:].reshape(len(cloud), 45))
    entries, entry_table = _to_table(palette.reshape(-1, 15, 3))
    lines = -(-len(palette) // PALETTE_COLUMNS)
    entry_image = np.zeros((lines * PALETTE_COLUMNS, 15, 3), np.uint8)
    entry_image[: len(palette)] = entries
    label_pixels = np.column_stack([labels & 255, labels >> 8, 0 * labels]).astype(np.uint8)
    images = {
        "means_l.webp": _square((levels & 255).astype(np.uint8)),
        "means_u.webp": _square((levels >> 8).astype(np.uint8)),
        "scales.webp": _square(scales),
        "quats.webp": _square(_pack_rotations(cloud.quats)),
        "sh0.webp": _square(np.column_stack([colours, opacities])),
        "shN_centroids.webp": entry_image.reshape(lines, PALETTE_COLUMNS * 15, 3),
        "shN_labels.webp": _square(label_pixels),
    }
    files = list(images)
    meta = {
        "version": 2,
        "asset": {"generator": "ChronoScene", "comments": []},
        "count": len(cloud),
        "antialias": antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": files[:2]},
        "scales": {"codebook": scale_table, "files": files[2:3]},
        "quats": {"files": files[3:4]},
        "sh0": {"codebook": colour_table, "files": files[4:5]},
        "shN": {"count": len(palette), "bands": 3, "codebook": entry_table, "files": files[5:]},
    }
    coded = {name: _webp(pixels) for name, pixels in images.items()}
    return _archive({"meta.json": json.dumps(meta).encode()} | coded)


def with_comments(data: bytes, comments: Sequence[str]) -> bytes:
    """Put lines into ``asset.comments`` of the JSON of a file."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    meta["asset"]["comments"] = list(comments)
    return _archive(files | {"meta.json": json.dumps(meta).encode()})


def decode(data: bytes) -> GaussianCloud:
    """Read what `encode` made."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta: dict[str, Any] = json.loads(archive.read("meta.json"))
        images = {
            # WebP leaves out an alpha channel that is 255 throughout.
            name: np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA"))
            for name in archive.namelist()
            if name != "meta.json"
        }
    count = meta["count"]

    def pixels(name: str, channels: int) -> NDArray[np.int64]:
        return images[name].reshape(-1, 4)[:count, :channels].astype(np.int64)

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    levels = pixels("means_l.webp", 3) + (pixels("means_u.webp", 3) << 8)
    log_means = low + levels / 65535 * (high - low)
    colours, labels = pixels("sh0.webp", 4), pixels("shN_labels.webp", 2)
    entries = images["shN_centroids.webp"][..., :3]
    palette = np.array(meta["shN"]["codebook"])[entries].reshape(-1, 15, 3)
    dc = np.array(meta["sh0"]["codebook"])[colours[:, :3]]
    rest = palette[labels[:, 0] + (labels[:, 1] << 8)]
    return GaussianCloud(
        means=(np.sign(log_means) * np.expm1(np.abs(log_means))).astype(np.float32),
        quats=_unpack_rotations(pixels("quats.webp", 4)),
        scales=np.exp(np.array(meta["scales"]["codebook"], np.float32)[pixels("scales.webp", 3)]),
        opacities=(colours[:, 3] / 255).astype(np.float32),
        sh_coeffs=np.concatenate([dc[:, None], rest], axis=1).astype(np.float32),
    )


def _archive(files: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in files.items():
            # An entry without a time stamp: equal clouds give equal files.
            archive.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    image = io.BytesIO()
    # Exact: the colours of transparent pixels are kept, too.
    Image.fromarray(pixels).save(image, "WEBP", lossless=True, exact=True, method=6)
    return image.getvalue()


def _square(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lay out a row per Gaussian as an image, line by line. [N, C] -> [H, W, C]"""
    width = 4 * max(1, int(np.ceil(np.sqrt(len(rows)) / 4)))
    height = 4 * -(-len(rows) // (4 * width))
    image = np.zeros((height * width, rows.shape[1]), np.uint8)
    image[: len(rows)] = rows
    return image.reshape(height, width, -1)


def _to_table(values: NDArray[np.floating]) -> tuple[NDArray[np.uint8], list[float]]:
    """Find 256 values, in order, that are near to all; return the number of each, and these."""
    flat = values.ravel().astype(np.float64)
    # Half of them as dense as the values are, half evenly: neither crowds nor extremes are lost.
    even = np.linspace(flat.min(), flat.max(), 128)
    table = np.sort(np.concatenate([even, np.quantile(flat, np.linspace(0, 1, 128))]))
    for _ in range(10):
        numbers = np.searchsorted((table[1:] + table[:-1]) / 2, flat)
        counts = np.bincount(numbers, minlength=256)
        sums = np.bincount(numbers, flat, minlength=256)
        table = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), table))
    numbers = np.searchsorted((table[1:] + table[:-1]) / 2, flat)
    return numbers.astype(np.uint8).reshape(values.shape), table.tolist()


def _cluster(rows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Find a palette by k-means: its rows [P, D], and the one that each row is near to. [N]

    P is a fifth of the number of rows, as in PlayCanvas's writer, and at most `MAX_PALETTE`.
    """
    rng = np.random.default_rng(0)
    size = min(MAX_PALETTE, max(1, len(rows) // 5))
    palette = rows[rng.choice(len(rows), size, replace=False)]
    for _ in range(_ROUNDS):
        labels = _nearest(rows, palette)
        counts = np.bincount(labels, minlength=size)
        sums = np.zeros(palette.shape, np.float64)
        np.add.at(sums, labels, rows)
        used = counts > 0
        palette = palette.copy()
        palette[used] = sums[used] / counts[used, None]
    return palette, _nearest(rows, palette)


def _nearest(rows: NDArray[np.float32], palette: NDArray[np.float32]) -> NDArray[np.int64]:
    half = (palette**2).sum(axis=1) / 2
    blocks = [rows[i : i + 4096] for i in range(0, len(rows), 4096)]
    return np.concatenate([(half - block @ palette.T).argmin(axis=1) for block in blocks])


def _pack_rotations(quats: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Pack quaternions wxyz: the three smaller components, and which is left out. [N, 4]"""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest, others = without_largest(quats)
    levels = np.rint((others / np.sqrt(2) + 0.5) * 255).clip(0, 255)
    return np.column_stack([levels, _LARGEST + largest]).astype(np.uint8)


def _unpack_rotations(pixels: NDArray[np.int64]) -> NDArray[np.float32]:
    others = (pixels[:, :3] / 255 - 0.5) * np.sqrt(2)
    return with_largest(pixels[:, 3] - _LARGEST, others).astype(np.float32)
