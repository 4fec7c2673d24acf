"""One thread that draws the pictures of all viewers: for each the newest one that it asked for.

What was asked for before is never drawn. The viewer who has waited longest comes first. While
something moves, pictures have as many pixels as can be drawn in time; at rest they are drawn again
with more until they are complete, and then the thread sleeps.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Hashable
from concurrent.futures import CancelledError
from dataclasses import dataclass, field

from chronoscene.methods import Prediction

UPDATES = 20
"""Pictures a second while something moves."""
SHARE = 0.8  # Of that time in which a picture is drawn; sending takes the rest
FULL, LEAST = 1920 * 1080, 96 * 72  # Most and fewest pixels of a picture
OTHER_SIZE = 2  # Ratio of pixels from which two pictures tell what pixels take
GROWTH = 4  # From each picture at rest to the next, so that a movement never waits long
REST, MOVING = 0.15, 0.5
"""Seconds after a request from which its picture rests, and in which its viewer is moving."""
HANDOVER = 0.001  # Seconds in which the thread can begin a picture before others draw again
PATIENCE = 2.0  # Seconds to wait for the end of the thread

Draw = Callable[[int], None]
"""Draws and sends a picture with so many pixels, and raises nothing."""


@dataclass
class Resolution:
    """Number of pixels that can be drawn in time.

    Methods that decode a scene for each view take time for that however small the picture is. It is
    found by pictures of other sizes. Where it is most of the time that there is, fewer pixels gain
    little, and pixels may take a third of that time again.
    """

    pixels: float = 320 * 240
    fixed: float = 0.0
    """Seconds that no number of pixels saves."""
    compared: tuple[float, float] | None = None
    """Pixels and seconds of an earlier picture of another size."""

    def observe(self, pixels: float, seconds: float) -> None:
        """Learn from a picture what it takes without pixels."""
        self.fixed = min(self.fixed, seconds)
        self.compared = self.compared or (pixels, seconds)
        before, took = self.compared
        if max(pixels, before) > OTHER_SIZE * min(pixels, before):
            slope = max(0.0, (seconds - took) / (pixels - before))
            self.fixed = max(0.0, seconds - slope * pixels)
            self.compared = (pixels, seconds)

    def rest(self) -> None:
        """Trust less in what was found, since another model may be shown next."""
        self.fixed /= 2

    def adapt(self, seconds: float, moving: int = 1) -> None:
        """Adapt to the time that a picture took, where so many viewers share the time."""
        wanted = SHARE / UPDATES / max(1, moving)
        wanted = max(wanted - self.fixed, self.fixed / 3)
        factor = math.sqrt(wanted / max(seconds - self.fixed, 1e-6))  # half of the way
        self.pixels = min(max(self.pixels * min(max(factor, 0.6), 1.3), LEAST), FULL)


@dataclass(eq=False)
class _Seat:
    """State of a viewer. All times are in seconds."""

    draw: Draw
    """The newest request."""
    resolution: Resolution = field(default_factory=Resolution)
    served: float = -math.inf
    """Time of the last picture."""
    full: int = 0
    """Pixels of its complete picture."""
    drawn: int = 0
    """Pixels of its last picture."""
    asked: float = -math.inf
    due: float = math.inf
    """Time from which its next picture may be drawn."""


class RenderWorker:
    """Draws for any number of viewers, which are named by keys. Thread-safe."""

    def __init__(self) -> None:
        """Start the thread."""
        self._seats: dict[Hashable, _Seat] = {}
        self._stopped = False
        self._drawing, self._changed = threading.Lock(), threading.Condition()
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def request(self, key: Hashable, draw: Draw, size: tuple[int, int]) -> None:
        """Replace what a viewer asked for; ``size`` is that of the complete picture."""
        with self._changed:
            seat = self._seats.setdefault(key, _Seat(draw))
            seat.draw, seat.full, seat.drawn = draw, min(size[0] * size[1], FULL), 0
            seat.asked = seat.due = time.monotonic()
            self._changed.notify()

    def close(self, key: Hashable) -> None:
        """Forget a viewer; unknown ones are ignored."""
        with self._changed:
            self._seats.pop(key, None)

    def between(self, render: Callable[[], Prediction]) -> Prediction:
        """Render for another purpose, in the calling thread, while no picture is drawn.

        Raises:
            CancelledError: If the worker was stopped.
        """
        time.sleep(HANDOVER)
        with self._drawing:
            if self._stopped:
                raise CancelledError
            return render()

    def stop(self) -> bool:
        """End the thread after the picture that is being drawn; False if that takes long."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(PATIENCE)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (seat := self._next()) is not None:
            self._serve(seat)

    def _next(self) -> _Seat | None:
        """Wait for the next picture; None at the end."""
        with self._changed:
            while not self._stopped:
                now = time.monotonic()
                if ready := [seat for seat in self._seats.values() if seat.due <= now]:
                    return min(ready, key=lambda seat: seat.served)
                due = min((seat.due for seat in self._seats.values()), default=math.inf)
                self._changed.wait(None if due == math.inf else due - now)
            return None

    def _serve(self, seat: _Seat) -> None:
        with self._changed:
            draw, drawn, full = seat.draw, seat.drawn, seat.full
            moving = sum(seat.due - each.asked < MOVING for each in self._seats.values())
            seat.served, seat.due = time.monotonic(), math.inf
        pixels = min(GROWTH * drawn if drawn else int(seat.resolution.pixels), full)
        with self._drawing:
            draw(pixels)
        with self._changed:
            seconds = time.monotonic() - seat.served
            seat.resolution.observe(pixels, seconds)
            if not drawn:
                seat.resolution.adapt(seconds, moving)
            elif pixels == full:
                seat.resolution.rest()
            if seat.draw is draw:
                seat.drawn = pixels
                seat.due = seat.asked + REST if pixels < full else math.inf
