"""SPZ, version 3: about 20 bytes per Gaussian, gzipped; Niantic's format, MIT.

The axes of the file are right, up, back (RUB). Frames of COLMAP and of PLY files count as right,
down, front, so y and z change their sign here and in every program that follows the format.

| value | stored as |
| --- | --- |
| centre | 24 bits fixed point per axis; what is `FAR` beyond all others is moved to their limits |
| logarithm of a scale | 8 bits, steps of 1/16 from -10 to 5.94 |
| rotation | the three smaller components of the quaternion xyzw, 10 bits each; 2 bits for which |
| opacity | 8 bits |
| constant coefficient of a colour | 8 bits, steps of 0.026 |
| other coefficients | 8 bits, -1 to 1; the lower 3 (degree 1) or 4 are 0, as in Niantic's writer |

Source: the description of the format in github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files.rotations import with_largest, without_largest

MAGIC, VERSION, SH_DEGREE, ANTIALIASED = 0x5053474E, 3, 3, 1

USUAL, FAR = 0.999, 64.0
"""Centres become limits beyond so many times the largest coordinate of this share of Gaussians, and
beyond 2,048 units: the coordinates of all others would be coarse for their sake."""
COLOUR_SCALE = 0.15 * 255
"""Steps per unit of a constant coefficient."""

_HEADER = struct.Struct("<IIIBBBB")
_FLIPPED = np.array([1, -1, -1], np.float32)
"""Signs of x, y and z between RUB and right, down, front; also those of a rotation's axis."""
_SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs of the harmonics of degree 1 to 3 after the same change of axes. [15]"""
_SH_STEPS = np.array([8] * 3 + [16] * 12)
"""Multiples that the stored bytes of degree 1 and of the others have. [15]"""
_AT_A_TIME = 1 << 16  # Gaussians of which harmonics are packed together, so that copies stay small


def encode(cloud: GaussianCloud, *, antialiased: bool) -> bytes:
    """Make a file.

    Args:
        cloud: Values outside of the range of the format become its limits.
        antialiased: Whether a viewer is to draw with the filter of Mip-Splatting.
    """
    # Without a time stamp, equal clouds give equal files.
    return gzip.compress(encode_plain(cloud, antialiased=antialiased), mtime=0)


def encode_plain(cloud: GaussianCloud, *, antialiased: bool) -> bytes:
    """Make the content of a file, before gzip; see `encode`."""
    fractional_bits = _fractional_bits(cloud.means)
    flags = ANTIALIASED if antialiased else 0
    header = _HEADER.pack(MAGIC, VERSION, len(cloud), SH_DEGREE, fractional_bits, flags, 0)
    fixed = np.rint(cloud.means.astype(np.float64) * _FLIPPED * 2.0**fractional_bits)
    fixed = fixed.clip(1 - 2**23, 2**23 - 1)
    with np.errstate(divide="ignore"):  # a scale of 0 is the smallest one
        log_scales = np.log(cloud.scales)
    parts: list[NDArray[Any]] = [
        fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3],
        _to_byte(cloud.opacities * 255),
        _to_byte(cloud.sh_coeffs[:, 0] * COLOUR_SCALE + 127.5),
        _to_byte((log_scales + 10) * 16),
        _pack_rotations(cloud.quats),
        *map(_pack_harmonics, np.array_split(cloud.sh_coeffs[:, 1:], 1 + len(cloud) // _AT_A_TIME)),
    ]
    return header + b"".join(part.tobytes() for part in parts)


def count_far(cloud: GaussianCloud) -> int:
    """Count the Gaussians that `encode` moves to its limits, as they are far from all others."""
    return int((_distances(cloud.means) > _limit(cloud.means)).sum())


def decode(data: bytes) -> GaussianCloud:
    """Read what `encode` made."""
    raw = gzip.decompress(data)
    magic, version, count, degree, fractional_bits, _, _ = _HEADER.unpack_from(raw)
    assert (magic, version, degree) == (MAGIC, VERSION, SH_DEGREE)
    sizes = np.cumsum([_HEADER.size, 9 * count, count, 3 * count, 3 * count, 4 * count])
    values = np.frombuffer(raw, np.uint8)
    centres, opacities, colours, scales, rotations, harmonics = (
        part.reshape(count, -1) for part in np.split(values, sizes)[1:]
    )
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[..., 1:] = centres.reshape(-1, 3, 3)
    means = (fixed.view("<i4")[..., 0] >> 8) * 2.0**-fractional_bits * _FLIPPED
    rest = (harmonics.reshape(count, 15, 3) - np.float32(128)) / 128 * _SH_SIGNS[:, None]
    dc = (colours - np.float32(127.5)) / np.float32(COLOUR_SCALE)
    return GaussianCloud(
        means=means.astype(np.float32),
        quats=_unpack_rotations(np.ascontiguousarray(rotations).view("<u4")[:, 0]),
        scales=np.exp(scales / np.float32(16) - 10),
        opacities=opacities[:, 0].astype(np.float32) / np.float32(255),
        sh_coeffs=np.concatenate([dc[:, None], rest], axis=1),
    )


def _fractional_bits(means: NDArray[np.float32]) -> int:
    """Return 12, or what a scene beyond 2,048 units leaves; more where all is within 128 units."""
    largest = min(float(_distances(means).max(initial=0.0)), _limit(means))
    integer_bits = max(0, int(np.ceil(np.log2(largest + 1e-6))))
    return max(0, min(max(12, 19 - integer_bits), 23 - integer_bits))


def _limit(means: NDArray[np.float32]) -> float:
    """Return the largest coordinate that is kept."""
    usual = np.quantile(_distances(means), USUAL, method="lower") if len(means) else 0.0
    return max(2_048.0, FAR * float(usual))


def _distances(means: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest coordinate of each Gaussian. [N]"""
    distances: NDArray[np.float32] = np.abs(means).max(axis=1)
    return distances


def _to_byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _pack_harmonics(coeffs: NDArray[np.float32]) -> NDArray[np.uint8]:
    steps = _SH_STEPS[:, None]
    levels = np.rint(coeffs * _SH_SIGNS[:, None] * 128) + 128
    return (np.floor((levels + steps // 2) / steps) * steps).clip(0, 255).astype(np.uint8)


def _pack_rotations(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Pack quaternions wxyz: the number of the largest component xyzw, then the others. [N]

    Each of the others has its sign and 9 bits of its size in units of sqrt(1/2).
    """
    xyzw = quats[:, [1, 2, 3, 0]] / np.linalg.norm(quats, axis=1, keepdims=True)
    xyzw[:, :3] *= _FLIPPED
    largest, others = without_largest(xyzw)
    fields = np.rint(np.abs(others) * (511 * np.sqrt(2))).astype(np.uint32)
    fields |= (others < 0).astype(np.uint32) << 9
    top, middle, low = fields.T
    return (largest.astype("<u4") << 30 | top << 20 | middle << 10 | low).astype("<u4")


def _unpack_rotations(packed: NDArray[np.uint32]) -> NDArray[np.float32]:
    largest = (packed >> 30).astype(np.int64)
    fields = packed[:, None] >> np.array([20, 10, 0], np.uint32)
    others = (fields & 511) / (511 * np.sqrt(2)) * np.where(fields >> 9 & 1, -1, 1)
    xyzw = with_largest(largest, others)
    xyzw[:, :3] *= _FLIPPED
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)
