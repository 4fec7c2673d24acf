"""ChronoGS: Gaussians from anchors whose features know what stays and what a period changes."""

from __future__ import annotations

from chronogs.presets import PRESETS
from chronoscene.methods import MethodSpec

SPEC = MethodSpec(
    name="chronogs",
    title="ChronoGS",
    paper="ChronoGS: Disentangling Invariants and Changes in Multi-Period Scenes, CVPR 2026 "
    "(arXiv 2511.18794)",
    licence="Apache-2.0; the official code is for non-commercial use",
    period_input="continuous",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="chronogs.method:ChronoGS",
    config="chronogs.config:ChronoGSConfig",
    presets=PRESETS,
)
