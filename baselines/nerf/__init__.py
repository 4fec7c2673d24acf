"""NeRF, NeRF-T, NeRF-W and NeuSC: one class and its flags."""

from __future__ import annotations

from typing import Any

from chronoscene.methods import MethodSpec, Range
from chronoscene.methods.spec import PeriodInput

_PLAIN: dict[str, Any] = {  # the network of NeRF
    "encoding": "frequencies",
    "hidden": 256,
    "layers": 8,
    "features": 256,
    "activation": "softplus",
    "network_rate": 5e-4,
    "final_share": 0.1,
    "samples": 131_072,
    "iterations": 200_000,
}
_GRID: dict[str, Any] = {"opacity_weight": 1e-3}


def _spec(
    name: str, title: str, paper: str, licence: str, period_input: PeriodInput, flags: dict[str, Any],
    method: str,
) -> MethodSpec:  # fmt: skip
    return MethodSpec(
        name=name,
        title=title,
        paper=paper,
        licence=licence,
        period_input=period_input,
        outputs=("rgb", "alpha", "depth"),
        devices=("cpu", "cuda"),
        method=f"baselines.nerf.method:{method}",
        config="baselines.nerf.config:NerfConfig",
        presets={
            "paper": _PLAIN | flags,
            "balanced": _GRID | flags | {"iterations": 4_000},
            "fast": _GRID | flags | {"iterations": 1_000, "samples": 32_768, "finest": 2_048},
        },
        mixes_views=True,
        learns_background=True,
        resumable=True,
        main_options=("iterations", "samples", "encoding", "log2_rows", "finest", "learning_rate"),
        search={"learning_rate": Range(1e-3, 3e-2), "log2_rows": Range(15, 19, "int")},
    )


NERF = _spec(
    "nerf", "NeRF", "Mildenhall et al., NeRF: Representing Scenes as Neural Radiance Fields for View "
    "Synthesis, ECCV 2020", "Apache-2.0 (the official code is under the MIT licence)", "none", {},
    "Nerf",
)  # fmt: skip
NERF_T = _spec(
    "nerf-t", "NeRF-T", "Mildenhall et al., NeRF, ECCV 2020, with the time as a further input",
    "Apache-2.0", "continuous", {"time": "frequencies"}, "NerfT",
)  # fmt: skip
NERF_W = _spec(
    "nerf-w", "NeRF-W", "Martin-Brualla et al., NeRF in the Wild: Neural Radiance Fields for "
    "Unconstrained Photo Collections, CVPR 2021", "Apache-2.0 (no official code)", "none",
    {"appearance": "image", "transient": "density"}, "NerfW",
)  # fmt: skip
NEUSC = _spec(
    "neusc", "NeuSC", "Lin et al., Neural Scene Chronology, CVPR 2023",
    "Apache-2.0 (written from a description; the official code is non-commercial)", "continuous",
    {"time": "steps", "appearance": "image", "transient": "mask"}, "NeuSC",
)  # fmt: skip
