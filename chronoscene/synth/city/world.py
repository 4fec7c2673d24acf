"""The world over time: named elements with a state per period, and the edits between periods."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.synth.render.light import Light
from chronoscene.synth.render.mesh import Mesh, merge

CHANGE_VERBS = {
    "building": "rebuild",
    "facade": "reclad",
    "tree": "grow",
    "lawn": "season",
    "ground": "resurface",
}
"""Name of a change of state by kind of element; other kinds have ``change``."""


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """One state of an object and the periods that show it."""

    name: str
    """Identity of the object, shared by its states."""
    kind: str
    state: str
    periods: tuple[int, ...]
    mesh: Mesh


@dataclass(frozen=True, slots=True)
class Edit:
    """A difference between a period and the one before it."""

    period: int
    """The first period that shows the new state."""
    action: str
    """``add``, ``remove`` or a verb of change."""
    target: str
    kind: str
    before: str | None
    after: str | None
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    """Bounding box of both states: minimum and maximum corner, in metres."""


@dataclass(slots=True)
class World:
    """Everything that can be photographed."""

    seed: int
    lights: list[Light]
    core: Array
    """Rectangle of the city core: minimum and maximum corner. [2, 2]"""
    near: bool = False
    """True if cameras come close to the suburbs, which then need more detail."""
    roads: list[tuple[Array, Array]] = field(default_factory=list)
    """Start and end of the centre lines of the core's roads, for walks. [2] each"""
    elements: list[Element] = field(default_factory=list)
    edits: list[Edit] = field(default_factory=list)
    lifetime: frozenset[int] | None = None
    """Periods in which objects now being added exist; None for all. See `during`."""

    @property
    def periods(self) -> int:
        return len(self.lights)

    @property
    def names(self) -> list[str]:
        """Names of the objects; the position in this list is the identity number."""
        return list(dict.fromkeys(e.name for e in self.elements))

    @contextmanager
    def during(self, periods: Sequence[int]) -> Iterator[None]:
        """Objects added inside the ``with`` block exist in these periods only."""
        self.lifetime = frozenset(periods)
        try:
            yield
        finally:
            self.lifetime = None

    def add(
        self, name: str, kind: str, states: Sequence[Hashable], make: Callable[[Any], Mesh]
    ) -> None:
        """Add an object by its state in each period.

        Args:
            name: Unique name.
            kind: Kind of object, for the edit list.
            states: One per period, None where the object is absent; equal states share geometry.
            make: Builds the geometry of a state.
        """
        assert len(states) == self.periods
        if self.lifetime is not None:
            states = [s if p in self.lifetime else None for p, s in enumerate(states)]
        meshes: dict[Hashable, Mesh] = {}
        for state in states:
            if state is not None and state not in meshes:
                meshes[state] = make(state)
        for state, mesh in meshes.items():
            periods = tuple(p for p, s in enumerate(states) if s == state)
            self.elements.append(Element(name, kind, _label(state), periods, mesh))
        for p in range(1, self.periods):
            before, after = states[p - 1], states[p]
            if before != after:
                known = [meshes[s] for s in (before, after) if s is not None]
                self.edits.append(_edit(p, name, kind, before, after, known))

    def place(
        self, name: str, kind: str, present: Sequence[bool], make: Callable[[], Mesh]
    ) -> None:
        """Add an object that looks the same in every period in which it is present."""
        if any(present):
            self.add(name, kind, ["there" if p else None for p in present], lambda _: make())

    def always(self, name: str, kind: str, make: Callable[[], Mesh]) -> None:
        """Add an object that never changes."""
        self.place(name, kind, [True] * self.periods, make)

    @property
    def seasons(self) -> list[str]:
        """Season of each period."""
        return [light.season for light in self.lights]

    def geometry(self, period: int) -> tuple[Mesh, NDArray[np.int32]]:
        """All geometry of a period and the identity number of each triangle's object."""
        number = {name: i for i, name in enumerate(self.names)}
        here = [e for e in self.elements if period in e.periods]
        ids = [np.full(len(e.mesh.tri_patch), number[e.name], np.int32) for e in here]
        return merge([e.mesh for e in here]), np.concatenate(ids)


def _label(state: Hashable) -> str:
    """A state as text: the items of a tuple joined by spaces."""
    return " ".join(map(str, state if isinstance(state, tuple) else (state,)))


def _edit(
    period: int, name: str, kind: str, before: Hashable, after: Hashable, meshes: list[Mesh]
) -> Edit:
    verb = "add" if before is None else "remove"
    if before is not None and after is not None:
        verb = CHANGE_VERBS.get(kind, "change")
    bounds = np.stack([p.bounds for p in meshes])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    old, new = (None if state is None else _label(state) for state in (before, after))
    return Edit(period, verb, name, kind, old, new, (tuple(low.tolist()), tuple(high.tolist())))


SITE = ("lot", "foundation", "frame_low", "frame_high", "finished")


def site_stages(periods: int) -> list[str]:
    """Stages of a building site per period, from the empty lot to the finished building.

    Three periods show lot, frame, finished; a single period shows the finished building.
    """
    if periods == 1:
        return ["finished"]
    if periods == 3:
        return ["lot", "frame_high", "finished"]
    steps = np.linspace(0, len(SITE) - 1, min(periods, len(SITE)))
    stages = [SITE[int(np.floor(s + 0.5))] for s in steps]
    return stages + ["finished"] * (periods - len(stages))


def renewal_stages(periods: int) -> list[str]:
    """Stages per period of a house that is demolished and replaced by a car park."""
    if periods == 1:
        return ["house"]
    fall = 1 if periods < 4 else 2
    after = ["rubble", *["park"] * periods] if periods > 2 else ["park"]
    return (["house"] * fall + after)[:periods]


def looks(rng: np.random.Generator, periods: int, chance: float) -> list[int]:
    """Index of a facade's look per period; it changes at most once, with the given chance."""
    states = [0] * periods
    if periods > 1 and rng.random() < chance:
        change = int(rng.integers(1, periods))
        states[change:] = [1] * (periods - change)
    return states


def tree_heights(rng: np.random.Generator, periods: int, start: float) -> list[float | None]:
    """Height per period, growing by 20 to 60 % overall; some trees are planted late or felled."""
    growth = float(rng.uniform(1.2, 1.6)) ** (1 / max(periods - 1, 1))
    heights: list[float | None] = [round(start * growth**p, 2) for p in range(periods)]
    fate = rng.random()
    if periods > 1 and fate < 0.2:
        change = int(rng.integers(1, periods))
        if fate < 0.1:
            heights[:change] = [None] * change
        else:
            heights[change:] = [None] * (periods - change)
    return heights


def visits(rng: np.random.Generator, periods: int, chance: float) -> list[bool]:
    """Draw in which periods a movable object is present."""
    return [bool(x) for x in rng.random(periods) < chance]
