"""Interface of a method: what the harness gives it, and what it hands back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, computed_field

from chronoscene.methods.options import MethodConfig
from chronoscene.methods.spec import MethodSpec, import_object
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.similarity import Sim3

Skipped = Literal["empty", "not finite"]
POSITIONS = ("anchors", "means")
"""Names of the tensor of positions in a stored model that is a set of anchors or Gaussians."""

HALVED_PIXELS = 400_000
"""Pixels of a photo from which the option `half_size_share` applies. Below, the time of a step
depends on the Gaussians more than on the pixels, and half a photo shows too little of them."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
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


class SparseDepths(NamedTuple):
    """Depths of sparse points in a view, of one point in a pixel."""

    pixels: NDArray[np.int64]
    """Row times width of the view plus column, ascending. [S]"""
    depths: NDArray[np.float32]
    """z-depth in units of the training frame. [S]"""


def no_depths(index: int) -> SparseDepths:
    """`TrainingSet.load_depths` of sets whose points have no observations."""
    return SparseDepths(np.zeros(0, np.int64), np.zeros(0, np.float32))


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
    scene_extent: float
    """`camera_extent`, or 0.55 times the median depth of the points where that is larger: where
    the cameras stand close together, before what they see."""
    background: NDArray[np.float32]
    """Colour behind everything, 0..1. [3]"""
    load_image: Callable[[int], NDArray[np.uint8]]
    """Image of ``views[i]``, decoded lazily and cached. [H, W, 3]"""
    load_mask: Callable[[int], NDArray[np.bool_] | None] = no_mask
    """Pixels of ``views[i]`` that count; None if all do. The others must not change the model.
    [H, W]"""
    load_depths: Callable[[int], SparseDepths] = no_depths
    """Depths of the sparse points that the image of ``views[i]`` observes, as at least two others
    do, where its mask counts."""
    expect: Callable[[Sequence[int]], None] = nothing_ahead
    """Function to call with the views whose images will be loaded next, in their order: they are
    decoded while the method does something else. A method that never calls it waits for each
    image."""

    def with_views(self, numbers: Sequence[int]) -> TrainingSet:
        """Return the set with some of its views, in the order of these numbers."""
        return replace(
            self,
            views=tuple(self.views[i] for i in numbers),
            load_image=lambda i: self.load_image(numbers[i]),
            load_mask=lambda i: self.load_mask(numbers[i]),
            load_depths=lambda i: self.load_depths(numbers[i]),
            expect=lambda indices: self.expect([numbers[i] for i in indices]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A rendered view."""

    rgb: NDArray[np.float32]
    """0..1. [H, W, 3]"""
    alpha: NDArray[np.float32] | None = None
    """[H, W]"""
    depth: NDArray[np.float32] | None = None
    """Expected z-depth in units of the training frame; 0 where alpha is 0. [H, W]"""
    drawn: int | None = None
    """Gaussians, or whatever the method draws, that touch the image."""


@dataclass(frozen=True, slots=True)
class StepReport:
    """Report of one training step."""

    loss: float
    primitives: int
    """Gaussians or anchors held now."""
    skipped: Skipped | None = None
    """Reason why nothing was learned, so that no parameter and no moment of the optimiser changed:
    ``empty``, the view shows no primitive, or its mask ignores all of the image; ``not finite``,
    the loss or a gradient was not."""
    not_finite: tuple[str, ...] = ()
    """Names of the tensors whose gradients were not finite, if the method knows them."""
    views: int = 1
    """Number of training views that the step has seen: by so many the iterations go on."""


@dataclass(frozen=True, slots=True)
class MethodSize:
    """Size of a trained model."""

    primitives: int
    parameters: int
    """Numbers stored in the checkpoint."""
    unit: str = "primitives"
    """Name of the primitives: ``Gaussians``, ``anchors``."""


@dataclass(frozen=True, slots=True)
class PeriodSharing:
    """Account of what the periods of a model share.

    A block is what a primitive stores for one period, or for several that share it.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="ignore")  # what is computed is stored, too

    blocks: tuple[int, ...]
    """Primitives with 1, 2, ... T blocks. [T]"""
    period_numbers: tuple[int, ...]
    """Numbers stored for each period alone. [T]"""
    partly_shared_numbers: int
    """Numbers that some periods share, but not all."""
    shared_numbers: int
    """All others, down to the table that says who shares."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def invariant_share(self) -> float:
        """Share of the primitives that have one block for all periods."""
        return self.blocks[0] / max(sum(self.blocks), 1)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def mean_blocks(self) -> float:
        """Mean number of blocks of a primitive."""
        total = sum(number * count for number, count in enumerate(self.blocks, start=1))
        return total / max(sum(self.blocks), 1)

    @property
    def mean_period_numbers(self) -> float:
        """Mean of `period_numbers`."""
        return sum(self.period_numbers) / len(self.period_numbers)


class Method(Protocol):
    """Interface of a method. ``method(config)`` makes one, `setup` or `load` fills it."""

    def __init__(self, config: MethodConfig) -> None: ...

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        """Build the initial model. Nothing else draws from the global random state."""

    def step(self, index: int, progress: float) -> StepReport:
        """Do one training step.

        Args:
            index: Number of iterations done before, from 0: steps, or their `StepReport.views`.
            progress: Share of the training that is over, 0..1. Every schedule (learning rates,
                densification) follows it, so that a run that ends by the clock goes through the
                same phases as one that ends after a number of iterations.
        """

    def render(self, view: View, period: float) -> Prediction:
        """Render a view as of a period; fractional only where the spec says ``continuous``."""

    def save(self, folder: Path) -> None:
        """Write ``model.safetensors`` and ``model.json`` into an existing empty folder."""

    def load(self, folder: Path, *, device: str) -> None:
        """Read what `save` wrote; `render` then gives the same pixels."""

    def size(self) -> MethodSize: ...

    def sharing(self) -> PeriodSharing | None:
        """Count what periods share; None if the options leave nothing that they could share.

        Only where primitives have something of their own for each period; a method without it has
        no such function.
        """

    def render_split(
        self, view: View, *, geometry_period: float, appearance_period: float
    ) -> Prediction:
        """Render the geometry of one period in the colours of another.

        Only where a method keeps them apart; one that does not has no such function.
        """

    def fitted_to(
        self, view: View, period: float, photo: NDArray[np.uint8], known: NDArray[np.bool_]
    ) -> Method:
        """Return the model with its appearance fitted to some pixels of the photo of a view.

        For ``bench --fit-half``; only where appearance belongs to single photos, else there is no
        such function. The model itself does not change, and pixels that are not known are not read.

        Args:
            view: The camera of the photo.
            period: As for `render`.
            photo: [H, W, 3]
            known: Pixels that may be used. [H, W]
        """

    def to_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """Return the model as of a period as Gaussians with spherical harmonics.

        Only where a method draws Gaussians; one that does not has no such function.

        Args:
            period: As for `render`.
            views: Training views. What spherical harmonics cannot hold, such as an opacity
                that depends on the direction, is to be right in these.

        Returns:
            In the training frame, in float32.
        """

    def render_gaussians(
        self, gaussians: GaussianCloud, view: View, *, plain: bool = False
    ) -> Prediction:
        """Render what `to_gaussians` gave.

        Args:
            gaussians: In the training frame.
            view: The camera.
            plain: Leave out the antialiasing filter of the training, as viewers without it do.
                Never true for methods whose options have no ``antialiased``.
        """

    def adapt_to_plain(self, gaussians: GaussianCloud, views: Sequence[View]) -> GaussianCloud:
        """Change Gaussians so that renderers without the antialiasing filter show about the same.

        Only where `to_gaussians` gives Gaussians that need the filter.

        Args:
            gaussians: What `to_gaussians` gave.
            views: Training views in which the result is to be right.
        """

    def device_memory(self, points: int, periods: int, pixels: int) -> tuple[int, dict[str, int]]:
        """Estimate the memory that a training takes on a GPU.

        Called before `setup`; only where a method can say it.

        Args:
            points: Number of sparse points.
            periods: Number of periods.
            pixels: Number of pixels of the largest photo.

        Returns:
            primitives: Number that the estimate is for: at which growth ends, or, without a limit,
                that of the sparse points.
            parts: Bytes by what takes them.
        """

    def permute(self, order: NDArray[np.int64]) -> None:
        """Put the anchors or Gaussians of a loaded model into another order. [N]

        Only where the model is a set of these, whose positions are one of the tensors `POSITIONS`;
        a method without it has no such function.
        """

    def save_training(self, folder: Path) -> None:
        """Write everything that the steps to come depend on into an existing empty folder.

        That is the model as the optimiser has it, moments, statistics for densification, generators
        of random numbers and places in schedules; no step may notice that it was asked for. Only
        where the spec says ``resumable``.

        Raises:
            OSError, DiskFullError: If the disk refuses.
        """

    def load_training(self, folder: Path) -> None:
        """Go on from what `save_training` wrote; `setup` or `extend` was called as before it.

        On a CPU the steps to come then give the same bits as without the interruption.
        """

    def extend(self, train: TrainingSet) -> None:
        """Go on from the model at the end of a training, with the views of the next period.

        Called instead of `setup` under the strategy ``sequential``; seed and device are those of
        `setup`, and steps and progress count from 0 again. Only where a method can; one that cannot
        has no such function.

        Args:
            train: Its views are of the new period alone, its periods are those so far.
        """


def make_method(spec: MethodSpec, config: MethodConfig) -> Method:
    """Make a method that has no model yet; imports its class."""
    method: Method = import_object(spec.method)(config)
    return method


def has_function(spec: MethodSpec, name: str) -> bool:
    """Return True if a method has this optional function of `Method`; another program has none."""
    return spec.runner is None and hasattr(import_object(spec.method), name)
