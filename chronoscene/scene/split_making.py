"""New splits of a scene: stratified, in blocks of space, by date of capture, or whole periods.

A strategy chooses the test images. `make_split` applies one and measures how close the test views
are to the training views, because close ones make a split easy.

- ``stratified``: in each period, images in name order are divided into runs of equal length, and
  one image of each run is held out. Test views are everywhere, with training views next to them.
- ``blocked``: the camera positions are divided into blocks of equal size, the same for all periods,
  and whole blocks are held out. No camera of any period trains inside a test block.
- ``date``: in each period, the images taken last are held out: whole days where a period has
  several.
- ``periods``: all images of some periods are held out; methods see no image of these periods.
- ``none``: no images are held out: methods are trained on all of them and cannot be scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from chronoscene.errors import ConfigError, SceneError
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.splits import split_hash, split_of

Strategy = Literal["stratified", "blocked", "date", "periods", "none"]

FRACTION = 1 / 8


@dataclass(frozen=True, slots=True)
class SplitSettings:
    """Settings of the choice of test images."""

    strategy: Strategy = "stratified"
    fraction: float = FRACTION
    """Share of the images of each period (``blocked``: of all images) held out."""
    offset: int = 0
    """``stratified`` without a seed: index of the first test image of each period."""
    seed: int | None = None
    """``stratified``: draw one image of each run instead of the first. ``blocked``: chooses the
    test blocks; None means 0."""
    blocks: int | None = None
    """``blocked``: number of blocks; None for two test blocks, or more if periods need them; for
    two training blocks where more than half of the images are held out."""
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


Times = Mapping[str, datetime | None]
"""Time of capture of each image, by name; None if unknown."""


def make_split(scene: Scene, settings: SplitSettings, times: Times | None = None) -> NewSplit:
    """Give a scene a new split.

    Args:
        scene: Its images are not opened.
        settings: Choice of the test images.
        times: Needed by ``date`` only.

    Raises:
        ConfigError: If the settings do not fit the scene.
        SceneError: If dates are needed and an image has none.
    """
    _check(settings)
    if settings.strategy == "blocked" and settings.seed is None:
        settings = replace(settings, seed=0)
    tests = STRATEGIES[settings.strategy](scene, settings, times or {})
    if len(tests) == len(scene.frames):
        single = len(scene.frames) == scene.num_periods  # no share of one image is less than it
        todo = "hold out whole periods (--strategy periods)" if single else "hold out fewer images"
        raise ConfigError("split", expected="training images", found="none left", todo=todo)
    frames = [replace(f, split=split_of(f.name, tests)) for f in scene.frames]
    new = replace(scene.with_frames(frames), split_rule=f"{settings.strategy} split")
    return NewSplit(
        scene=new,
        settings=settings,
        hash=split_hash(new),
        nearest=_distances(new, same_period=False),
        nearest_same_period=_distances(new, same_period=True),
    )


def hold_out_validation(scene: Scene, seed: int = 0) -> Scene:
    """Hold blocks of the training views back, as test views of a scene without the true ones.

    Test views are left out with all that depends on them: masks, observations, and points that no
    training view sees. Options that are chosen by scores on such a scene know nothing of them.

    Args:
        scene: Its images are not opened.
        seed: Of the choice of blocks.

    Returns:
        The scene of the training views. Whole blocks of them, as ``blocked`` chooses by default,
        are ``test``; where there are fewer views than blocks, single views are.

    Raises:
        SceneError: If a period has no training image, or none can be held back.
    """
    training = np.array([frame.split == "train" for frame in scene.frames], bool)
    frames = scene.select(split="train")
    lacking = [p.label for p in scene.periods if all(f.period != p.id for f in frames)]
    if lacking or len(frames) < 2:
        raise SceneError(
            f"{scene.root}: validation",
            expected="training images in each period, and at least two",
            found=f"none in period {lacking[0]}" if lacking else f"{len(frames)}",
            todo="move some from test to train, or use another scene",
        )
    points, rank = scene.points, np.cumsum(training, dtype=np.int32) - 1
    whole = replace(
        scene,
        frames=frames,
        points=points.select_observed(training[points.track_frame], rank),
        masks={f.name: scene.masks[f.name] for f in frames if f.name in scene.masks},
    )
    blocks = min(len(frames), round(2 / FRACTION))
    try:
        split = make_split(whole, SplitSettings("blocked", seed=seed, blocks=blocks)).scene
    except ConfigError as error:
        raise SceneError(
            f"{scene.root}: validation",
            expected="a period with two training images or more",
            found=f"{len(frames)} training images in {scene.num_periods} periods",
            todo="move some from test to train, or use another scene",
        ) from error
    return replace(split, split_rule="blocked split of the training images")


def _check(settings: SplitSettings) -> None:
    for option, given, strategies in (
        ("--fraction", settings.fraction != FRACTION, ("stratified", "blocked", "date")),
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
    elif settings.seed is not None and settings.offset:
        wrong = ("--offset", "0 with --seed, which draws the images", settings.offset)
    elif settings.blocks is not None and settings.blocks < 2:
        wrong = ("--blocks", "2 or more", settings.blocks)
    if wrong is not None:
        place, expected, found = wrong
        raise ConfigError(place, expected=expected, found=str(found), todo="give another value")


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


def stratified(scene: Scene, settings: SplitSettings, times: Times) -> set[str]:
    """Choose one image of each run of ``1 / fraction`` images in name order, in every period.

    The image is the one at ``offset`` in its run, or with a seed a random one.
    """
    rng = None if settings.seed is None else np.random.default_rng(settings.seed)
    fraction, length = settings.fraction, 1 / settings.fraction
    tests = set()
    for period in scene.periods:
        frames = scene.select(period=period.id)
        for run in range(math.ceil(len(frames) * fraction - 1e-9)):
            first = math.floor(run * length + 1e-9)
            last = min(len(frames), math.floor((run + 1) * length + 1e-9))
            index = first + settings.offset if rng is None else int(rng.integers(first, last))
            if index < len(frames):
                tests.add(frames[index].name)
    return tests


def whole_periods(scene: Scene, settings: SplitSettings, times: Times) -> set[str]:
    """Choose all images of the periods held out."""
    known, periods = {period.id for period in scene.periods}, settings.periods
    if not periods or not set(periods) <= known:
        raise ConfigError(
            "--period",
            expected=f"ids of periods to hold out, 0..{len(known) - 1}",
            found=", ".join(map(str, periods)) or "none",
            todo="give --period once for each of them",
        )
    return {f.name for f in scene.frames if f.period in periods}


def blocked(scene: Scene, settings: SplitSettings, times: Times) -> set[str]:
    """Choose the images of whole blocks of camera positions; by default, of two blocks."""
    centres = camera_centre(scene.frame_poses)
    count = settings.blocks or max(2, round(2 / min(settings.fraction, 1 - settings.fraction)))
    if count > len(centres):
        raise ConfigError(
            "--blocks",
            expected=f"at most one block for each of {len(centres)} images",
            found=str(count),
            todo="ask for fewer blocks (--blocks)",
        )
    block = cut_into_blocks(centres, count)
    wanted = max(1, round(settings.fraction * count))
    chosen = choose_blocks(block, scene.frame_periods, wanted=wanted, seed=settings.seed or 0)
    if not chosen:
        raise ConfigError(
            "split",
            expected="a block whose images can be held out",
            found=f"{count} blocks, each with all images of a period",
            todo="ask for more blocks (--blocks), or hold out whole periods (--strategy periods)",
        )
    return {f.name for f, b in zip(scene.frames, block.tolist(), strict=True) if b in chosen}


def cut_into_blocks(centres: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Cut the cameras into blocks: boxes in space with equally many cameras. [N, 3] -> [N]

    The cameras are split recursively across the longest side of their bounding box, in proportion
    to the number of blocks on either side.
    """
    block = np.zeros(len(centres), np.int64)

    def cut(members: NDArray[np.int64], first: int, number: int) -> None:
        if number == 1:
            block[members] = first
            return
        places = centres[members]
        axis = int(np.argmax(np.ptp(places, axis=0)))
        order = members[np.argsort(places[:, axis], kind="stable")]
        left = number // 2
        middle = round(len(members) * left / number)
        cut(order[:middle], first, left)
        cut(order[middle:], first + left, number - left)

    cut(np.arange(len(centres)), 0, count)
    return block


