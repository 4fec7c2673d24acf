"""Scenes as anchors whose features are decoded into Gaussians, as in Scaffold-GS and ChronoGS.

In: a `TrainingSet` and an `AnchorConfig`. Out: a trained `AnchorModel`, and `AnchorMethod`, the
base class of the plug-ins. `decode` holds the MLPs; what varies with the period, a method says.
"""

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
