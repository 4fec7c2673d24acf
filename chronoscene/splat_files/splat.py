"""SPLAT, the file of antimatter15's viewer: 32 bytes per Gaussian, without spherical harmonics.

Centre and scales in float32; colour and opacity, then the rotation wxyz, in 8 bits each. The colour
is what the constant coefficients give. Viewers expect large, opaque Gaussians first, as they show a
file while it loads.

Source: github.com/antimatter15/splat.
"""

from __future__ import annotations

import numpy as np

from chronoscene.scene.gaussian_cloud import GaussianCloud

C0 = 0.5 / np.sqrt(np.pi)
"""The constant spherical harmonic."""

RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", np.uint8, 4), ("quat", np.uint8, 4)]
)


def encode(cloud: GaussianCloud) -> bytes:
    """Make a file; colours outside of 0..1 become 0 or 1."""
    lengths = np.linalg.norm(cloud.quats, axis=1, keepdims=True)
    rgba = np.column_stack([cloud.sh_coeffs[:, 0] * C0 + 0.5, cloud.opacities])
    records = np.empty(len(cloud), RECORD)
    records["mean"], records["scale"] = cloud.means, cloud.scales
    records["rgba"] = np.rint(rgba * 255).clip(0, 255)
    records["quat"] = np.rint(cloud.quats / lengths * 128 + 128).clip(0, 255)
    size = cloud.scales.astype(np.float64).prod(axis=1) * cloud.opacities
    return records[np.argsort(-size, kind="stable")].tobytes()


def decode(data: bytes) -> GaussianCloud:
    """Read what `encode` made."""
    records = np.frombuffer(data, RECORD)
    rgba = records["rgba"].astype(np.float32) / np.float32(255)
    sh_coeffs = np.zeros((len(records), 16, 3), np.float32)
    sh_coeffs[:, 0] = (rgba[:, :3] - 0.5) / C0
    return GaussianCloud(
        means=records["mean"],
        quats=(records["quat"].astype(np.float32) - np.float32(128)) / np.float32(128),
        scales=records["scale"],
        opacities=rgba[:, 3],
        sh_coeffs=sh_coeffs,
    )
