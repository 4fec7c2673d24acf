"""The training step without autograd against the one with it, which defines it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.training.generated import make, training_set
from chronoscene.anchors.trainer import AnchorTrainer, Drawn
from chronoscene.errors import ShapeError
from chronoscene.methods import SparseDepths
from chronoscene.training.drawing import Chance

OPTIONS: list[dict[str, Any]] = [
    {},
    {"antialiased": True, "scale_weight": 0.0, "global_dim": 0},
    {"random_background": True, "period_dim": 0},
    {"opacity_dropout": 0.3, "scale_weight": 0.1},
    {"depth_weight": 0.3, "opacity_dropout": 0.3},
]


def trainer_of(options: dict[str, Any], points: int = 300) -> AnchorTrainer:
    def depths(index: int) -> SparseDepths:
        return SparseDepths(np.arange(0, 1200, 7), np.linspace(1, 4, 172, dtype=np.float32))

    train = replace(training_set(points, 40, 30), load_depths=depths)
    method = make(train, "chronogs", "fast", options)
    for index in range(5):  # so that global features and all layers have gradients
        method.step(index, 0.3)
    return method.trainer  # type: ignore[attr-defined, no-any-return]


def learn(trainer: AnchorTrainer, way: str) -> tuple[Any, dict[str, torch.Tensor]]:
    number, row = 4, int(trainer.feature_rows[4])
    view, photo = trainer.train.views[number], torch.from_numpy(trainer.train.load_image(number))
    seen = trainer.optimizer.seen(trainer.model.visible(view), row)
    target = trainer.sparse_depth.target(number, 0)
    due = Drawn(number, Chance(0, trainer.sampler.drawn, 0.5), photo, None, target)
    found = (trainer._learn_directly if way == "direct" else trainer._learn_by_autograd)(seen, due)
    return found, seen.gradients()


@pytest.mark.parametrize("options", OPTIONS)
def test_both_ways_give_the_same_bits(options: dict[str, Any]) -> None:
    trainer = trainer_of(options)
    direct, gradients = learn(trainer, "direct")
    graph, expected = learn(trainer, "graph")
    assert direct[0] == graph[0] and direct[0].skipped is None
    assert gradients.keys() == expected.keys() and len(gradients) >= 15
    for name, gradient in expected.items():
        assert torch.equal(gradients[name], gradient), name
    for found, wanted in zip(direct[1:3], graph[1:3], strict=True):
        assert torch.equal(found, wanted)
    for name in ("means2d", "radii", "depths"):
        assert torch.equal(getattr(direct[3], name), getattr(graph[3], name))
    assert torch.equal(direct[3].means2d.grad, graph[3].means2d.grad)


@pytest.mark.parametrize(
    "options", [{"direction": "full"}, {"exposure": "image"}, {"global_heads": ("color",)}]
)
def test_other_models_go_through_autograd(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    direct = AnchorTrainer._learn_directly
    monkeypatch.setattr(
        AnchorTrainer, "_learn_directly", lambda *a: found.append(direct(*a)) or found[-1]
    )
    trainer_of(options)
    assert all(learned is None for learned in found)


def test_hardly_any_gaussian_goes_through_autograd() -> None:
    trainer = trainer_of({"offsets_per_anchor": 1}, points=3)
    assert learn(trainer, "direct")[0] is None
    trainer.step(5, 0.3)


def test_what_is_not_finite_is_named() -> None:
    trainer = trainer_of({"offsets_per_anchor": 5})  # of which the first is drawn
    with torch.no_grad():
        trainer.model.heads["color"].b2[0] = np.nan
    result, _ = learn(trainer, "direct")
    expected, _ = learn(trainer, "graph")
    assert result[0].skipped == expected[0].skipped == "not finite"
    assert result[0].not_finite == expected[0].not_finite


def test_a_near_plane_out_of_bounds_is_refused() -> None:
    with pytest.raises(ShapeError, match="near_plane"):
        trainer_of({"near_plane": 1e-30})
