"""NeRF, NeRF-T, NeRF-W and NeuSC: one class and its flags."""

from __future__ import annotations

from typing import Any

from chronoscene.methods import MethodSpec, Range

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


def _presets(flags: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Presets of a method, by its flags."""
    return {
        "paper": _PLAIN | flags,
        "balanced": _GRID | flags | {"iterations": 3_000},
        "fast": _GRID | flags | {"iterations": 1_000, "samples": 32_768, "finest": 2_048},
    }


_COMMON: dict[str, Any] = {
    "outputs": ("rgb", "alpha", "depth"),
    "devices": ("cpu",),
    "config": "baselines.nerf.config:NerfConfig",
    "mixes_views": True,
    "learns_background": True,
    "resumable": True,
    "main_options": (
        "iterations", "samples", "encoding", "log2_rows", "finest", "cells", "shells",
        "learning_rate", "network_rate", "opacity_weight",
    ),
    "search": {"learning_rate": Range(1e-3, 3e-2), "log2_rows": Range(15, 19, "int")},
}  # fmt: skip

NERF = MethodSpec(
    name="nerf",
    title="NeRF",
    paper="Mildenhall et al., NeRF: Representing Scenes as Neural Radiance Fields for View "
    "Synthesis, ECCV 2020",
    licence="Apache-2.0 (the official code is under the MIT licence)",
    period_input="none",
    method="baselines.nerf.method:Nerf",
    presets=_presets({}),
    **_COMMON,
)
NERF_T = MethodSpec(
    name="nerf-t",
    title="NeRF-T",
    paper="Mildenhall et al., NeRF, ECCV 2020, with the time as a further input",
    licence="Apache-2.0",
    period_input="continuous",
    method="baselines.nerf.method:NerfT",
    presets=_presets({"time": "frequencies"}),
    **_COMMON,
)
NERF_W = MethodSpec(
    name="nerf-w",
    title="NeRF-W",
    paper="Martin-Brualla et al., NeRF in the Wild: Neural Radiance Fields for Unconstrained Photo "
    "Collections, CVPR 2021",
    licence="Apache-2.0 (no official code was released)",
    period_input="none",
    method="baselines.nerf.method:NerfW",
    presets=_presets({"appearance": "image", "transient": "density"}),
    **_COMMON,
)
NEUSC = MethodSpec(
    name="neusc",
    title="NeuSC",
    paper="Lin et al., Neural Scene Chronology, CVPR 2023",
    licence="Apache-2.0 (written from descriptions of the paper; the official code is "
    "non-commercial)",
    period_input="continuous",
    method="baselines.nerf.method:NeuSC",
    presets=_presets({"time": "steps", "appearance": "image", "transient": "mask"}),
    **_COMMON,
)
