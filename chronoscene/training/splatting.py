"""What all methods that splat Gaussians have in common: the sparse points that they start from, how
they draw, and the plug-in's frame.

A subclass of `SplattingMethod` brings a model that gives `Splats` for a view and a period, and a
trainer that changes its tensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from chronoscene.checks import check_at_least, check_choice
from chronoscene.errors import CheckpointError, SceneError, ShapeError
from chronoscene.methods import MethodSize, Prediction, Skipped, StepReport, TrainingSet, View
from chronoscene.rasterizer import NEAR_PLANE, RasterInfo, Rasterization, rasterize
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.geometry import camera_centre
from chronoscene.training.adam import Adam, DenseTable, all_finite
from chronoscene.training.checkpoint import TRAINING, TrainingState, load_tensors, save_tensors
from chronoscene.training.devices import to_device
from chronoscene.training.exposure import KINDS, exposed, of_period, transformed
from chronoscene.training.row_adam import RowAdam
from chronoscene.training.spherical_harmonics import MAX_DEGREE, evaluate
from chronoscene.training.teachers import Lessons

_EXPOSURE = "exposure"  # Name of the stored transforms
_BACKGROUND_STREAM = 3  # Keeps the colours of `step_background` apart from other random choices


def finite_rows(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which points have finite coordinates. [P, 3] -> [P]

    Raises:
        SceneError: If there is none.
    """
    finite: NDArray[np.bool_] = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise SceneError(
            "sparse points",
            expected="at least one point with finite coordinates",
            found=f"{len(points)} points",
            todo="triangulate the scene: models start from its sparse points",
        )
    return finite


def rms_spacing(points: NDArray[np.floating], neighbours: int = 3) -> NDArray[np.float64]:
    """Root mean square distance of each point to its nearest others. [P, 3] -> [P]

    With fewer others than ``neighbours``, to those that there are; 0 for a lone point.
    """
    neighbours = min(neighbours, len(points) - 1)
    if neighbours < 1:
        return np.zeros(len(points))
    # The first neighbour is the point itself, or a twin at distance 0, which is the same.
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    return np.sqrt(np.square(distances[:, 1:]).mean(axis=1))


@dataclass(frozen=True)
class SplattingConfig:
    """Options of all methods that splat Gaussians."""

    length_unit: str = "world"
    """Unit of the options that are lengths. ``world``: that of the scene, as in released code;
    ``training``: that of the training frame, in which the farthest camera is at distance 1, so
    that the unit of the scene does not matter."""
    near_plane: float = NEAR_PLANE
    """Nearest depth that is drawn, in `length_unit`. The default is common to all methods here; the
    official rasterizer of 3DGS has 0.2."""
    antialiased: bool = False
    """Lower the opacity of Gaussians that are small on the screen, so that the rasterizer's blur
    adds no light to them: what is thin keeps its brightness at other image sizes than those
    trained on (Yu et al. 2024, Mip-Splatting)."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the loss; L1 gets the rest."""
    absgrad: bool = False
    """Add Gaussians where the sum over the pixels of a centre's absolute gradients is large, which
    does not cancel where a Gaussian is too large for what it shows (Ye et al. 2024, AbsGS). It is
    larger, and so must be the threshold: gsplat advises 0.0008 for 3DGS."""
    random_background: bool = False
    """Train with another colour behind everything in each step, so that no Gaussian is missing
    where a photo shows that colour. Images are rendered with the usual background."""
    exposure: str = "none"
    """``image`` | ``period``: learn an affine transform of the colours for each training image, or
    for each period. A rendered view has that of its period: `chronoscene.training.exposure`."""
    teachers: int = 0
    """How many models are trained first, in the first half of the training; the one that stays
    learns from the photos and from what these show, on average, between the photos. Worth it in
    long trainings: `chronoscene.training.teachers`. Not in any of the papers."""

    def __post_init__(self) -> None:
        check_at_least("teachers", self.teachers, 0)
        check_choice("exposure", self.exposure, KINDS)
        check_choice("length_unit", self.length_unit, ("world", "training"))
        check_at_least("near_plane", self.near_plane, 0.0)

    def in_training_frame(self, training_from_world: float) -> Self:
        """The same options with all lengths in units of the training frame.

        Args:
            training_from_world: Scale of the training frame: its units per unit of the world.
        """
        if self.length_unit == "training":
            return self
        near_plane = self.near_plane * training_from_world
        return replace(self, length_unit="training", near_plane=near_plane)


