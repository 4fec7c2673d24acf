"""Random LPIPS weights whose golden values are known, and an isolated search path for them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from chronoscene.metrics.lpips_weights import CONVOLUTIONS, ENVIRONMENT


@pytest.fixture(scope="session")
def random_lpips():
    """Backbone, heads and a pair of images, all from seed 0 in this order."""
    rng = np.random.default_rng(0)
    backbone = {}
    for index, channels_in, channels_out in (layer for part in CONVOLUTIONS for layer in part):
        weight = rng.standard_normal((channels_out, channels_in, 3, 3), dtype=np.float32)
        bias = rng.standard_normal(channels_out, dtype=np.float32)
        spread = np.float32(np.sqrt(2 / (9 * channels_in)))
        backbone[f"features.{index}.weight"] = torch.from_numpy(weight * spread)
        backbone[f"features.{index}.bias"] = torch.from_numpy(bias * np.float32(0.1))
    heads = {}
    for i, part in enumerate(CONVOLUTIONS):
        head = rng.random((1, part[-1][2], 1, 1), dtype=np.float32)
        heads[f"lin{i}.model.1.weight"] = torch.from_numpy(head)
    image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    noise = rng.integers(-40, 41, image.shape)
    return backbone, heads, image, np.clip(image.astype(int) + noise, 0, 255).astype(np.uint8)


@pytest.fixture
def no_weights(monkeypatch, tmp_path):
    """A machine without any weights: no variable, an empty hub cache, no lpips package."""
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch-home"))
    monkeypatch.setattr("chronoscene.metrics.lpips_weights.find_spec", lambda name: None)
    return tmp_path
