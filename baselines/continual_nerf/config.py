"""Options of CLNeRF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import NonNegativeInt, PositiveInt

from chronoscene.fields.config import FieldConfig


@dataclass(frozen=True)
class ContinualConfig(FieldConfig):
    """Options of CLNeRF; the defaults are those of the official code."""

    log2_rows: PositiveInt = 19
    samples: PositiveInt = 262_144
    geometry_size: PositiveInt = 16
    """Length of the geometry code of a period."""
    appearance_size: PositiveInt = 48
    """Length of its appearance code."""
    replay: Literal["none", "stored", "rendered"] = "rendered"
    """Replay of earlier periods under ``sequential``: nothing; the photos that were
    kept; all their training views, rendered by the model as it was, and the kept photos."""
    buffer: NonNegativeInt = 10
    """Photos of earlier periods that are kept, chosen by a reservoir."""
    replay_loss: Literal["squared", "charbonnier"] = "squared"
    """Error of replayed rays: as of new ones; or sqrt(d^2 + 1e-6) with a weight that rises from 0
    to 1 over the period (MEIL-NeRF)."""
    start: Literal["fresh", "warm"] = "fresh"
    """Start of a new period: with a new network, as in the official code, where all that is
    known of earlier ones passes through the replay; or with the model so far."""
