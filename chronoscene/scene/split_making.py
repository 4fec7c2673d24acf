"""New splits of a scene: stratified, in blocks of space, by date of capture, or whole periods.

A strategy chooses the test images. `make_split` applies one and measures how close the test views
are to the training views, because close ones make a split easy.

- ``stratified``: in each period, images in name order are divided into runs of equal length, and
  one image of each run is held out. Test views are everywhere, with training views next to them.
- ``blocked``: the camera positions are divided into blocks of equal size, the same for all periods,
  and whole blocks are held out. No camera of any period trains inside a test block.
- ``date``: in each period, the images taken last are held out: whole days where a period has
  several.
- ``periods``: all images of some periods are held out; methods see nothing of these periods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.errors import ConfigError
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.split_strategies import blocked, latest, stratified, whole_periods
from chronoscene.scene.splits import split_hash, split_of

Strategy = Literal["stratified", "blocked", "date", "periods"]

STRATEGIES: tuple[Strategy, ...] = ("stratified", "blocked", "date", "periods")

FRACTION = 1 / 8


@dataclass(frozen=True, slots=True)
class SplitSettings:
    """How to choose test images."""

    strategy: Strategy = "stratified"
    fraction: float = FRACTION
    """Share of the images of each period (``blocked``: of all images) held out."""
    offset: int = 0
    """``stratified`` without a seed: index of the first test image of each period."""
    seed: int | None = None
    """``stratified``: draw one image of each run instead of the first. ``blocked``: chooses the
    test blocks; None means 0."""
    blocks: int | None = None
    """``blocked``: number of blocks; None for two test blocks, or more if periods need them."""
    periods: tuple[int, ...] = ()
    """``periods``: ids of the periods held out."""


@dataclass(frozen=True, slots=True, eq=False)
class NewSplit:
    """A scene with its new split, and how hard the split is."""

    scene: Scene
    settings: SplitSettings
    hash: str
    nearest: tuple[float, float] | None
    """Median and smallest distance from a test camera to the nearest training camera, in world
    units; None if there are no test or no training cameras."""
    nearest_same_period: tuple[float, float] | None
    """The same among training cameras of the same period."""

    def record(self) -> dict[str, Any]:
        """Everything except the scene, for a JSON file."""

        def pair(values: tuple[float, float] | None) -> dict[str, float] | None:
            return None if values is None else {"median": values[0], "min": values[1]}

        return {
            "schema_version": 1,
            "scene": self.scene.name,
            **asdict(self.settings),
            "periods": list(self.settings.periods),
            "split_hash": self.hash,
            "counts": [
                {
                    "id": period.id,
                    "label": period.label,
                    "train": len(self.scene.select(split="train", period=period.id)),
                    "test": len(self.scene.select(split="test", period=period.id)),
                }
                for period in self.scene.periods
            ],
            "distance_to_nearest_training_camera": pair(self.nearest),
            "distance_to_nearest_training_camera_of_the_period": pair(self.nearest_same_period),
        }


def make_split(scene: Scene, settings: SplitSettings) -> NewSplit:
    """Give a scene a new split.

    Raises:
        ConfigError: If the settings do not fit the scene.
        SceneError: If dates are needed and an image has none.
    """
    _check(settings)
    if settings.strategy == "blocked" and settings.seed is None:
        settings = replace(settings, seed=0)
    tests = _CHOOSE[settings.strategy](scene, settings)
    if len(tests) == len(scene.frames):
        raise ConfigError(
            "split",
            expected="training images",
            found="none left",
            todo="hold out fewer images",
        )
    frames = [replace(f, split=split_of(f.name, tests)) for f in scene.frames]
    new = replace(scene.with_frames(frames), split_rule=f"{settings.strategy} split")
    return NewSplit(
        scene=new,
        settings=settings,
        hash=split_hash(new),
        nearest=_distances(new, same_period=False),
        nearest_same_period=_distances(new, same_period=True),
    )


def _check(settings: SplitSettings) -> None:
    for option, given, strategies in (
        ("--offset", settings.offset != 0, ("stratified",)),
        ("--seed", settings.seed is not None, ("stratified", "blocked")),
        ("--blocks", settings.blocks is not None, ("blocked",)),
        ("--period", settings.periods != (), ("periods",)),
    ):
        if given and settings.strategy not in strategies:
            raise ConfigError(
                option,
                expected=f"--strategy {' or '.join(strategies)} with this option",
                found=settings.strategy,
                todo="leave the option out, or choose another strategy",
            )
    wrong = None
    if not 0 < settings.fraction < 1:
        wrong = ("--fraction", "a number between 0 and 1", settings.fraction)
    elif not 0 <= settings.offset < 1 / settings.fraction:
        wrong = ("--offset", "0 or more, and less than 1 / fraction", settings.offset)
    elif settings.seed is not None and settings.seed < 0:
        wrong = ("--seed", "0 or more", settings.seed)
    elif settings.blocks is not None and settings.blocks < 2:
        wrong = ("--blocks", "2 or more", settings.blocks)
    if wrong is not None:
        place, expected, found = wrong
        raise ConfigError(place, expected=expected, found=str(found), todo="give another value")


_CHOOSE: Mapping[Strategy, Callable[[Scene, SplitSettings], set[str]]] = {
    "stratified": lambda scene, s: stratified(scene, s.fraction, s.offset, s.seed),
    "blocked": lambda scene, s: blocked(scene, s.fraction, s.blocks, s.seed or 0),
    "date": lambda scene, s: latest(scene, s.fraction),
    "periods": lambda scene, s: whole_periods(scene, s.periods),
}


def _distances(scene: Scene, *, same_period: bool) -> tuple[float, float] | None:
    """Median and smallest distance from a test camera to the nearest training camera."""
    groups = [p.id for p in scene.periods] if same_period else [None]
    found: list[float] = []
    for period in groups:
        test = scene.select(split="test", period=period)
        train = scene.select(split="train", period=period)
        if test and train:
            a, b = (camera_centre(np.stack([f.cam_from_world for f in s])) for s in (test, train))
            found += cKDTree(b).query(a)[0].tolist()
    return (float(np.median(found)), float(np.min(found))) if found else None
