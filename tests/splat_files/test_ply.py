"""The PLY file of 3DGS, number by number."""

import io

import numpy as np
from plyfile import PlyData

from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files.ply import encode


def test_every_number_is_in_its_column():
    rng = np.random.default_rng(0)
    means, scales = rng.normal(size=(5, 3)), rng.uniform(0.1, 2.0, (5, 3))
    quats, opacities = rng.normal(size=(5, 4)), np.array([0.0, 0.2, 0.5, 0.9, 1.0])
    sh_coeffs = rng.normal(size=(5, 16, 3))
    arrays = (means, quats, scales, opacities, sh_coeffs)
    data = encode(GaussianCloud(*(a.astype(np.float32) for a in arrays)))
    columns = PlyData.read(io.BytesIO(data))["vertex"]

    def read(*names):
        return np.stack([columns[name] for name in names], axis=1)

    np.testing.assert_allclose(read(*"xyz"), means, rtol=1e-6)
    np.testing.assert_allclose(np.exp(read(*(f"scale_{i}" for i in range(3)))), scales, rtol=1e-6)
    np.testing.assert_allclose(read(*(f"rot_{i}" for i in range(4))), quats, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-columns["opacity"])), opacities, atol=1e-6)
    for channel in range(3):
        names = (f"f_dc_{channel}", *(f"f_rest_{15 * channel + i}" for i in range(15)))
        np.testing.assert_allclose(read(*names), sh_coeffs[:, :, channel], rtol=1e-6)