class Splats(NamedTuple):
    """Gaussians as the rasterizer draws them, in the training frame."""

    means: Tensor
    """Centres. [N, 3]"""
    quats: Tensor
    """Rotations wxyz. [N, 4]"""
    scales: Tensor
    """Standard deviations. [N, 3]"""
    opacities: Tensor
    """A Gaussian with an opacity of 0 or less is not drawn. [N]"""
    colors: Tensor
    """RGB. [N, 3]"""


def draw(
    splats: Splats,
    view: View,
    background: Tensor,
    *,
    near_plane: float,
    antialiased: bool = False,
    render_depth: bool = False,
    absgrad: bool = False,
    check_finite: bool = True,
) -> Rasterization:
    """Rasterize Gaussians in one view; arguments as `chronoscene.rasterizer.rasterize`."""
    return rasterize(
        *splats,
        *camera_tensors(view, splats.means.device),
        view.width,
        view.height,
        near_plane=near_plane,
        antialiased=antialiased,
        backgrounds=background[None],
        render_depth=render_depth,
        absgrad=absgrad,
        check_finite=check_finite,
    )


def centre_gradients(info: RasterInfo) -> Tensor:
    """Of the projected centres after ``backward``, in pixels; absolute ones if they were asked for.
    [N, 2]"""
    assert info.means2d.grad is not None
    found: Tensor = getattr(info.means2d, "absgrad", info.means2d.grad)[0]
    return found


def weights_in(
    splats: Splats, view: View, pixels: Tensor, *, near_plane: float, antialiased: bool = False
) -> Tensor:
    """What Gaussians add to a view: sums over the pixels of their weight times ``pixels``. [N, 3]

    The weight is transmittance times falloff times opacity, what a colour is multiplied by.

    Args:
        splats: The Gaussians; their colours do not matter. [N]
        view: The camera.
        pixels: Three numbers for each pixel, such as 1 in a region and 0 elsewhere. [H, W, 3]
        near_plane: As for `draw`.
        antialiased: The same.
    """
    with torch.enable_grad():
        colors = torch.zeros_like(splats.means).requires_grad_()
        raster = draw(
            splats._replace(colors=colors),
            view,
            torch.zeros(3, device=colors.device),
            near_plane=near_plane,
            antialiased=antialiased,
        )
        (gradient,) = torch.autograd.grad((raster.image[0] * pixels).sum(), colors)
    return gradient


def step_background(
    background: Tensor, config: SplattingConfig, *, seed: int, number: int
) -> Tensor:
    """What is behind everything in one step of a training. [3] -> [3]

    Args:
        background: The usual colour.
        config: Says whether it is that, or a random one.
        seed: Of the run; with the number of the step, all that the colour depends on.
        number: Of the step.
    """
    if not config.random_background:
        return background
    generator = np.random.default_rng((seed, _BACKGROUND_STREAM, number))
    return to_device(generator.random(3, np.float32), background.device)


def collect_gradients(
    loss: Tensor,
    info: RasterInfo,
    optimizers: Iterable[Adam | DenseTable | RowAdam],
    mask: Tensor | None = None,
) -> tuple[float, Skipped | None]:
    """The backward pass of a training step. What it returns is all that the host waits for.

    Args:
        loss: What to minimise.
        info: Of the rasterization.
        optimizers: Those that step after it.
        mask: Where the photo counts; None for everywhere. bool [H, W]

    Returns:
        loss: The same as a number.
        skipped: Why the step must be skipped, if it must: the optimisers may not use what they have
            then.
    """
    sees = (info.radii > 0).any()
    if mask is not None:
        sees = sees & mask.any()
    loss.backward()
    loss = loss.detach()
    gradients = [gradient for optimizer in optimizers for gradient in optimizer.gradients()]
    finite = all_finite([loss, *gradients])
    value, seen, sound = torch.stack([loss, sees.to(loss), finite.to(loss)]).tolist()
    if not seen:
        return value, "empty"
    return value, None if sound else "not finite"


def centres_count(means2d: Tensor, mask: Tensor) -> Tensor:
    """Whether projected centres lie where a photo counts, or outside of it. [N, 2] -> [N]

    Args:
        means2d: Places in pixels; pixel (0, 0) is centred at (0.5, 0.5).
        mask: Where the photo counts. bool [H, W]
    """
    (x, y), (height, width) = means2d.unbind(-1), mask.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = (torch.where(inside, place, 0.0).long() for place in (x, y))
    return mask[y, x] | ~inside


def mask_tensor(train: TrainingSet, index: int, device: str | torch.device) -> Tensor | None:
    """Where the photo of a training view counts; None for everywhere. bool [H, W]"""
    mask = train.load_mask(index)
    return None if mask is None else to_device(mask.copy(), device)


