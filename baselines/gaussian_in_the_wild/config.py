"""Options of GS-W."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class GaussianInTheWildConfig(GaussianConfig):
    """Defaults are those of the released code.

    Colours come from a network and not from spherical harmonics: `sh_degree` and `sh_interval`
    have no effect, and `sh_dc_lr` and `sh_rest_lr` are those of the intrinsic features.
    """

    position_lr_final: NonNegativeFloat = 1.6e-7
    sh_dc_lr: NonNegativeFloat = 0.000125
    gradient_threshold: NonNegativeFloat = 0.0004

    # Reference photos
    reference: Literal["image", "period"] = "image"
    """Photo that the colours of a training view are read from. ``image``: its own, as published;
    a view to render then has the mean of the features of its period's training photos. ``period``:
    one training photo for all views of a period, that of the camera nearest to the mean of
    their centres."""
    reference_size: NonNegativeInt = 0
    """Photos are read at about this length of the longer side, in pixels: they are made smaller by
    a whole number. 0: as they are."""
    encoder: Literal["resnet18", "small"] = "resnet18"
    """``resnet18`` | ``small``: four convolutions of ResNet-18 per stage, or one in three stages;
    both start at random."""
    map_channels: PositiveInt = 16
    """Channels of each of the three maps."""
    box_pixels: NonNegativeInt = 1024
    """Side of the box by which projected positions are divided before the training. 0: it is the
    image, and its sides count in those of the image."""

    # Colour network
    width: Annotated[int, Field(ge=8)] = 128
    """Units of the first layer; the others have 3/4, 1/2 and 3/8 as many."""
    frequencies: NonNegativeInt = 10
    """Frequencies of the encoding of positions."""
    position_unit: PositiveFloat = 1.0
    """Positions are encoded as multiples of this length, in `length_unit`."""
    start_from_points: bool = False
    """True for a network whose output is added to the constant colour of each Gaussian, at first
    zero, so that the training starts with the colours of the sparse points."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Share of the features read from photos that a step sets to zero."""

    # Visibility of what a photo shows
    visibility: bool = True
    """True to learn where a photo shows what does not belong to the scene, and to reduce the
    weight there. Only with ``reference=image``."""
    visibility_from: NonNegativeInt = 2_500
    """Moment after which it counts."""
    visibility_weight: NonNegativeFloat = 0.15
    """Weight, in the loss, of the mean square of one minus the visibility."""

    coordinate_weight: NonNegativeFloat = 0.001
    """Weight, in the loss, of the distance of coordinates outside the maps."""

    # Learning rates
    cnn_lr_initial: NonNegativeFloat = 2e-3
    """Initial learning rate of the network that reads photos."""
    cnn_lr_final: NonNegativeFloat = 2e-4
    """Final learning rate of the network that reads photos, reached log-linearly."""
    coordinate_lr_initial: NonNegativeFloat = 1.0
    """Initial learning rate of the coordinates in the maps and of the boxes."""
    coordinate_lr_final: NonNegativeFloat = 0.01
    """Final learning rate of the coordinates and the boxes, reached log-linearly."""
    network_lr: NonNegativeFloat = 5e-4
    """Learning rate of the colour network."""

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        return replace(config, position_unit=self.position_unit * training_from_world)