def choose_blocks(
    block: NDArray[np.int64], periods: NDArray[np.int64], *, wanted: int, seed: int
) -> set[int]:
    """Choose blocks for testing: first those that give most periods their first test image.

    Ties are broken by a random order. No block is taken that would leave a period without
    training images. More than ``wanted`` are taken only while a period has no test image.
    Blocks and periods are those of each image. [N]
    """
    order = np.random.default_rng(seed).permutation(int(block.max()) + 1)
    kinds, period = np.unique(periods, return_inverse=True)
    counts = np.zeros((len(order), len(kinds)), np.int64)
    np.add.at(counts, (block, period), 1)
    counts = counts[order]  # the first of equals is the first in this order
    training, missing = counts.sum(axis=0), np.ones(len(kinds), bool)
    free, chosen = np.ones(len(order), bool), set[int]()
    while len(chosen) < wanted or missing.any():
        possible = free & (counts < training).all(axis=1)
        brings = np.where(possible, (counts[:, missing] > 0).sum(axis=1), -1)
        best = int(np.argmax(brings))
        if brings[best] < 0 or (len(chosen) >= wanted and not brings[best]):
            break
        chosen.add(int(order[best]))
        free[best] = False
        training -= counts[best]
        missing &= counts[best] == 0
    return chosen


def latest(scene: Scene, settings: SplitSettings, times: Times) -> set[str]:
    """Choose the last images of each period, as close to the fraction as whole days allow."""
    taken = {name: time for name, time in times.items() if time is not None}
    if lost := [f.name for f in scene.frames if f.name not in taken]:
        raise SceneError(
            scene.root,
            expected="a date of capture for every image: EXIF DateTimeOriginal, or a file name "
            "that begins with 2023-04-17 or 20230417",
            found=f"none for {len(lost)} of {len(scene.frames)} images, {lost[0]!r} for example",
            todo="choose another strategy, or hold out whole periods (--strategy periods)",
        )
    tests = set()
    for period in scene.periods:
        frames = scene.select(period=period.id)
        ordered = sorted(frames, key=lambda f: (taken[f.name], f.name))
        days = [taken[f.name].date() for f in ordered]
        wanted = settings.fraction * len(ordered)
        # The held-out images begin with a day, except where there is only one.
        starts = [i for i in range(1, len(days)) if days[i] != days[i - 1]]
        if starts:
            start = min(starts, key=lambda i: (abs(len(days) - i - wanted), -i))
        else:
            start = len(days) - max(1, round(wanted))
        tests |= {f.name for f in ordered[start:]}
    return tests


STRATEGIES: Mapping[Strategy, Callable[[Scene, SplitSettings, Times], set[str]]] = {
    "stratified": stratified,
    "blocked": blocked,
    "date": latest,
    "periods": whole_periods,
    "none": lambda scene, settings, times: set(),
}
"""Functions that choose the test images of a scene, by name of the strategy."""
