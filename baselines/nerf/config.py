"""Options of NeRF and of what was made of it for photos of many days."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from chronoscene.fields.config import FieldConfig


@dataclass(frozen=True)
class NerfConfig(FieldConfig):
    """Options of the family; the flags `time`, `appearance` and `transient` make the methods."""

    opacity_weight: NonNegativeFloat = 0.0
    """Weight of the entropy -o log o of the rays' opacities o in the loss; with a `transient` it
    has no effect, and cannot be set."""
    time: Literal["none", "frequencies", "steps"] = "none"
    """Dependence of colours on the time t = period / (T - 1): not; by sines and cosines of it
    (NeRF-T); by learned step functions, so that content switches (NeuSC)."""
    appearance: Literal["none", "image", "encoder"] = "none"
    """Code of a photo's light: none; ``image``, a learned one for each photo; ``encoder``, what a
    network makes of the photo (Ha-NeRF)."""
    transient: Literal["none", "density", "mask"] = "none"
    """Treatment of what is only in one photo: none; a density and an uncertainty that are left out
    of renders (NeRF-W); a mask of the photo that weakens the loss (NeuSC, Ha-NeRF)."""
    activation: Literal["exp", "softplus"] = "exp"
    """From the output of the network to a density."""
    time_frequencies: PositiveInt = 4
    """Frequencies of the time."""
    time_steps: PositiveInt = 16
    """Step functions of the time."""
    appearance_size: PositiveInt = 48
    """Length of the code of a photo's light."""
    transient_size: PositiveInt = 16
    """Length of the code of what is only in one photo."""
    content_weight: NonNegativeFloat = 0.25
    """Weight of the error of the colours before the light is applied (NeuSC)."""
    mask_weight: NonNegativeFloat = 0.05
    """Weight of the squared mask."""
    least_uncertainty: PositiveFloat = 0.1
    """Added to the uncertainty of NeRF-W."""
    transient_weight: NonNegativeFloat = 0.01
    """Weight of the mean transient density."""

    def without_effect(self) -> dict[str, str]:
        """Return options that do nothing beside the others, and what they need."""
        light = "a code of the light (appearance)"
        options = {
            "opacity_weight": ("transient=none", self.transient == "none"),
            "time_frequencies": ("time=frequencies", self.time == "frequencies"),
            "time_steps": ("time=steps", self.time == "steps"),
            "content_weight": ("time=steps", self.time == "steps"),
            "appearance_size": (light, self.appearance != "none"),
            "mask_weight": ("transient=mask", self.transient == "mask"),
            "transient_size": ("transient=density", self.transient == "density"),
            "transient_weight": ("transient=density", self.transient == "density"),
            "least_uncertainty": ("transient=density", self.transient == "density"),
        }
        idle = {name: needed for name, (needed, there) in options.items() if not there}
        return super().without_effect() | idle


@dataclass(frozen=True)
class PlainConfig(NerfConfig):
    """Options of NeRF-T and NeRF-W-T."""

    time: Literal["none", "frequencies"] = "none"
    """Dependence of colours on the time t = period / (T - 1): not; by sines and cosines of it."""
    appearance: Literal["none", "image"] = "none"
    """Code of a photo's light: none, or a learned one for each photo."""


@dataclass(frozen=True)
class TimelessConfig(PlainConfig):
    """Options of NeRF and NeRF-W."""

    time: Literal["none"] = "none"
    """Colours do not depend on the time, which the method does not know."""


@dataclass(frozen=True)
class NeuSCConfig(NerfConfig):
    """Options of NeuSC."""

    appearance: Literal["none", "image"] = "none"
    """Code of a photo's light: none, or a learned one for each photo."""
    transient: Literal["none", "mask"] = "none"
    """Treatment of what is only in one photo: none; a mask of the photo that weakens the loss."""


@dataclass(frozen=True)
class HaNerfConfig(NerfConfig):
    """Options of Ha-NeRF."""

    time: Literal["none", "frequencies"] = "none"
    """Dependence of colours on the time t = period / (T - 1): not; by sines and cosines of it."""
    appearance: Literal["none", "encoder"] = "none"
    """Code of a photo's light: none, or what a network makes of the photo."""
    channels: PositiveInt = 16
    """Channels of the first convolution; the others have twice, and then four times as many."""
    photo_size: Annotated[int, Field(ge=16)] = 32
    """Width and height of photos for the encoder, in pixels."""
    photos: PositiveInt = 16
    """Photos that the rays of a step are drawn from."""
    encoder_rate: PositiveFloat = 5e-4
    """Learning rate of the encoder at the start."""
    code_weight: NonNegativeFloat = 1e-5
    """Weight of the mean square of the codes."""

    def without_effect(self) -> dict[str, str]:
        """Return options that do nothing beside the others, and what they need."""
        idle = super().without_effect()
        if self.appearance == "none":
            names = "channels", "photo_size", "encoder_rate", "code_weight"
            idle |= dict.fromkeys(names, "appearance=encoder")
        return idle