def prediction_of(raster: Rasterization, exposure: Tensor | None = None) -> Prediction:
    """What a method hands to the harness, from a call with one view and with depth.

    Args:
        raster: The view.
        exposure: Transform of its colours. [3, 4]
    """
    assert raster.depths is not None
    image = raster.image[0] if exposure is None else transformed(raster.image[0], exposure)
    images = (image, raster.alphas[0, ..., 0], raster.depths[0, ..., 0])
    rgb, alpha, depth = (image.detach().cpu().numpy() for image in images)
    drawn = int((raster.info.radii[0] > 0).all(dim=-1).sum())
    return Prediction(rgb=rgb.clip(0.0, 1.0), alpha=alpha, depth=depth, drawn=drawn)


def camera_tensors(view: View, device: str | torch.device = "cpu") -> tuple[Tensor, Tensor]:
    """World-to-camera transform and intrinsics of one view, as a batch of one.

    Returns:
        viewmats: Pose in the training frame. float32 [1, 4, 4]
        Ks: Intrinsics in pixels. float32 [1, 3, 3]
    """
    viewmats = np.array(view.cam_from_world, dtype=np.float32)[None]
    Ks = np.array(view.K, dtype=np.float32)[None]
    return to_device(viewmats, device), to_device(Ks, device)


def camera_centre_tensor(view: View, device: str | torch.device = "cpu") -> Tensor:
    """Camera centre in the training frame, computed in float64. float32 [3]"""
    centre = camera_centre(np.asarray(view.cam_from_world, dtype=np.float64))
    return to_device(centre.astype(np.float32), device)


def with_new_periods(rows: Tensor, count: int) -> Tensor:
    """A row for each period: new ones start as copies of the last. [S, ...] -> [count, ...]"""
    return rows.detach()[[min(period, len(rows) - 1) for period in range(count)]]


