"""Scenes as explicit Gaussians, as in 3DGS: what methods build on that store every Gaussian.

In: a `TrainingSet` and a `GaussianConfig`. Out: a trained `GaussianModel`, and `GaussianMethod`,
the base class of the plug-ins. What a method adds to static Gaussians, such as a deformation field,
goes into `GaussianModel.at_period`.
"""

MAIN_OPTIONS = (
    "iterations",
    "max_gaussians",
    "gradient_threshold",
    "opacity_lr",
    "antialiased",
    "exposure",
)
"""Options shown first for each of these methods, followed by its own."""
