"""CL-Splats: finds what has changed since the last period, and optimises nothing else."""

from __future__ import annotations

from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS, SEARCH
from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {  # for thousands of steps instead of tens of thousands
    "length_unit": "training",
    "stretch": True,
    "sh_degree": 3,
    "opacity_lr": 0.05,
    "exposure": "period",
    "samples": 0,
    "sphere_share": 1.0,
}

SPEC = MethodSpec(
    name="cl-splats",
    title="CL-Splats-style",
    paper="Ackermann et al., CL-Splats: Continual Learning of Gaussian Splatting with Local "
    "Optimization, ICCV 2025",
    licence="Apache-2.0 (written from descriptions of the paper; the official code is under the "
    "MIT licence)",
    period_input="label",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.cl_splats.method:CLSplats",
    config="baselines.cl_splats.config:CLSplatsConfig",
    presets={
        "paper": {},
        "paper-released": {"iterations": 100},
        "accurate": _SHORT | {"iterations": 8_000, "reset_interval": 7_500},
        "balanced": _SHORT | {"iterations": 3_000, "reset_interval": 8_000},
        "fast": _SHORT
        | {
            "iterations": 1_000,
            "reset_interval": 30_000,
            "depth_weight": 0.1,
            "half_size_share": 0.5,
        },
    },
    strategy="sequential",
    per_period=("paper", "paper-released"),
    resumable=True,
    main_options=(*MAIN_OPTIONS, "change_threshold", "dilation", "vote_share", "samples"),
    search={
        **SEARCH,
        "sh_degree": Range(0, 3, "int"),
        "exposure": ("none", "period"),
        "samples": (0, 2_000),
    },
)
