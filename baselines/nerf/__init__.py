"""NeRF, NeRF-W, Ha-NeRF, their variants that know the time, and NeuSC: one class and its flags."""

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
    "devices": ("cpu", "cuda"),
    "config": "baselines.nerf.config:PlainConfig",
    "mixes_views": True,
    "draws_gaussians": False,
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
    **_COMMON | {"config": "baselines.nerf.config:TimelessConfig"},
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
    **_COMMON | {"config": "baselines.nerf.config:TimelessConfig"},
)
# Where the content changes with the time, the weight of the paper lets the transient head take all.
_W_T: dict[str, Any] = {
    "appearance": "image", "transient": "density", "time": "frequencies", "transient_weight": 3.0,
}  # fmt: skip
NERF_W_T = MethodSpec(
    name="nerf-w-t",
    title="NeRF-W-T",
    paper="Martin-Brualla et al., NeRF in the Wild, CVPR 2021, with the time as a further input",
    licence="Apache-2.0",
    period_input="continuous",
    method="baselines.nerf.method:NerfWT",
    presets=_presets(_W_T),
    **_COMMON,
)
_HA: dict[str, Any] = {"appearance": "encoder", "transient": "mask"}


def _ha_presets(flags: dict[str, Any]) -> dict[str, dict[str, Any]]:
    presets = _presets(_HA | flags)
    paper = {"frequencies": 15, "channels": 64, "photo_size": 128, "photos": 1}
    return presets | {"paper": presets["paper"] | paper}


HA_NERF = MethodSpec(
    name="ha-nerf",
    title="Ha-NeRF",
    paper="Chen et al., Hallucinated Neural Radiance Fields in the Wild, CVPR 2022",
    licence="Apache-2.0 (the official code names no licence)",
    period_input="label",
    method="baselines.nerf.ha_nerf:HaNerf",
    presets=_ha_presets({}),
    **_COMMON | {"config": "baselines.nerf.config:HaNerfConfig"},
)
HA_NERF_T = MethodSpec(
    name="ha-nerf-t",
    title="Ha-NeRF-T",
    paper="Chen et al., Ha-NeRF, CVPR 2022, with the time as a further input",
    licence="Apache-2.0",
    period_input="continuous",
    method="baselines.nerf.ha_nerf:HaNerfT",
    presets=_ha_presets({"time": "frequencies"}),
    **_COMMON | {"config": "baselines.nerf.config:HaNerfConfig"},
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
    **_COMMON | {"config": "baselines.nerf.config:NeuSCConfig"},
)
