"""realtime4DGS: Gaussians in space and time, sliced at the time of an image."""

from __future__ import annotations

from typing import Any

from chronoscene.gaussians import MAIN_OPTIONS, SEARCH
from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {  # for thousands of steps instead of tens of thousands
    "length_unit": "training",
    "stretch": True,
    "start_times": "seen",
    "wave_cycle": 2.0,
    "time_lr": 5e-3,
    "wave_dc_lr": 0.0025,
}

SPEC = MethodSpec(
    name="realtime4dgs",
    title="realtime4DGS",
    paper="Yang et al., Real-time Photorealistic Dynamic Scene Representation and Rendering with "
    "4D Gaussian Splatting, ICLR 2024",
    licence="Apache-2.0 (written from the paper; the official code is under the MIT licence, its "
    "rasterizer for non-commercial use only)",
    period_input="continuous",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.realtime_4dgs.method:Realtime4DGS",
    config="baselines.realtime_4dgs.config:Realtime4DGSConfig",
    presets={
        "paper": {},
        "paper-scaled": {"length_unit": "training"},
        "accurate": _SHORT | {"iterations": 8_000, "reset_interval": 7_500},
        "balanced": _SHORT | {"iterations": 3_000, "reset_interval": 8_000},
        "fast": _SHORT | {"iterations": 1_000, "reset_interval": 30_000},
    },
    resumable=True,
    main_options=(*MAIN_OPTIONS, "sh_degree", "start_times", "initial_time_scale", "wave_cycle"),
    search={
        **SEARCH,
        "time_lr": Range(1.6e-4, 0.02),
        "wave_dc_lr": Range(1e-4, 0.01),
        "initial_time_scale": Range(0.2, 1.0),
    },
)
