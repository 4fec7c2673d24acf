"""Scaffold-GS: Gaussians decoded from anchors, without any notion of time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from chronoscene.anchors import MAIN_OPTIONS, MANY_ANCHORS, SEARCH
from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {
    "length_unit": "training",
    "voxel_size": 0.5,
    "voxel_unit": "spacing",
    "max_initial_anchors": 100_000,
    "max_anchors": 200_000,
}

_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "fast": _SHORT
    | {"iterations": 1_000, "density_interval": 40, "half_size_share": 0.5, "depth_weight": 0.1},
    "balanced": _SHORT | {"iterations": 3_000, "density_interval": 50},
    "accurate": _SHORT | {"iterations": 8_000, "density_interval": 50, **MANY_ANCHORS},
}

SPEC = MethodSpec(
    name="scaffold-gs",
    title="Scaffold-GS",
    paper="Scaffold-GS: Structured 3D Gaussians for View-Adaptive Rendering, CVPR 2024",
    licence="Apache-2.0; the official code is for non-commercial use",
    period_input="none",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.scaffold_gs.method:ScaffoldGS",
    config="baselines.scaffold_gs.config:ScaffoldGSConfig",
    presets=_PRESETS,
    resumable=True,
    main_options=(*MAIN_OPTIONS, "appearance_dim", "scale_weight", "exposure"),
    search={
        **SEARCH,
        "color_lr": Range(0.2, 5.0),
        "offsets_per_anchor": Range(3, 10, "int"),
        "covariance_lr": Range(0.2, 5.0),
    },
)

PERIOD_SPEC = replace(
    SPEC,
    name="scaffold-gs-period",
    title="Scaffold-GS, period appearance",
    period_input="continuous",
    method="baselines.scaffold_gs.method:ScaffoldGSPeriod",
    presets={name: {"appearance_dim": 32, **values} for name, values in _PRESETS.items()},
    search={
        **SEARCH,
        "color_lr": Range(0.2, 5.0),
        "offsets_per_anchor": Range(3, 10, "int"),
        "appearance_dim": Range(0, 64, "int"),
    },
)
"""The obvious baseline that knows of time: an appearance vector per period instead of per image."""
