"""Images and points of the ChronoScene dataset, as its paper prints them.

Source: table of counts in "ChronoGS: Disentangling Invariants and Changes in Multi-Period Scenes",
CVPR 2026 (arXiv 2511.18794). Facts only; nothing here was measured by us.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

PAPER_COUNTS: Mapping[str, tuple[tuple[int, int], ...]] = {
    "Lawncourt": ((234, 85_655), (193, 57_884), (277, 117_595)),
    "Overstreet": ((83, 35_513), (295, 235_537), (208, 132_957)),
    "BioBuilding": ((258, 120_122), (240, 143_694), (258, 171_462)),
    "Canteen": ((340, 101_523), (183, 99_915), (279, 159_250)),
    "Incubator": ((202, 98_073), (199, 126_315), (194, 125_461)),
    "TriPlot": ((365, 150_896), (94, 50_081), (189, 106_937)),
    "Street1": ((200, 110_591), (200, 108_932), (200, 95_038), (200, 101_074)),
    "Street2": ((200, 108_621), (200, 112_293), (200, 101_061), (200, 110_714)),
    "Aerial1": ((200, 136_491), (200, 116_790), (200, 136_624), (200, 101_494)),
    "Aerial2": ((200, 116_443), (200, 115_481), (200, 109_213), (200, 116_434)),
    "Aerial3": ((200, 171_323), (200, 145_781), (200, 139_733), (200, 73_597)),
    "Aerial4": ((200, 144_446), (200, 133_058), (200, 129_169), (200, 92_044)),
}
"""Scene to (images, points) of each period, in the paper's order: real scenes, then synthetic."""

PAPER_TOTALS = (
    (2_682, 1_379_697),
    (2_404, 1_445_761),
    (2_605, 1_524_500),
    (1_200, 595_357),
    (8_891, 4_945_315),
)
"""The last row of the table as printed: images and points of periods 0 to 3, and of all."""


def published(name: str) -> tuple[tuple[int, int], ...] | None:
    """Images and points of each period as printed, if a scene of this name is in the paper."""
    return PAPER_COUNTS.get(_BY_NAME.get(name.casefold(), ""))


def in_paper_order(folders: Sequence[Path]) -> list[Path]:
    """Scenes of the paper as its table lists them, then all others in the order they have."""
    ranks = {name: rank for rank, name in enumerate(PAPER_COUNTS)}
    return sorted(folders, key=lambda p: ranks.get(_BY_NAME.get(p.name.casefold(), ""), len(ranks)))


_BY_NAME = {name.casefold(): name for name in PAPER_COUNTS}
