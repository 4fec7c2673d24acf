"""Published results, as data: what a paper printed, never what we measured."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files

from pydantic import BaseModel, ConfigDict


class PublishedRow(BaseModel):
    """One scene and method of a published table. PSNR in dB."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    group: str
    scene: str
    method: str
    psnr: float
    ssim: float
    lpips_vgg_3dgs: float


class PublishedTable(BaseModel):
    """A published table with what must be known to read it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    hardware: str
    notes: tuple[str, ...]
    rows: tuple[PublishedRow, ...]
    memory_gb: Mapping[str, Mapping[str, float]]
    """Group of scenes to method to the printed mean."""

    def mean(self, method: str, metric: str, *, group: str | None = None) -> float:
        """Unweighted mean of a metric over the scenes of a group, or over all.

        Raises:
            KeyError: If no row matches.
        """
        values = [
            getattr(row, metric)
            for row in self.rows
            if row.method == method and group in (None, row.group)
        ]
        if not values:
            raise KeyError(f"{method} has no row in group {group}")
        return sum(values) / len(values)


def load_published(name: str = "chronogs_paper") -> PublishedTable:
    """Read a table from ``leaderboard/entries``."""
    text = files("leaderboard").joinpath("entries", f"{name}.json").read_text(encoding="utf-8")
    return PublishedTable.model_validate_json(text)
