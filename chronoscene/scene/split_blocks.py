"""Splits in blocks of space: test cameras apart from the training cameras of all periods."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import ConfigError
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre


def blocked(scene: Scene, fraction: float, blocks: int | None, seed: int) -> set[str]:
    """The images of whole blocks of camera positions.

    Args:
        scene: Any scene.
        fraction: Share of the blocks that are for testing.
        blocks: Their number; None for two test blocks.
        seed: Which blocks.

    Raises:
        ConfigError: If there are more blocks than images.
    """
    centres = camera_centre(np.stack([f.cam_from_world for f in scene.frames]))
    count = blocks or max(2, round(2 / fraction))
    if count > len(centres):
        raise ConfigError(
            "--blocks",
            expected=f"at most one block for each of {len(centres)} images",
            found=str(count),
            todo="ask for fewer blocks",
        )
    block = cut_into_blocks(centres, count)
    periods = scene.frame_periods
    wanted = max(1, round(fraction * count))
    chosen = choose_blocks(block, periods, wanted, seed)
    return {f.name for f, b in zip(scene.frames, block.tolist(), strict=True) if b in chosen}


def cut_into_blocks(centres: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Block of each camera; blocks are boxes in space with equally many cameras.

    The cameras are cut across the longest side of their box, again and again; a cut parts them in
    proportion to the blocks that each side is to have. [N, 3] -> [N]
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
    block: NDArray[np.int64], periods: NDArray[np.int64], wanted: int, seed: int
) -> set[int]:
    """Blocks for testing: first those that bring test images to most periods without any.

    Among equals, a random order decides. No block is taken that would leave a period without
    training images. More than ``wanted`` are taken only while periods have no test image.

    Args:
        block: Block of each image. [N]
        periods: Period of each image. [N]
        wanted: Number of blocks.
        seed: Of the random order.
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
