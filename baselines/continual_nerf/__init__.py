"""CLNeRF, MEIL-NeRF and CL-NeRF: periods come one by one, and earlier ones are replayed."""

from __future__ import annotations

from typing import Any

from chronoscene.methods import MethodSpec, Range

_SHORT: dict[str, Any] = {"log2_rows": 17, "samples": 65_536, "start": "warm"}


def _presets(flags: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Presets of a method, by its flags."""
    return {
        "paper": flags | {"network_rate": 1e-2},
        "balanced": _SHORT | flags | {"iterations": 3_000},
        "fast": _SHORT | flags | {"iterations": 1_000, "samples": 32_768, "finest": 2_048},
    }


_COMMON: dict[str, Any] = {
    "period_input": "continuous",
    "outputs": ("rgb", "alpha", "depth"),
    "devices": ("cpu", "cuda"),
    "strategy": "sequential",
    "per_period": ("paper",),
    "mixes_views": True,
    "draws_gaussians": False,
    "learns_background": True,
    "resumable": True,
    "main_options": (
        "iterations", "replay", "start", "buffer", "samples", "log2_rows", "finest", "cells",
        "learning_rate", "opacity_weight",
    ),
    "search": {
        "learning_rate": Range(1e-3, 3e-2),
        "log2_rows": Range(15, 19, "int"),
        "opacity_weight": Range(1e-4, 1e-2),
    },
}  # fmt: skip

SPEC = MethodSpec(
    name="clnerf",
    title="CLNeRF",
    paper="Cai and Müller, CLNeRF: Continual Learning Meets NeRF, ICCV 2023",
    licence="Apache-2.0 (the official code, too)",
    config="baselines.continual_nerf.config:ContinualConfig",
    method="baselines.continual_nerf.method:CLNeRF",
    presets=_presets({}),
    **_COMMON,
)
MEIL_NERF = MethodSpec(
    name="meil-nerf",
    title="MEIL-NeRF",
    paper="Chung et al., MEIL-NeRF: Memory-Efficient Incremental Learning of Neural Radiance "
    "Fields, arXiv 2212.08328",
    licence="Apache-2.0 (so is its version in the repository of CLNeRF)",
    config="baselines.continual_nerf.config:ContinualConfig",
    method="baselines.continual_nerf.method:MEILNeRF",
    presets=_presets({"replay_loss": "charbonnier"}),
    **_COMMON,
)
CL_NERF = MethodSpec(
    name="cl-nerf",
    title="CL-NeRF",
    paper="Wu et al., CL-NeRF: Continual Learning of Neural Radiance Fields for Evolving Scene "
    "Representation, NeurIPS 2023",
    licence="Apache-2.0 (no official code was found)",
    config="baselines.continual_nerf.config:AdaptorConfig",
    method="baselines.continual_nerf.cl_nerf:CLNerf",
    presets=_presets({"start": "warm"}),
    **_COMMON,
)
