"""Protocols: how a bench is run on the data of another paper, for its table.

A protocol fixes what decides a comparison and leaves the method, its preset and its seeds free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from chronoscene.errors import ConfigError
from chronoscene.formats import DetectedFormat
from chronoscene.images.store import MAX_WIDTH

_AS_THEY_ARE = 1 << 16  # Pixels; no photo is wider


@dataclass(frozen=True, slots=True)
class Protocol:
    """Settings that all runs under a protocol share."""

    title: str
    """Name of the data."""
    format: str
    """Name in `chronoscene.formats`; its reader takes the published test images."""
    strategies: tuple[str, ...]
    """Orders in which periods may be learned; the first one unless another is asked for."""
    table: str
    """Id of the printed table in `load_published`."""
    metrics: tuple[str, ...]
    """Metrics for its columns, in their order; means are over all test views of a scene."""
    max_width: int = MAX_WIDTH
    """Pixels; wider images are scaled down to it."""
    shrink: int = 1
    """Divisor of the width and height of all images."""
    period_by: str | None = None
    """Rule by which images are grouped into periods, where the format has a choice."""

    def options(self) -> dict[str, str | int | None]:
        """Return the options of ``bench`` that the protocol gives, by the names of arguments."""
        return {
            "dataset_format": self.format,
            "period_by": self.period_by,
            "strategies": self.strategies[0],
            "max_width": self.max_width,
        }


_PAPER = "psnr", "ssim", "lpips_vgg_3dgs"

PROTOCOLS = {
    "wat": Protocol(
        "WAT", "wat", ("sequential", "joint"), "wat", ("psnr", "ssim"), max_width=_AS_THEY_ARE
    ),
    "cl-splats": Protocol(
        "Real scenes of CL-Splats", "cl-splats", ("sequential", "joint"), "cl_splats_real", _PAPER
    ),
    "5pointz": Protocol(
        "5Pointz", "neusc", ("joint",), "five_pointz", _PAPER,
        max_width=_AS_THEY_ARE, shrink=4, period_by="year",
    ),
}  # fmt: skip
"""Published protocols by name; docs/guides/protocols.md has their sources."""


def check_protocol(
    name: str,
    scenes: Sequence[DetectedFormat],
    strategies: Sequence[str],
    max_width: int,
    validation: bool,
) -> None:
    """Check that the settings of a bench are those of a protocol.

    Raises:
        ConfigError: If one is another.
    """
    protocol = PROTOCOLS[name]
    for strategy in strategies:
        if strategy not in protocol.strategies:
            raise _refusal(name, "--strategy", " or ".join(protocol.strategies), strategy)
    if max_width != protocol.max_width:
        raise _refusal(name, "--max-width", str(protocol.max_width), str(max_width))
    if validation:
        raise _refusal(name, "--validation", "the published test images", "--validation")
    for scene in scenes:
        if scene.name != protocol.format:
            raise _refusal(name, f"{scene.path}", f"the format {protocol.format}", scene.name)
        if protocol.format == "cl-splats" and scene.model is None:
            raise _refusal(name, f"{scene.path}", "a real scene, with sparse/0", "a rendered level")
        if scene.period_by != protocol.period_by:
            found = str(scene.period_by)
            raise _refusal(name, "--period-by", protocol.period_by or "no rule", found)


def _refusal(name: str, place: str, expected: str, found: str) -> ConfigError:
    return ConfigError(
        place,
        expected=f"{expected}, as --protocol {name} requires",
        found=found,
        todo="correct it, or leave --protocol out",
    )
