"""GS-W, Gaussian in the Wild: colours that a network makes of what a reference photo shows."""

from __future__ import annotations

from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS, SEARCH
from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {  # for thousands of steps instead of tens of thousands
    "length_unit": "training",
    "stretch": True,
    "sh_dc_lr": 2.5e-3,
    "sh_rest_lr": 1.25e-3,
    "encoder": "small",
    "box_pixels": 0,
    "width": 64,
    "frequencies": 4,
    "start_from_points": True,
    "visibility": False,
    "coordinate_lr_initial": 0.01,
    "coordinate_lr_final": 1e-3,
    "network_lr": 2e-3,
}

SPEC = MethodSpec(
    name="gs-w",
    title="GS-W",
    paper="Zhang et al., Gaussian in the Wild: 3D Gaussian Splatting for Unconstrained Image "
    "Collections, ECCV 2024",
    licence="Apache-2.0 (written from the paper; the official code names no licence, and derives "
    "from that of 3DGS, which is for non-commercial use only)",
    period_input="label",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.gaussian_in_the_wild.method:GaussianInTheWild",
    config="baselines.gaussian_in_the_wild.config:GaussianInTheWildConfig",
    presets={
        "paper": {},
        "accurate": _SHORT | {"iterations": 8_000, "reference_size": 128},
        "balanced": _SHORT | {"iterations": 3_000, "reference_size": 128, "reset_interval": 8_000},
        "fast": _SHORT
        | {"iterations": 1_000, "reference_size": 64, "width": 32, "reset_interval": 30_000},
    },
    resumable=True,
    main_options=(*MAIN_OPTIONS, "reference", "encoder", "width", "visibility"),
    search={
        **SEARCH,
        "network_lr": Range(2e-4, 8e-3),
        "coordinate_lr_initial": Range(1e-3, 1.0),
        "reference": ("image", "period"),
    },
)
