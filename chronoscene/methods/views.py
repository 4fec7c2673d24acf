"""Views and training sets: everything that a method sees of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.similarity import Sim3


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A pinhole camera to render: intrinsics in pixels, pose in the training frame."""

    K: NDArray[np.float64]
    """[3, 3]"""
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    """[4, 4]; the world here is the training frame."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView(View):
    """A view with an image to learn from."""

    name: str
    period: int


def no_mask(index: int) -> None:
    """`TrainingSet.load_mask` of sets whose images count everywhere."""


def nothing_ahead(indices: Sequence[int]) -> None:
    """`TrainingSet.expect` of sets whose images are at hand."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """Data that a method may learn from, in the normalised training frame.

    The training frame is the world, recentred and scaled in float64 before anything is cast to
    float32: learning rates and voxel sizes depend on its scale. The inverse of
    `training_from_world` leads back.
    """

    views: tuple[TrainingView, ...]
    num_periods: int
    """1 where the harness hides the period; those so far where they arrive one after the other."""
    points: NDArray[np.float32]
    """Sparse points that a training view of these periods sees. [P, 3]"""
    colors: NDArray[np.uint8]
    """[P, 3]"""
    point_periods: NDArray[np.bool_]
    """True where a training view of the period sees the point. [P, T]"""
    training_from_world: Sim3
    camera_extent: float
    """1.1 times the largest distance of a training camera from their mean, in training units."""
    background: NDArray[np.float32]
    """Colour behind everything, 0..1. [3]"""
    load_image: Callable[[int], NDArray[np.uint8]]
    """Image of ``views[i]``, decoded lazily and cached. [H, W, 3]"""
    load_mask: Callable[[int], NDArray[np.bool_] | None] = no_mask
    """Pixels of ``views[i]`` that count; None if all do. The others must not change the model.
    [H, W]"""
    expect: Callable[[Sequence[int]], None] = nothing_ahead
    """Function to call with the views whose images will be loaded next, in their order: they are
    decoded while the method does something else. A method that never calls it waits for each
    image."""
