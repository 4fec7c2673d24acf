"""Training of GS-W: each view in colours that are read from a photo."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from baselines.gaussian_in_the_wild.config import GaussianInTheWildConfig
from baselines.gaussian_in_the_wild.features import read_features, small_photo
from baselines.gaussian_in_the_wild.model import COORDINATES, EARLIER, WildModel
from baselines.gaussian_in_the_wild.networks import read_photo, see
from chronoscene.gaussians.trainer import Due, GaussianTrainer
from chronoscene.methods import StepReport, TrainingSet
from chronoscene.rasterizer import Rasterization
from chronoscene.scene.geometry import camera_centre
from chronoscene.training import devices
from chronoscene.training.checkpoint import TrainingState
from chronoscene.training.devices import to_device
from chronoscene.training.drawing import Splats
from chronoscene.training.losses import steady_mean

_STREAM = 8  # Keeps the dropout apart from other draws of the same seed
PAUSE = 300
"""Steps after an opacity reset in which visibility does not count. The image is nearly empty then,
and where nothing is visible the loss is smaller than where all is wrong: from there no training
comes back."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread, as its products and convolutions round by how they share their work.

    On a GPU, convolutions keep all digits of float32, which torch by default lets them round off.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            yield
    finally:
        torch.set_num_threads(before)


class WildTrainer(GaussianTrainer):
    """Trainer of GS-W: what a step reads from its photo is known from `splats` to `compare`."""

    config: GaussianInTheWildConfig
    model: WildModel
    _visible: Tensor | None = None
    """Visibility of the scene in the photo of this step; None for everywhere. [H, W]"""
    _last_reset: int = -PAUSE
    """Views drawn before the latest opacity reset."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._references = central_views(self.train)

    def step(self, index: int, progress: float) -> StepReport:
        self.model.period_features = None
        with one_thread():
            return super().step(index, progress)

    def splats(self, number: int) -> Splats:
        config = self.config
        view, self._visible = self.train.views[number], None
        rows = self.model.rows_in(view)
        dynamic, _, stages = self._read(self._reference(number), rows)
        if self._visibility_counts():
            self._visible = see(stages, self.model.shared, view.height, view.width)
        generator = np.random.default_rng((self.seed, _STREAM, self.sampler.drawn))
        kept = devices.uniform(generator, tuple(dynamic.shape), dynamic) >= config.dropout
        return self.model.painted(view, rows, dynamic * kept / (1 - config.dropout))

    def loss(self, raster: Rasterization, number: int, mask: Tensor | None) -> Tensor:
        free = self.model.parameters[COORDINATES][:, :-1]
        outside = steady_mean((free.abs() - 1).clamp_min(0.0))
        return super().loss(raster, number, mask) + self.config.coordinate_weight * outside

    def compare(self, image: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
        visible = self._visible
        if visible is None:
            return super().compare(image, photo, mask)
        mine, theirs = image * visible[..., None], photo / 255 * visible[..., None]
        if mask is not None:  # what it ignores must not show in the other order either
            theirs = torch.where(mask[..., None], theirs, mine.detach())
        loss = super().compare(mine, theirs.detach(), mask)
        # The loss has a gradient in its first argument only, and is the same with both exchanged.
        other = super().compare(theirs, mine.detach(), mask)
        hidden = steady_mean((1 - visible).square())
        return loss + (other - other.detach()) + self.config.visibility_weight * hidden

    def _visibility_counts(self) -> bool:
        config = self.config
        begun = self.timeline.last_moment > config.visibility_from
        paused = self.sampler.drawn - self._last_reset <= PAUSE
        return config.visibility and config.reference == "image" and begun and not paused

    def _update(self, due: Due) -> None:
        super()._update(due)
        if due.reset:
            self._last_reset = self.sampler.drawn

    def state(self) -> TrainingState:
        state = super().state()
        state.values["last_reset"] = self._last_reset
        return state

    def load_state(self, state: TrainingState) -> None:
        super().load_state(state)
        self._last_reset = state.values["last_reset"]
        self.model.period_features = None

    @torch.no_grad()
    def period_features(self) -> Tensor:
        """Features that Gaussians read from the training photos of each period, never from others.

        The mean over the photos of the period, for the projection map over those in which a
        Gaussian is inside; zero where there is none. [N, T, D]
        """
        model, views = self.model, self.train.views
        size, channels = model.networks.dynamic, model.networks.map_channels
        device = self.background.device
        rows = torch.arange(len(model), device=device)
        found = torch.zeros(len(model), self.train.num_periods, size, device=device)
        earlier = model.parameters.get(EARLIER, found[:, :0])
        found[:, : earlier.shape[1]] = earlier
        with one_thread():
            for period in range(self.train.num_periods):
                own = [i for i, view in enumerate(views) if view.period == period]
                if not own:
                    continue
                numbers = list(dict.fromkeys(self._reference(i) for i in own))
                total = torch.zeros(len(model), size, device=device)
                count = torch.zeros(len(model), 1, device=device)
                for i, number in enumerate(numbers):
                    self.train.expect(numbers[i:])
                    dynamic, inside, _ = self._read(number, rows)
                    total += dynamic
                    count += inside[:, None]
                total[:, :-channels] /= max(len(numbers), 1)
                total[:, -channels:] /= count.clamp_min(1)
                found[:, period] = total
        return found

    def _read(self, number: int, rows: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Features of some Gaussians from a training photo, as `read_features`, and the stages."""
        model, train = self.model, self.train
        p, device = model.parameters, self.background.device
        photo = small_photo(
            train.load_image(number), train.load_mask(number), self.config.reference_size
        )
        pixels = to_device(photo, device).movedim(-1, 0)[None].contiguous() / 127.5 - 1
        maps, stages = read_photo(pixels, model.shared, model.networks)
        dynamic, inside = read_features(
            maps,
            p["means"].index_select(0, rows),
            p[COORDINATES].index_select(0, rows),
            train.views[number],
            box_in_pixels=self.config.box_pixels > 0,
        )
        return dynamic, inside, stages

    def _reference(self, number: int) -> int:
        """The training view whose photo the colours of a training view are read from."""
        if self.config.reference != "period":
            return number
        return self._references[self.train.views[number].period]


def central_views(train: TrainingSet) -> dict[int, int]:
    """The view of each period whose camera is nearest to the mean of the period's cameras."""
    found = {}
    for period in {view.period for view in train.views}:
        numbers = [i for i, view in enumerate(train.views) if view.period == period]
        centres = np.stack([camera_centre(train.views[i].cam_from_world) for i in numbers])
        distances = np.linalg.norm(centres - centres.mean(0), axis=1)
        found[period] = numbers[int(distances.argmin())]
    return found
