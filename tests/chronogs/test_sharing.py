"""Anchors that change and anchors that do not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from chronogs.method import ChronoGS
from chronogs.sharing import changing_anchors, pack_features, share_periods, unpack_features
from chronoscene.training import devices

Make = Callable[..., ChronoGS]


@pytest.mark.parametrize("compiled", [True, False])
def test_the_proximal_step_of_one_anchor(
    method: Make, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled:
        monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)
    model = method(2, base_dim=1, period_dim=2).model
    with torch.no_grad():
        model.features[0] = torch.tensor([9.0, 1.0, 5.0, 3.0, 1.0])
        model.features[1] = torch.tensor([9.0, 1.0, 1.1, 1.2, 0.9])
    # Means (2, 3) and (1.1, 1); deviations of norms sqrt(10) and 0.2.
    share_periods(model, np.sqrt(10.0) / 2)
    expected = [9.0, 1.5, 4.0, 2.5, 2.0]
    torch.testing.assert_close(model.features[0], torch.tensor(expected))
    torch.testing.assert_close(model.features[1], torch.tensor([9.0, 1.1, 1.0, 1.1, 1.0]))
    assert changing_anchors(model.features, model.layout)[:2].tolist() == [True, False]


@pytest.mark.parametrize("num_periods", [1, 2, 5])
@pytest.mark.parametrize("period_dim", [0, 3])
def test_packing_loses_nothing(method: Make, num_periods: int, period_dim: int) -> None:
    model = method(num_periods, period_dim=period_dim).model
    with torch.no_grad():
        blocks = model.features[:, 16:].view(len(model), num_periods, period_dim)
        blocks[::2] = blocks[::2, :1].clone()
    packed = pack_features(model.tensors(), model.layout)
    restored = unpack_features(packed, model.layout)
    assert set(restored) == set(model.tensors())
    assert torch.equal(restored["features"], model.features)
    changing = (len(model) // 2) * (num_periods > 1 and period_dim > 0)
    assert len(packed["changing_anchors"]) == len(packed["changing_features"]) == changing


def test_anchors_that_share_are_stored_once(
    method: Make, noise_set: Callable, tmp_path: Path
) -> None:
    stored = {}
    for weight in (0.0, 1e9):
        made = method(2, random_features=False, period_sharing=weight)
        for index in range(4):
            made.step(index, index / 4)
        folder = tmp_path / str(weight)
        folder.mkdir()
        made.save(folder)
        loaded = ChronoGS(made.config)
        loaded.load(folder, device="cpu")
        view = noise_set(2).views[0]
        np.testing.assert_array_equal(loaded.render(view, 1).rgb, made.render(view, 1).rgb)
        stored[weight] = made.size().parameters
    anchors = len(made.model)
    # Without the weight every anchor that was seen differs; with a huge one none does. A changing
    # anchor costs its second block and its index.
    assert stored[0.0] - stored[1e9] == anchors * (16 + 1)
    assert not changing_anchors(made.model.features, made.model.layout).any()
