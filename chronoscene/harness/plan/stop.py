"""End of a training: after some iterations, after a time, or both."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from decimal import Decimal

from chronoscene.errors import ConfigError

_UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}


def parse_duration(text: str, option: str = "--budget") -> float:
    """Seconds of ``90s``, ``5m``, ``1.5h`` or ``1h30m``.

    Raises:
        ConfigError: If the text is none of these or not positive.
    """
    pieces = re.findall(r"(\d+(?:\.\d+)?)([hms])", text)
    seconds = sum(float(number) * _UNITS[unit] for number, unit in pieces)
    if "".join(number + unit for number, unit in pieces) != text or not seconds:
        raise ConfigError(
            option,
            expected="a positive time such as 90s, 5m or 1h30m",
            found=repr(text),
            todo="write numbers with the units h, m or s",
        )
    return seconds


def duration_text(seconds: float) -> str:
    """Format seconds as `parse_duration` reads them: six digits, or all where six need an ``e``."""
    text = f"{seconds:g}"
    if "e" in text:
        text = f"{Decimal(repr(float(seconds))):f}".removesuffix(".0")
    return f"{text}s"


@dataclass(frozen=True, slots=True)
class StopRule:
    """End of a training: after some iterations, after a time, or whichever comes first."""

    iterations: int | None
    seconds: float | None

    def progress(self, iterations: int, seconds: float) -> float:
        """Share of the training that is over, 0..1."""
        shares = [0.0]
        if self.iterations is not None:
            shares.append(iterations / self.iterations if self.iterations else 1.0)
        if self.seconds is not None:
            shares.append(seconds / self.seconds)
        return min(1.0, max(shares))

    def seconds_left(self, iterations: int, seconds: float) -> float | None:
        """Estimate of the training time that is left; None if there is nothing to go by yet."""
        progress = self.progress(iterations, seconds)
        return seconds * (1.0 - progress) / progress if progress > 0 else None

    def times(self, count: int) -> StopRule:
        """Multiply the iterations and the seconds."""
        iterations = None if self.iterations is None else self.iterations * count
        return StopRule(iterations, None if self.seconds is None else self.seconds * count)

    def split(self, parts: int) -> tuple[StopRule, ...]:
        """Equal shares for several models; the first ones get what is left over."""
        seconds = None if self.seconds is None else self.seconds / parts
        if self.iterations is None:
            return (replace(self, seconds=seconds),) * parts
        base, extra = divmod(self.iterations, parts)
        return tuple(StopRule(base + (i < extra), seconds) for i in range(parts))
