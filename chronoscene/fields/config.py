"""Options of all methods that are radiance fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from chronoscene.fields.grid import GridLayout
from chronoscene.methods import check_options

GRID_OPTIONS = ("levels", "log2_rows", "base", "finest", "learning_rate")
"""Options of hash grids, which a field without one does not read."""
Cells = Annotated[int, Field(ge=1, le=1 << 20)]
"""Cells along an edge of a level; 64 bits hold the number of all its grid points."""


@dataclass(frozen=True)
class FieldConfig:
    """Options of all radiance fields; lengths are shares of the scene."""

    iterations: PositiveInt = 20_000
    """Training steps."""
    samples: PositiveInt = 65_536
    """Samples of a step; the number of its rays follows."""
    most_rays: PositiveInt = 8_192
    """Rays of a step at most."""
    encoding: Literal["grid", "frequencies"] = "grid"
    """Code of a place: ``grid``, features of a multiresolution hash grid; ``frequencies``, sines
    and cosines, as in NeRF."""
    levels: PositiveInt = 16
    """Levels of the hash grid."""
    log2_rows: Annotated[int, Field(ge=4, le=24)] = 17
    """Logarithm of the largest number of rows of a level."""
    base: Cells = 16
    """Cells along an edge of the first level, in the contracted cube."""
    finest: Cells = 4_096
    """Cells along an edge of the last level; half of them are within the cube of the scene."""
    frequencies: Annotated[int, Field(ge=1, le=64)] = 10
    """Frequencies of each coordinate, if that is the encoding."""
    hidden: PositiveInt = 64
    """Width of hidden layers."""
    layers: PositiveInt = 1
    """Hidden layers of the network of the density."""
    features: PositiveInt = 16
    """Numbers that the network of the density hands on."""
    cells: PositiveInt = 128
    """Cells of the occupancy grid along an edge of the cube of the scene; fewer where they would be
    smaller than the pixels of the photos."""
    spacing: PositiveFloat = 0.3
    """Distance of samples, as a share of such a cell."""
    shells: PositiveInt = 8
    """Samples of a ray outside of the box of the scene, at most."""
    learning_rate: PositiveFloat = 1e-2
    """Learning rate of tables at the start."""
    network_rate: PositiveFloat = 5e-3
    """Learning rate of networks and codes at the start."""
    final_share: PositiveFloat = 1 / 30
    """Share of the learning rates that is left at the end; they fall by a cosine."""
    opacity_weight: NonNegativeFloat = 1e-3
    """Weight of the entropy -o log o of the rays' opacities o in the loss."""

    def __post_init__(self) -> None:
        check_options(self)

    def without_effect(self) -> dict[str, str]:
        """Return options that do nothing beside the others, and what they need."""
        if self.encoding == "grid":
            return {"frequencies": "encoding=frequencies"}
        return dict.fromkeys(GRID_OPTIONS, "encoding=grid")

    @property
    def layout(self) -> GridLayout:
        """Levels of the hash grid."""
        return GridLayout(self.levels, self.log2_rows, self.base, self.finest)
