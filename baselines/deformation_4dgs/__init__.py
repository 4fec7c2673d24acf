"""4D Gaussian Splatting: canonical Gaussians that a field deforms over time."""

from __future__ import annotations

from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS
from chronoscene.methods import MethodSpec

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
        "accurate": _SHORT | _MEDIUM | {"iterations": 8_000},
        "balanced": _SHORT | _MEDIUM | {"iterations": 3_000, "reset_interval": 8_000},
        "fast": _SHORT | _SMALL | {"iterations": 1_000, "reset_interval": 30_000},
    },
    resumable=True,
    main_options=(*MAIN_OPTIONS, "sh_degree", "coarse_until", "plane_size", "time_cells"),
)
