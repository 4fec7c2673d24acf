"""Scenes as explicit Gaussians, as in 3DGS: what methods build on that store every Gaussian.

In: a `TrainingSet` and a `GaussianConfig`. Out: a trained `GaussianModel`, and `GaussianMethod`,
the base class of the plug-ins. What a method adds to static Gaussians, such as a deformation field,
goes into `GaussianModel.at_period`.
"""

from collections.abc import Mapping

from chronoscene.methods import Range

MAIN_OPTIONS = (
    "iterations",
    "max_gaussians",
    "gradient_threshold",
    "opacity_lr",
    "antialiased",
    "exposure",
)
"""Options shown first for each of these methods, followed by its own."""

SEARCH: Mapping[str, tuple[bool, ...] | Range] = {
    "antialiased": (False, True),
    "position_lr_initial": Range(4e-5, 1.6e-3),
    "opacity_lr": Range(0.01, 0.2),
    "sh_dc_lr": Range(1e-4, 0.01),
    "ssim_weight": Range(0.0, 0.5, "linear"),
    "cooldown": Range(0.0, 0.4, "linear"),
    "gradient_threshold": Range(1e-4, 8e-4),
    "densify_interval": Range(40, 200, "int"),
}
"""Search space that all of these methods share; each has three options of its own besides."""
