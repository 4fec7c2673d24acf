"""CLNeRF: periods arrive one after the other, and renderings of the earlier ones are replayed."""

from __future__ import annotations

from typing import Any

from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {"log2_rows": 17, "samples": 65_536, "start": "warm"}

SPEC = MethodSpec(
    name="clnerf",
    title="CLNeRF",
    paper="Cai and Müller, CLNeRF: Continual Learning Meets NeRF, ICCV 2023",
    licence="Apache-2.0 (the official code, too)",
    period_input="continuous",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu",),
    method="baselines.continual_nerf.method:CLNeRF",
    config="baselines.continual_nerf.config:ContinualConfig",
    presets={
        "paper": {},
        "balanced": _SHORT | {"iterations": 3_000},
        "fast": _SHORT | {"iterations": 1_000, "samples": 32_768, "finest": 2_048},
    },
    per_period=("paper",),
    mixes_views=True,
    learns_background=True,
    resumable=True,
    main_options=(
        "iterations", "replay", "start", "buffer", "samples", "log2_rows", "finest", "cells",
        "learning_rate", "opacity_weight",
    ),
    search={
        "learning_rate": Range(1e-3, 3e-2),
        "log2_rows": Range(15, 19, "int"),
        "opacity_weight": Range(1e-4, 1e-2),
    },
)  # fmt: skip
