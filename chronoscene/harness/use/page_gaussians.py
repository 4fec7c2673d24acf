"""Gaussians of all periods of a run in one text for a page: what never changes is there once."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import ConfigError
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files.spz import encode

HEADER_BYTES, CENTRE_BYTES = 16, 9  # Of SPZ
LEAST = 0.02
"""Share of the Gaussians below which a page is refused."""


@dataclass(frozen=True, slots=True, eq=False)
class PackedGaussians:
    """The Gaussians of a run, and how many of them periods share."""

    text: str
    """JSON that ``spz.js`` of the page reads."""
    periods: tuple[int, ...]
    """Gaussians of each period. [T]"""
    stored: int
    """Gaussians that are stored: one that is equal in several periods counts once."""
    centres: int
    """Centres that are stored, likewise."""


@dataclass(frozen=True, slots=True)
class Reduction:
    """Account of what was left out to keep the limit of a page."""

    degree: int = 3
    """Highest degree of the spherical harmonics."""
    share: float = 1.0
    """Share of the Gaussians, those with the largest contributions."""

    def __str__(self) -> str:
        lost = []
        if self.degree < 3:
            lost.append(f"spherical harmonics above degree {self.degree}")
        if self.share < 1:
            lost.append(f"the {100 * (1 - self.share):.0f} % faintest Gaussians of each period")
        return " and ".join(lost)


def fit_gaussians(
    runs: Sequence[Sequence[GaussianCloud]], antialiased: Sequence[bool], room: float
) -> tuple[list[PackedGaussians], Reduction]:
    """Pack the Gaussians of all periods of several runs into a number of bytes.

    If they are too large, harmonics of the highest degrees go, then the faintest Gaussians.

    Args:
        runs: For each run, the Gaussians of each period in the frame of the page.
        antialiased: Whether a run is drawn with the filter of Mip-Splatting. [R]
        room: Bytes of all texts.

    Raises:
        ConfigError: If next to nothing would be left.
    """
    reduction = Reduction()
    while True:
        packed = [
            pack([_reduced(cloud, reduction) for cloud in clouds], antialiased=filtered)
            for clouds, filtered in zip(runs, antialiased, strict=True)
        ]
        size = sum(len(each.text) for each in packed)
        if size <= room:
            return packed, reduction
        if reduction.degree > 1:
            reduction = replace(reduction, degree=reduction.degree - 1)
        else:
            share = reduction.share * min(0.95, 0.98 * room / size)
            reduction = replace(reduction, share=share)
        if reduction.share < LEAST:
            raise ConfigError(
                "--max-megabytes",
                expected="room for the Gaussians",
                found=f"{max(room, 0) / 1e6:.2f} MB for what needs {size / 1e6:.2f}",
                todo="allow more, or choose fewer periods with --period",
            )


def pack(clouds: Sequence[GaussianCloud], *, antialiased: bool) -> PackedGaussians:
    """Pack the Gaussians of all periods of a run; see `fit_gaussians`."""
    union, members = unite(clouds)
    spz, repeated = _without_repeated_centres(encode(union, antialiased=antialiased), len(union))
    document = {
        "spz": _base64(gzip.compress(spz, mtime=0)),
        "repeated": _bits(repeated),
        "members": [_bits(row) for row in members],
    }
    return PackedGaussians(
        text=json.dumps(document, separators=(",", ":")),
        periods=tuple(map(len, clouds)),
        stored=len(union),
        centres=len(union) - int(repeated.sum()),
    )


def unite(clouds: Sequence[GaussianCloud]) -> tuple[GaussianCloud, NDArray[np.bool_]]:
    """Unite the Gaussians of all periods, each of those that are equal once.

    Returns:
        union: Sorted, so that Gaussians with equal centres are neighbours. [U]
        members: True where a Gaussian is one of the period. [T, U]
    """
    names = [field.name for field in fields(GaussianCloud)]
    table = np.concatenate(
        [
            np.concatenate([getattr(cloud, name).reshape(len(cloud), -1) for name in names], axis=1)
            for cloud in clouds
        ]
    ).astype("<f4", copy=False)
    as_bytes = table.view(np.dtype((np.void, table.itemsize * table.shape[1])))[:, 0]
    _, first, inverse = np.unique(as_bytes, return_index=True, return_inverse=True)
    members = np.zeros((len(clouds), len(first)), bool)
    members[np.repeat(np.arange(len(clouds)), [*map(len, clouds)]), inverse] = True
    means, quats, scales, opacities, sh = np.split(table[first], [3, 7, 10, 11], axis=1)
    return GaussianCloud(means, quats, scales, opacities[:, 0], sh.reshape(-1, 16, 3)), members


def _without_repeated_centres(data: bytes, count: int) -> tuple[bytes, NDArray[np.bool_]]:
    """Unpack SPZ and drop centres that equal the one before; say which. [N]"""
    raw = gzip.decompress(data)
    end = HEADER_BYTES + CENTRE_BYTES * count
    centres = np.frombuffer(raw[HEADER_BYTES:end], np.uint8).reshape(count, CENTRE_BYTES)
    repeated = np.zeros(count, bool)
    repeated[1:] = (centres[1:] == centres[:-1]).all(axis=1)
    return raw[:HEADER_BYTES] + centres[~repeated].tobytes() + raw[end:], repeated


def _reduced(cloud: GaussianCloud, reduction: Reduction) -> GaussianCloud:
    if reduction == Reduction():
        return cloud
    largest = np.sort(cloud.scales, axis=1)[:, 1:]
    contribution = cloud.opacities * largest.prod(axis=1)
    number = int(np.ceil(reduction.share * len(cloud)))
    kept = np.sort(np.argsort(-contribution, kind="stable")[:number])
    sh = cloud.sh_coeffs[kept]
    sh[:, (reduction.degree + 1) ** 2 :] = 0
    return GaussianCloud(
        cloud.means[kept], cloud.quats[kept], cloud.scales[kept], cloud.opacities[kept], sh
    )


def _bits(flags: NDArray[np.bool_]) -> str:
    return _base64(gzip.compress(np.packbits(flags).tobytes(), mtime=0))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
