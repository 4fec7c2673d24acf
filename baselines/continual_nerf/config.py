"""Options of CLNeRF, MEIL-NeRF and CL-NeRF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from chronoscene.fields.config import FieldConfig
from chronoscene.fields.grid import GridLayout


@dataclass(frozen=True)
class ReplayConfig(FieldConfig):
    """Options of fields that are learned period by period."""

    log2_rows: Annotated[int, Field(ge=4, le=24)] = 19
    samples: PositiveInt = 262_144
    replay: Literal["none", "stored", "rendered"] = "rendered"
    """Replay of earlier periods under ``sequential``: nothing; the photos that were
    kept; all their training views, rendered by the model as it was, and the kept photos."""
    buffer: NonNegativeInt = 10
    """Photos of earlier periods that are kept, chosen by a reservoir."""
    start: Literal["fresh", "warm"] = "fresh"
    """Start of a new period: with a new network, as in the official code, where all that is
    known of earlier ones passes through the replay; or with the model so far."""


@dataclass(frozen=True)
class ContinualConfig(ReplayConfig):
    """Options of CLNeRF; the defaults are those of the official code."""

    geometry_size: PositiveInt = 16
    """Length of the geometry code of a period."""
    appearance_size: PositiveInt = 48
    """Length of its appearance code."""
    replay_loss: Literal["squared", "charbonnier"] = "squared"
    """Error of replayed rays: as of new ones; or sqrt(d^2 + 1e-6) with a weight that rises from 0
    to 1 over the period (MEIL-NeRF)."""

    def without_effect(self) -> dict[str, str]:
        """Return options that do nothing beside the others, and what they need."""
        replayed = {} if self.replay != "none" else {"replay_loss": "a replay"}
        return super().without_effect() | replayed


@dataclass(frozen=True)
class AdaptorConfig(ReplayConfig):
    """Options of CL-NeRF."""

    replay: Literal["none", "rendered"] = "rendered"
    """Distillation under ``sequential``: none; views of earlier periods, rendered by the model as
    it was, where the new period did not change."""
    buffer: Literal[0] = 0
    """No photos of earlier periods are kept: they would contradict what has changed."""
    start: Literal["warm"] = "warm"
    """A new period begins with the model so far, which stays as it is."""
    expert_log2_rows: Annotated[int, Field(ge=4, le=24)] = 15
    """Logarithm of the largest number of rows of a level in the hash grid of an adaptor."""
    change_weight: NonNegativeFloat = 0.01
    """Weight of the mean share of change that rays see."""

    def without_effect(self) -> dict[str, str]:
        """Return options that do nothing beside the others; adaptors always have grids."""
        idle = super().without_effect()
        return {name: idle[name] for name in idle if name in ("frequencies", "log2_rows")}

    @property
    def expert_layout(self) -> GridLayout:
        """Levels of the hash grid of an adaptor."""
        return GridLayout(self.levels, self.expert_log2_rows, self.base, self.finest)
