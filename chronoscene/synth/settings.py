"""Settings of generated scenes: sizes, number of periods, kind of flight."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError

KINDS = ("aerial", "street", "facing")


def _within(low: float, high: float, default: float, *, option: str | None = None) -> Any:
    """A field whose value must lie in a range; ``option`` is its name for users, if another."""
    return field(default=default, metadata={"range": (low, high), "option": option})


@dataclass(frozen=True, slots=True)
class SynthSettings:
    """All inputs of a synthetic scene. Lengths are metres."""

    kind: str = "aerial"
    """``aerial``: oblique orbits and grids. ``street``: walks along the roads.
    ``facing``: a few metres in front of the city, looking one way."""
    periods: int = _within(1, 50, 3)
    """Number of dates of capture, T."""
    width: int = _within(16, 8192, 320, option="size")
    """Pixels."""
    height: int = _within(16, 8192, 240, option="size")
    """Pixels."""
    views: int = _within(4, 5000, 33)
    """Mean number of images per period; the periods differ around it."""
    points: int = _within(0, 5_000_000, 11_000)
    """Sparse points to aim for."""
    seed: int = _within(0, 2**31 - 1, 0)
    """Each seed gives another city."""
    off_centre: bool = False
    """True for a principal point away from the image centre (and fx different from fy)."""
    blocks: int = _within(2, 9, 3)
    """Blocks of the city core per axis."""
    block_size: float = _within(15.0, 120.0, 40.0)
    """Mean edge length of a block."""
    supersample: int = _within(1, 8, 2)
    """Samples per pixel along each axis."""
    rebuilt: float = _within(0.0, 1.0, 0.0)
    """Share of blocks that are torn down and rebuilt with another role at one period, in addition
    to the changes of every scene. At 1, little more than the streets remains."""
    same_light: bool = False
    """True to keep sun, sky and season of the first period."""
    probe_spacing: float = _within(0.5, 50.0, 3.0)
    """Distance between the probes of indirect light."""
    noise: float = _within(0.0, 100.0, 0.0)
    """Standard deviation of the noise on observed point positions, in pixels."""

    def __post_init__(self) -> None:
        check_choice("--kind", self.kind, KINDS)
        for option in fields(self):
            value = getattr(self, option.name)
            low, high = option.metadata.get("range", (value, value))
            if not low <= value <= high:
                raise ConfigError(
                    f"--{option.metadata['option'] or option.name}",
                    expected=f"a value from {low} to {high}",
                    found=str(value),
                    todo="choose a value in this range",
                )


PRESETS: dict[str, SynthSettings] = {
    "tiny": SynthSettings(
        periods=2,
        width=64,
        height=48,
        views=11,
        points=1_500,
        blocks=2,
        block_size=22.0,
        probe_spacing=4.0,
    ),
    "demo": SynthSettings(off_centre=True),
    "city": SynthSettings(
        periods=4,
        width=640,
        height=480,
        views=66,
        points=64_000,
        off_centre=True,
        blocks=4,
        block_size=46.0,
    ),
}
"""Settings for tests, for a demonstration on a laptop and for a real benchmark."""


def preset(name: str, **changes: Any) -> SynthSettings:
    """Settings of a preset, with some fields changed.

    Raises:
        ConfigError: If the name is unknown or a value is out of range.
    """
    check_choice("--preset", name, PRESETS)
    return replace(PRESETS[name], **changes)
