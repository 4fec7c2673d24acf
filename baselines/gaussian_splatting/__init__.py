"""3D Gaussian Splatting: one static scene, no period."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS, SEARCH
from chronoscene.methods import MethodSpec, Range

# The published schedule squeezed into thousands of steps; the set grows as far as it wants to.
_SHORT: dict[str, Any] = {"length_unit": "training", "stretch": True}

_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    # One reset of the opacities, halfway through the growth; none where it is 500 steps long.
    "accurate": _SHORT | {"iterations": 8_000, "reset_interval": 7_500},
    "balanced": _SHORT | {"iterations": 3_000, "reset_interval": 8_000},
    "fast": _SHORT | {"iterations": 1_000, "reset_interval": 30_000},
}

SPEC = MethodSpec(
    name="3dgs",
    title="3DGS",
    paper="Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023",
    licence="Apache-2.0 (written from the paper; the official code is for non-commercial use only)",
    period_input="none",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.gaussian_splatting.method:GaussianSplatting",
    config="chronoscene.gaussians.config:GaussianConfig",
    presets=_PRESETS,
    resumable=True,
    main_options=(
        *MAIN_OPTIONS,
        "sh_degree",
        "densification",
        "position_lr_initial",
        "ssim_weight",
    ),
    search={
        **SEARCH,
        "scale_lr": Range(1e-3, 0.02),
        "rotation_lr": Range(2e-4, 0.01),
        "initial_opacity": Range(0.05, 0.5),
    },
)

_PERIOD_PRESETS = {name: {"exposure": "period", **values} for name, values in _PRESETS.items()}
_PERIOD_PRESETS["balanced"]["depth_weight"] = 0.1

PERIOD_SPEC = replace(
    SPEC,
    name="3dgs-period",
    title="3DGS, period exposure",
    period_input="continuous",
    method="baselines.gaussian_splatting.method:GaussianSplattingPeriod",
    presets=_PERIOD_PRESETS,
)
"""The least that time can be to 3DGS: a transform of the colours of each period."""
