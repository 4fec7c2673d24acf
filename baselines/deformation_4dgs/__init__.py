"""4D Gaussian Splatting: canonical Gaussians that a field deforms over time."""

from __future__ import annotations

from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS, SEARCH
from chronoscene.methods import MethodSpec, Range

_SCALED: dict[str, Any] = {"length_unit": "training"}
"""The rates of the released code grow with the extent of the cameras: in metres they may diverge,
in the training frame they cannot depend on the unit."""

_DEFAULTS: dict[str, Any] = {  # of the released command line, without a file of arguments
    "iterations": 33_000,
    "densify_until": 15_000,
    "channels": 32,
    "levels": 4,
    "time_cells": 25,
    "width": 64,
    "deform_opacity": False,
    "deform_color": False,
    "space_smoothness": 1e-4,
    "time_smoothness": 0.01,
}

_SHORT: dict[str, Any] = {  # for thousands of steps instead of tens of thousands
    "length_unit": "training",
    "stretch": True,
    "coarse_until": 1_000,
    "grow_below": 0,
    "prune_above": 0,
    "white_background": False,
    "time_cells": 0,
    "box_quantile": 0.01,
    "half_time_axis": False,
    "zero_start": True,
    "ssim_weight": 0.2,
    "field_lr_initial": 5e-3,
    "field_lr_final": 5e-4,
    "plane_lr_initial": 3e-2,
    "plane_lr_final": 3e-3,
    "time_smoothness": 2e-5,
    "time_sparsity": 2e-6,
}

_SMALL: dict[str, Any] = {"channels": 8, "plane_size": 16, "width": 32}
_MEDIUM: dict[str, Any] = {"channels": 16, "plane_size": 32, "width": 64}

_TUNED_BALANCED: dict[str, Any] = {  # docs/experiments/tuning.md
    "position_lr_initial": 1.471e-3,
    "sh_dc_lr": 3.809e-4,
    "opacity_lr": 0.01368,
    "field_lr_initial": 5.018e-3,
    "plane_lr_initial": 0.01926,
    "time_smoothness": 1.199e-5,
    "ssim_weight": 0.3452,
    "cooldown": 0.2828,
    "gradient_threshold": 3.116e-4,
    "densify_interval": 186,
}

SPEC = MethodSpec(
    name="4dgs",
    title="4DGS",
    paper="Wu et al., 4D Gaussian Splatting for Real-Time Dynamic Scene Rendering, CVPR 2024",
    licence="Apache-2.0 (written from the paper; the official code is for non-commercial use only)",
    period_input="continuous",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.deformation_4dgs.method:Deformation4DGS",
    config="baselines.deformation_4dgs.config:Deformation4DGSConfig",
    presets={
        "paper": {},
        "paper-scaled": _SCALED,
        "paper-defaults": _SCALED | _DEFAULTS,
        "accurate": _SHORT | _MEDIUM | {"iterations": 8_000},
        "balanced": (
            _SHORT | _MEDIUM | {"iterations": 3_000, "reset_interval": 8_000} | _TUNED_BALANCED
        ),
        "fast": _SHORT | _SMALL | {"iterations": 1_000, "reset_interval": 30_000},
    },
    titles={
        "paper": "4DGS, official multi-view options",
        "paper-scaled": "4DGS, official multi-view options, scaled",
        "paper-defaults": "4DGS, official defaults, scaled",
        **dict.fromkeys(("accurate", "balanced", "fast"), "4DGS, tuned"),
    },
    resumable=True,
    main_options=(*MAIN_OPTIONS, "sh_degree", "coarse_until", "plane_size", "time_cells"),
    search={
        **SEARCH,
        "field_lr_initial": Range(1.6e-4, 0.02),
        "plane_lr_initial": Range(1.6e-3, 0.1),
        "time_smoothness": Range(2e-6, 0.01),
    },
)
