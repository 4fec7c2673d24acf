"""Published results, as data: numbers that a paper printed, none of ours."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files

from pydantic import BaseModel, ConfigDict, model_validator


class PublishedRow(BaseModel):
    """One scene and method of a published table. PSNR in dB."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    group: str
    scene: str
    method: str
    psnr: float
    ssim: float
    lpips_vgg_3dgs: float


class FurtherTable(BaseModel):
    """Any other table of a publication, with its own columns; None is a cell without a number."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | int | float | None, ...], ...]

    @model_validator(mode="after")
    def _rectangular(self) -> FurtherTable:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError("a row has more or fewer cells than there are columns")
        return self


class PublishedTable(BaseModel):
    """A published table with notes, and the other numbers of its paper."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    source: str
    hardware: str
    notes: tuple[str, ...]
    rows: tuple[PublishedRow, ...]
    memory_gb: Mapping[str, Mapping[str, float]]
    """Group of scenes to method to the printed mean."""
    methods: Mapping[str, str]
    """Printed name of a method to its id, which is the name on the command line if there is one."""
    tables: tuple[FurtherTable, ...]
    inconsistencies: Mapping[str, str]
    """Contradictions in the paper, or with the files of its authors, by a short id."""


def load_published() -> PublishedTable:
    """Read the published table that is shipped with this package."""
    text = files(__package__).joinpath("chronogs_paper.json").read_text(encoding="utf-8")
    return PublishedTable.model_validate_json(text)
