"""Options of all methods that splat Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.methods import check_options
from chronoscene.rasterizer import NEAR_PLANE
from chronoscene.training.exposure import ExposureKind


@dataclass(frozen=True)
class SplattingConfig:
    """Options of all methods that splat Gaussians; a subclass has a field ``iterations``."""

    length_unit: str = "world"
    """Unit of the options that are lengths. ``world``: that of the scene, as in released code;
    ``training``: that of the training frame, in which the farthest camera is at distance 1, so
    that the unit of the scene does not matter. Where cameras stand close together before what they
    see, half of its depth is 1."""
    near_plane: PositiveFloat = NEAR_PLANE
    """Nearest depth that is drawn, in `length_unit`. The default is common to all methods here; the
    official rasterizer of 3DGS has 0.2."""
    antialiased: bool = False
    """Lower the opacity of Gaussians that are small on the screen, so that the rasterizer's blur
    adds no light to them: what is thin keeps its brightness at other image sizes than those
    trained on (Yu et al. 2024, Mip-Splatting)."""
    ssim_weight: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Weight of 1 - SSIM in the loss; L1 gets the rest."""
    depth_weight: NonNegativeFloat = 0.0
    """Weight, in the loss, of the mean relative deviation of the depth from that of the sparse
    points which the photo observes (Deng et al. 2022, DS-NeRF): surfaces are then where the points
    are. Without it, a model may show lawns, roads or roofs with little texture metres too low."""
    absgrad: bool = False
    """Add Gaussians where the sum over the pixels of a centre's absolute gradients is large, which
    does not cancel where a Gaussian is too large for what it shows (Ye et al. 2024, AbsGS). It is
    larger, and so must be the threshold: gsplat advises 0.0008 for 3DGS."""
    views_per_step: PositiveInt | Literal["auto"] = 1
    """Training views of one step, which moves the model by the sum of their gradients. Iterations
    count views, so equal iterations mean equally many photos seen. ``auto``: by the number of
    threads, see `chronoscene.kernels.runtime.views_for_threads`; the result then depends on it."""
    random_background: bool = False
    """Train with another colour behind everything in each step, so that no Gaussian is missing
    where a photo shows that colour. Images are rendered with the usual background."""
    opacity_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the Gaussians that a step leaves out at random; it grows from 0 to this over the
    training. The others are as much more opaque. Few photos are then learned less by heart (Park
    et al. 2025, DropGaussian, where it is 0.2)."""
    cooldown: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the training, its last, in which all learning rates of the model fall further, to a
    tenth of what they would be: the model settles. Not in the papers."""
    half_size_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the training, its first, in which photos of 400,000 pixels or more are drawn at half
    of their width and height: faster, and less is learned by heart."""
    exposure: ExposureKind = "none"
    """``image`` | ``period``: learn an affine transform of the colours for each training image, or
    for each period. A rendered view has that of its period: `chronoscene.training.exposure`."""

    def __post_init__(self) -> None:
        check_options(self)
        check_choice("length_unit", self.length_unit, ("world", "training"))
        if self.absgrad and self.depth_weight:
            raise ConfigError(
                "absgrad",
                expected="False with depth_weight",
                found="True",
                todo="set absgrad=false, or depth_weight=0",
            )
        for place, rate in self._falling_rates().items():
            if min(rate) < 0 or (0 in rate and any(rate)):
                raise ConfigError(
                    place,
                    expected="a learning rate above 0 at the start and at the end, or 0 at both",
                    found=f"{rate[0]:g} and {rate[1]:g}",
                    todo="correct the value, or switch the rate off at both ends",
                )

    def _falling_rates(self) -> dict[str, tuple[float, float]]:
        """Return learning rates at the start and at the end, by the names of their options."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        rates = {name: value for name, value in values.items() if name.endswith("_lr")}
        found = {name: rate for name, rate in rates.items() if isinstance(rate, tuple)}
        for start in values:
            if start.endswith("_lr_initial"):
                end = start.replace("_initial", "_final")
                found[f"{start}, {end}"] = values[start], values[end]
        return found

    def in_training_frame(self, training_from_world: float) -> Self:
        """Return the same options with all lengths in units of the training frame.

        Args:
            training_from_world: Scale of the training frame: its units per unit of the world.
        """
        if self.length_unit == "training":
            return self
        near_plane = self.near_plane * training_from_world
        return replace(self, length_unit="training", near_plane=near_plane)
