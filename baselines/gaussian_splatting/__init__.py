"""3D Gaussian Splatting: one static scene, no period."""

from chronoscene.methods import MethodSpec

SPEC = MethodSpec(
    name="3dgs",
    title="3DGS",
    paper="Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023",
    licence="Apache-2.0 (written from the paper; the official code is for non-commercial use only)",
    period_input="none",
    outputs=("rgb", "alpha", "depth"),
    devices=("cpu", "cuda"),
    method="baselines.gaussian_splatting.method:GaussianSplatting",
    config="baselines.gaussian_splatting.config:GaussianSplattingConfig",
    presets={
        "paper": {},
        "balanced": {
            "iterations": 2_500,
            "length_unit": "training",
            "stretch": True,
            "reset_interval": 7_500,
            "max_gaussians": 60_000,
        },
        "fast": {
            "iterations": 1_000,
            "length_unit": "training",
            "stretch": True,
            "reset_interval": 30_000,
            "max_gaussians": 40_000,
        },
    },
    resumable=True,
)
