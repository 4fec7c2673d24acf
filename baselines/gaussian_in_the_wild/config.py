"""Options of GS-W."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from baselines.gaussian_in_the_wild.networks import ENCODERS
from chronoscene.checks import check_choice
from chronoscene.gaussians.config import GaussianConfig

REFERENCES = ("image", "period", "none")


@dataclass(frozen=True)
class GaussianInTheWildConfig(GaussianConfig):
    """Defaults are those of the released code.

    Colours come from a network and not from spherical harmonics: `sh_degree` and `sh_interval`
    have no effect, and `sh_dc_lr` and `sh_rest_lr` are those of the intrinsic features.
    """

    position_lr_final: float = 1.6e-7
    sh_dc_lr: float = 0.000125
    gradient_threshold: float = 0.0004

    # Reference photos
    reference: str = "image"
    """Photo that the colours of a training view are read from. ``image``: its own, as published;
    a view to render then has the mean of the features of its period's training photos. ``period``:
    one training photo for all views of a period, that of the camera nearest to the mean of
    their centres. ``none``: no photo, so that all periods look alike."""
    reference_size: int = 0
    """Photos are read at about this length of the longer side, in pixels: they are made smaller by
    a whole number. 0: as they are."""
    encoder: str = "resnet18"
    """``resnet18`` | ``small``: four convolutions of ResNet-18 per stage, or one in three stages;
    both start at random."""
    map_channels: int = 16
    """Channels of each of the three maps."""
    box_pixels: int = 1024
    """Side of the box by which projected positions are divided before the training. 0: it is the
    image, and its sides count in those of the image."""

    # Colour network
    width: int = 128
    """Units of the first layer; the others have 3/4, 1/2 and 3/8 as many."""
    frequencies: int = 10
    """Frequencies of the encoding of positions."""
    position_unit: float = 1.0
    """Positions are encoded as multiples of this length, in `length_unit`."""
    start_from_points: bool = False
    """True for a network whose output is added to the constant colour of each Gaussian, at first
    zero, so that the training starts with the colours of the sparse points."""
    dropout: float = 0.1
    """Share of the features read from photos that a step sets to zero, below 1."""

    # Visibility of what a photo shows
    visibility: bool = True
    """True to learn where a photo shows what does not belong to the scene, and to reduce the
    weight there. Only with ``reference=image``."""
    visibility_from: int = 2_500
    """Moment after which it counts."""
    visibility_weight: float = 0.15
    """Weight, in the loss, of the mean square of one minus the visibility."""

    coordinate_weight: float = 0.001
    """Weight, in the loss, of the distance of coordinates outside the maps."""

    # Learning rates
    cnn_lr_initial: float = 2e-3
    """Initial learning rate of the network that reads photos."""
    cnn_lr_final: float = 2e-4
    """Final learning rate of the network that reads photos, reached log-linearly."""
    coordinate_lr_initial: float = 1.0
    """Initial learning rate of the coordinates in the maps and of the boxes."""
    coordinate_lr_final: float = 0.01
    """Final learning rate of the coordinates and the boxes, reached log-linearly."""
    network_lr: float = 5e-4
    """Learning rate of the colour network."""

    minima: ClassVar[Mapping[str, int]] = {**GaussianConfig.minima, "map_channels": 1, "width": 8}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("reference", self.reference, REFERENCES)
        check_choice("encoder", self.encoder, ENCODERS)

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        return replace(config, position_unit=self.position_unit * training_from_world)