class SplattingMethod(ABC):
    """Fulfils `chronoscene.methods.Method`; a subclass says how a model starts and is drawn.

    `AnchorMethod` and `GaussianMethod` are the two kinds of models that there are.

    Args:
        config: Options of the method, a frozen dataclass on `SplattingConfig`. From `setup` on,
            `config` holds them with lengths in units of the training frame.
    """

    name: ClassVar[str]
    """On the command line."""
    version: ClassVar[str] = "1"
    """Of the implementation; stored with every model."""
    primitive: ClassVar[str]
    """Name of a stored tensor with one row per primitive."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.background = torch.zeros(3)
        self.meta: dict[str, Any] = {}
        """Content of ``model.json``; subclasses add what `restore` needs."""
        self.trainer: Any = None
        """What `start` gave, which has an `Exposure` as ``exposure``; None after `load`."""
        self._exposure: Tensor | None = None
        self._lessons: Lessons | None = None

    @abstractmethod
    def start(self, train: TrainingSet, *, seed: int, device: str) -> Any:
        """Build the initial model; returns what trains it by ``step``, arguments as there.

        Where the method can be resumed, it gives a `TrainingState` by ``state`` and takes one by
        ``load_state``.
        """

    @abstractmethod
    def draw_splats(self, splats: Splats, view: View) -> Rasterization:
        """Render Gaussians by the rules of the model, with depth."""

    @abstractmethod
    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        """What is drawn in a view: the geometry of one period in the colours of another."""

    @abstractmethod
    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """`to_gaussians` without the exposure."""

    @abstractmethod
    def stored_tensors(self) -> dict[str, Tensor]:
        """The model as it goes to disk, by name."""

    @abstractmethod
    def restore(self, folder: Path, tensors: dict[str, Tensor], device: str) -> None:
        """Rebuild the model from `stored_tensors` and `meta`."""

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self.config = self.config.in_training_frame(train.training_from_world.scale)
        background = np.array(train.background, np.float32)
        self.background = torch.from_numpy(background).to(device)
        self.meta = {
            "method": self.name,
            "version": self.version,
            "config": asdict(self.config),
            "training_from_world": train.training_from_world.to_matrix().tolist(),
            "num_periods": train.num_periods,
            "background": background.tolist(),
        }
        if self.config.teachers:
            self._lessons = Lessons(self.config.teachers, seed, train, device)
            self._begin_lesson(self._lessons)
        else:
            self.trainer = self.start(train, seed=seed, device=device)

    def _begin_lesson(self, lessons: Lessons) -> None:
        """Begin the next model: a teacher, or the one that stays."""
        train = lessons.training_set(lambda: type(self)(self.config))
        self.trainer = self.start(train, seed=lessons.own_seed(), device=lessons.device)

    def go_on(self, train: TrainingSet, trainer: Any) -> None:
        """Put another trainer in place of the one before: the last part of `extend`.

        Exposures go on, too; a new period starts with that of the last one.
        """
        exposure = self.exposure()
        self.meta["num_periods"] = train.num_periods
        self.trainer = trainer
        if exposure is not None:
            trainer.exposure.begin(with_new_periods(exposure, train.num_periods))

    def step(self, index: int, progress: float) -> StepReport:
        assert self.trainer is not None, "setup comes first"
        if (lessons := self._lessons) is not None:
            while lessons.is_over(progress):
                lessons.end(self, index)
                self._begin_lesson(lessons)
            index, progress = lessons.own_time(index, progress)
        return self.trainer.step(index, progress)

    def render(self, view: View, period: float) -> Prediction:
        return self.render_split(view, geometry_period=period, appearance_period=period)

    @torch.no_grad()
    def render_split(
        self, view: View, *, geometry_period: float, appearance_period: float
    ) -> Prediction:
        """Opacities and shapes come from the first period, colours from the second."""
        transforms = self.exposure()
        exposure = None if transforms is None else of_period(transforms, appearance_period)
        splats = self.splats(view, geometry_period, appearance_period)
        return prediction_of(self.draw_splats(splats, view), exposure)

    @torch.no_grad()
    def to_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        gaussians, transforms = self.static_gaussians(period, views), self.exposure()
        if transforms is None:
            return gaussians
        exposure = of_period(transforms, period).cpu().numpy()
        return replace(gaussians, sh_coeffs=exposed(gaussians.sh_coeffs, exposure))

    @torch.no_grad()
    def render_gaussians(self, gaussians: GaussianCloud, view: View) -> Prediction:
        device = self.background.device
        arrays = (getattr(gaussians, field.name) for field in fields(gaussians))
        means, quats, scales, opacities, sh = (torch.from_numpy(a).to(device) for a in arrays)
        centre = camera_centre_tensor(view, device)
        colors = evaluate(sh[:, 0], sh[:, 1:], means, centre, MAX_DEGREE)
        splats = Splats(means, quats, scales, opacities, colors)
        return prediction_of(self.draw_splats(splats, view))

    def exposure(self) -> Tensor | None:
        """The transform of colours of each period, if the training learns any. [T, 3, 4]"""
        if self.trainer is None:
            return self._exposure
        transforms: Tensor | None = self.trainer.exposure.by_period()
        return transforms

    def _all_tensors(self) -> dict[str, Tensor]:
        """All that is stored, by name."""
        exposure = self.exposure()
        return self.stored_tensors() | ({} if exposure is None else {_EXPOSURE: exposure})

    def save(self, folder: Path) -> None:
        """Write the model; the state of the optimiser is not stored."""
        save_tensors(folder, self._all_tensors(), self.meta)

    def load(self, folder: Path, *, device: str) -> None:
        """Read a model; what is stored with it takes precedence over the options given here."""
        tensors, self.meta = load_tensors(folder, device=device, method=self.name)
        self.background = torch.tensor(self.meta["background"], dtype=torch.float32, device=device)
        self._exposure = tensors.pop(_EXPOSURE, None)
        self.restore(folder, tensors, device)
        self.trainer = None

    def save_training(self, folder: Path) -> None:
        state = self.trainer.state()
        meta = {"method": self.name, "version": self.version, "values": state.values}
        if self._lessons is not None:
            meta["lessons"] = self._lessons.write(folder)
        save_tensors(folder, state.tensors, meta, stem=TRAINING)

    def load_training(self, folder: Path) -> None:
        tensors, meta = load_tensors(folder, method=self.name, stem=TRAINING)
        try:
            if self._lessons is not None:
                self._lessons.read(folder, meta["lessons"])
                self._begin_lesson(self._lessons)
            self.trainer.load_state(TrainingState(tensors, meta["values"]))
        except (KeyError, RuntimeError, ShapeError) as error:
            raise CheckpointError(
                folder,
                expected=f"a training that {self.name} {self.version} can go on with",
                found=f"{type(error).__name__}: {error}",
                todo="go on with the version of the software, and on the device, that began it",
            ) from error

    def size(self) -> MethodSize:
        """Number of primitives, and of all stored numbers."""
        tensors = self._all_tensors()
        count, parameters = len(tensors[self.primitive]), sum(t.numel() for t in tensors.values())
        unit = "anchors" if self.primitive == "anchors" else "Gaussians"
        return MethodSize(count, parameters, unit)
