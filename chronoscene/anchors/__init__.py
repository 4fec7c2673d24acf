"""Scenes as anchors whose features are decoded into Gaussians, as in Scaffold-GS and ChronoGS.

In: a `TrainingSet` and an `AnchorConfig`. Out: a trained `AnchorModel`, and `AnchorMethod`, the
base class of the plug-ins. `decode` holds the MLPs; what varies with the period, a method says.
"""

from collections.abc import Mapping

from chronoscene.methods import Range

MAIN_OPTIONS = (
    "iterations",
    "max_anchors",
    "voxel_size",
    "offsets_per_anchor",
    "base_dim",
    "grad_threshold",
    "antialiased",
)
"""Options shown first for each of these methods, followed by its own."""

MANY_ANCHORS: Mapping[str, int] = {"max_initial_anchors": 300_000, "max_anchors": 600_000}
"""Limits of the presets ``accurate``; docs/experiments/dataset-scale.md has what they bring."""

SEARCH: Mapping[str, tuple[bool, ...] | Range] = {
    "antialiased": (False, True),
    "offset_lr": Range(0.2, 5.0),
    "opacity_lr": Range(0.2, 5.0),
    "feature_lr": Range(0.2, 5.0),
    "ssim_weight": Range(0.0, 0.5, "linear"),
    "cooldown": Range(0.0, 0.4, "linear"),
    "grad_threshold": Range(5e-5, 8e-4),
    "density_interval": Range(20, 100, "int"),
}
"""Search space that all of these methods share; each has three options of its own besides."""
