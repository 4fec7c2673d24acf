"""Gaussians of all periods of a run in one text for a page: what never changes is there once."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from chronoscene.arrays import Mask
from chronoscene.errors import ConfigError
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files.spz import encode_plain

HEADER_BYTES, CENTRE_BYTES = 16, 9  # Of SPZ
LEAST = 0.02
"""Share of the Gaussians below which a page is refused."""
MANY, SAMPLED, GENEROUS = 500_000, 16, 1.15
"""With more Gaussians than this, those at one centre in `SAMPLED` tell how much has to go. The
limit is then `GENEROUS` times the room, as a small sample is packed less tightly."""
_ENDS = [3, 7, 10, 11]
"""Columns at which the parts of a `GaussianCloud` end in a row of 59 values."""


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
    if (total := _count(runs)) > MANY:
        samples = [[*map(_sample, clouds)] for clouds in runs]
        reduction = _guess(samples, antialiased, GENEROUS * room * _count(samples) / total)
    while True:
        packed = _pack_reduced(runs, antialiased, reduction)
        size = _size(packed)
        if size <= room:
            return packed, reduction
        reduction = _more_reduced(reduction, room / size)
        if reduction.share < LEAST:
            raise ConfigError(
                "--max-megabytes",
                expected="room for the Gaussians",
                found=f"{max(room, 0) / 1e6:.2f} MB for what needs {size / 1e6:.2f}",
                todo="allow more, or choose fewer periods with --period",
            )


def _guess(
    samples: Sequence[Sequence[GaussianCloud]], antialiased: Sequence[bool], room: float
) -> Reduction:
    """Return a reduction to begin with: packing millions of Gaussians takes minutes."""
    reduction = Reduction()
    while reduction.share == 1:
        size = _size(_pack_reduced(samples, antialiased, reduction))
        if size <= room:
            break
        reduction = _more_reduced(reduction, room / size)
    return replace(reduction, share=max(reduction.share, LEAST))


def _sample(cloud: GaussianCloud) -> GaussianCloud:
    """Choose by the centres, so that Gaussians which periods share are in the sample of each."""
    x, y, z = cloud.means.astype("<f4").view("<u4").T
    mixed = (x ^ y * np.uint32(0x9E3779B1) ^ z * np.uint32(0x85EBCA77)) * np.uint32(0xC2B2AE3D)
    return cloud.rows(mixed >> np.uint32(16) & np.uint32(SAMPLED - 1) == 0)


def _pack_reduced(
    runs: Sequence[Sequence[GaussianCloud]], antialiased: Sequence[bool], reduction: Reduction
) -> list[PackedGaussians]:
    return [
        pack([_reduced(cloud, reduction) for cloud in clouds], antialiased=filtered)
        for clouds, filtered in zip(runs, antialiased, strict=True)
    ]


def _count(runs: Sequence[Sequence[GaussianCloud]]) -> int:
    return sum(len(cloud) for clouds in runs for cloud in clouds)


def _size(packed: Sequence[PackedGaussians]) -> int:
    return sum(len(each.text) for each in packed)


def _more_reduced(reduction: Reduction, fits: float) -> Reduction:
    """Reduce further, where this share of the present size would fit."""
    if reduction.degree > 1:
        return replace(reduction, degree=reduction.degree - 1)
    return replace(reduction, share=reduction.share * min(0.95, 0.98 * fits))


def pack(clouds: Sequence[GaussianCloud], *, antialiased: bool) -> PackedGaussians:
    """Pack the Gaussians of all periods of a run; see `fit_gaussians`."""
    union, members = unite(clouds)
    plain = encode_plain(union, antialiased=antialiased)
    spz, repeated = _without_repeated_centres(plain, len(union))
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


def unite(clouds: Sequence[GaussianCloud]) -> tuple[GaussianCloud, Mask]:
    """Unite the Gaussians of all periods, each of those that are equal once.

    Returns:
        union: Sorted, so that Gaussians with equal centres are neighbours. [U]
        members: True where a Gaussian is one of the period. [T, U]
    """
    table = np.empty((sum(map(len, clouds)), 59), "<f4")
    end = 0
    for cloud in clouds:
        rows = table[end : (end := end + len(cloud))]
        for part, field in zip(np.split(rows, _ENDS, axis=1), fields(cloud), strict=True):
            part[:] = getattr(cloud, field.name).reshape(part.shape)
    order = np.argsort(table.view((np.void, table.strides[0]))[:, 0], kind="stable")
    table = table[order]
    bits, first = table.view("<u4"), np.ones(len(table), bool)
    first[1:] = (bits[1:] != bits[:-1]).any(axis=1)
    members = np.zeros((len(clouds), int(first.sum())), bool)
    periods = np.repeat(np.arange(len(clouds)), [*map(len, clouds)])
    members[periods[order], first.cumsum() - 1] = True
    means, quats, scales, opacities, sh = np.split(table[first], _ENDS, axis=1)
    return GaussianCloud(means, quats, scales, opacities[:, 0], sh.reshape(-1, 16, 3)), members


def _without_repeated_centres(raw: bytes, count: int) -> tuple[bytes, Mask]:
    """Drop centres of plain SPZ that equal the one before; say which. [N]"""
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
    kept = cloud.rows(np.sort(np.argsort(-contribution, kind="stable")[:number]))
    kept.sh_coeffs[:, (reduction.degree + 1) ** 2 :] = 0
    return kept


def _bits(flags: Mask) -> str:
    return _base64(gzip.compress(np.packbits(flags).tobytes(), mtime=0))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
