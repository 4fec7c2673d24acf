"""The estimate of the memory of a GPU against tensors on a CPU."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train import painted_balls
from chronoscene.methods import build_config, import_object, load_spec
from chronoscene.training.device_memory import FLOAT, PROJECTED, SPLAT, STATE, device_memory
from chronoscene.training.drawing import draw


def size(*tensors: Tensor) -> int:
    return sum(tensor.nbytes for tensor in tensors)


@pytest.mark.parametrize("name", ["chronogs", "scaffold-gs", "3dgs", "realtime4dgs"])
def test_model_and_moments_are_those_of_a_training(name: str) -> None:
    spec = load_spec(name)
    data = painted_balls.make_training_set(tiny_training.periods_for(spec))
    method = import_object(spec.method)(build_config(spec, preset="fast"))
    method.setup(data, seed=0, device="cpu")
    method.step(0, 0.0)
    limit, parts = method.device_memory(len(data.points), data.num_periods, 100)
    model, optimizer, count = method.model, method.trainer.optimizer, method.size().primitives
    if name in ("3dgs", "realtime4dgs"):
        rows, state = model.parameters, optimizer.state()
    else:
        rows = {n: getattr(model, n) for n in ("offsets", "features", "blocks", "log_scales")}
        state = {n: t for n, t in optimizer.state().items() if n.startswith("table.")}
    moments = [t for n, t in state.items() if n.endswith((".mean", ".square"))]
    assert parts["model"] * count == size(*rows.values()) * limit
    # The gradients of all rows are as large as the rows.
    assert STATE * size(*rows.values()) == size(*moments) + size(*rows.values())
    assert parts["gradients and moments"] * count == STATE * size(*rows.values()) * limit
    assert parts["images"] == 25_000


def test_the_limit_of_growth_counts_or_the_sparse_points() -> None:
    spec = load_spec("3dgs")
    for limit, expected in ((0, 70), (500, 500)):
        config = build_config(spec, preset="paper", overrides={"max_gaussians": limit})
        count, parts = import_object(spec.method)(config).device_memory(70, 1, 10)
        assert count == expected and parts["model"] == 59 * FLOAT * expected


def test_what_is_drawn_is_as_large_as_the_rasterizer_takes_it() -> None:
    data = painted_balls.make_training_set(1)
    method = import_object(load_spec("3dgs").method)(build_config(load_spec("3dgs"), preset="fast"))
    method.setup(data, seed=0, device="cpu")
    splats = method.model.splats(data.views[0], 0)
    count = len(splats.means)
    assert size(*splats) == SPLAT * FLOAT * count
    info = draw(splats, data.views[0], torch.zeros(3), near_plane=0.01).info
    conics = 3 * FLOAT * count
    projected = size(info.means2d, info.radii, info.depths, splats.opacities, splats.colors)
    assert projected + conics == PROJECTED * FLOAT * count
    parts = device_memory(count, 59, 1, 0)
    assert parts["drawn Gaussians"] == 2 * size(*splats)
    assert sum(parts.values()) == count * (4 * 59 * 4 + 2 * 14 * 4 + 21 * 4 + 4 * 24)
