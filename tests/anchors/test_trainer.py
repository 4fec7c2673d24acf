"""Steps of several views: what they learn, and when rounds come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.training.generated import make, training_set
from chronoscene.anchors.blocks import BlockStatistics
from chronoscene.anchors.optimizer import AnchorOptimizer
from chronoscene.anchors.trainer import AnchorTrainer, Drawn
from chronoscene.kernels import side_by_side
from chronoscene.methods.interface import Skipped
from chronoscene.rasterizer import rasterize
from chronoscene.training.drawing import Chance, camera_centre_tensor, camera_tensors
from chronoscene.training.gradients import BackwardPass, joined
from chronoscene.training.losses import mean_volume
from chronoscene.training.photometric import photometric_loss
from chronoscene.training.views import PhotosOnDevice

AT_THRESHOLDS = 5e-3
"""Largest error of a gradient, relative to the largest of its tensor. Measured in 21 steps: 2.5e-3
where alpha of a Gaussian in some pixel is at the threshold of being drawn, else 2e-6."""

SUM = 3e-7
"""The same for the sum alone: a few roundings of 6e-8."""


def trainer_of(**options: Any) -> AnchorTrainer:
    method = make(training_set(300, 40, 30), "chronogs", "fast", {"views_per_step": 4, **options})
    index = 0
    while index < 8:  # so that all tensors have gradients
        index += method.step(index, 0.3).views
    return method.trainer  # type: ignore[attr-defined, no-any-return]


def learned(trainer: AnchorTrainer, monkeypatch: pytest.MonkeyPatch) -> dict[str, Tensor]:
    """Do a step; the gradients that the optimisers use, with a row for each of the model."""
    found: dict[str, Tensor] = {}

    def look(self: AnchorOptimizer, rates: object, *, resized: bool) -> None:
        assert not resized
        found.update({name: t.grad for name, t in self.adam.params.items() if t.grad is not None})
        for name, table in self.tables.items():
            assert table.fetched is not None and table.fetched[1].grad is not None
            found[name] = torch.zeros_like(table.value)
            found[name][table.fetched[0]] = table.fetched[1].grad

    monkeypatch.setattr(AnchorOptimizer, "step", look)
    trainer.step(30, 0.3)
    return found


def learned_alone(trainer: AnchorTrainer, number: int) -> dict[str, Tensor]:
    """Gradients of the loss of one view, with a row for each of the model."""
    photo = torch.from_numpy(trainer.train.load_image(number))
    seen = trainer._learn(Drawn(number, Chance(0, 1, 0.5), photo, None)).seen
    found = seen.gradients()
    rows = {**seen.rows, "global_features": torch.tensor([seen.row])}
    for name, read in rows.items():
        whole = torch.zeros_like(trainer.model.tensors()[name])
        whole[read] = found[name]
        found[name] = whole
    return {name: gradient.detach() for name, gradient in found.items()}


def summed_losses(trainer: AnchorTrainer, numbers: Sequence[int]) -> dict[str, Tensor]:
    """Gradients of the sum of the losses of some views, in float64 and in plain torch."""
    model, config = trainer.snapshot(), trainer.config
    tensors = {
        name: t.detach().double() if t.is_floating_point() else t
        for name, t in model.tensors().items()
    }
    double = type(model).from_tensors(model.layout, tensors).requires_grad()
    loss = torch.zeros((), dtype=torch.float64)
    for number in numbers:
        view = trainer.train.views[number]
        weights = torch.zeros(model.layout.num_periods, dtype=torch.float64)
        weights[int(trainer.feature_rows[number])] = 1.0
        centre = camera_centre_tensor(view).double()
        splats, _ = double.decode_active(weights, centre, model.visible(view))
        raster = rasterize(
            *splats,
            *(tensor.double() for tensor in camera_tensors(view)),
            view.width,
            view.height,
            near_plane=config.near_plane,
            antialiased=config.antialiased,
            backgrounds=trainer.background.double()[None],
            backend="reference",
        )
        photo = torch.from_numpy(trainer.train.load_image(number))
        image = raster.image[0]
        loss = loss + photometric_loss(image, photo, ssim_weight=config.ssim_weight, mask=None)
        loss = loss + config.scale_weight * mean_volume(splats.scales, splats.opacities)
    loss.backward()
    return {name: t.grad for name, t in double.tensors().items() if t.grad is not None}


def test_a_step_learns_from_the_sum_of_the_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = trainer_of()
    drawn = trainer.sampler.drawn
    numbers = [trainer.sampler._view(draw) for draw in range(drawn, drawn + 4)]
    assert len({int(trainer.feature_rows[number]) for number in numbers}) > 1
    expected = summed_losses(trainer, numbers)
    alone = [learned_alone(trainer, number) for number in numbers]
    found = learned(trainer, monkeypatch)
    assert trainer.sampler.drawn == drawn + 4
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        largest = float(gradient.abs().max())
        assert (found[name] - gradient).abs().max() < AT_THRESHOLDS * largest, name
        single = torch.stack([view[name].double() for view in alone])
        assert (found[name] - single.sum(0)).abs().max() < SUM * single.abs().max(), name
        assert (single.sum(0) - single[0]).abs().max() > 0.1 * largest, "the others count"


def test_views_with_several_threads_each_give_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    results = []
    for threads in (1, 4):
        monkeypatch.setattr(side_by_side, "num_workers", lambda count=threads: count)
        results.append(trainer_of(views_per_step=2).snapshot().tensors())
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def test_views_that_are_skipped_take_no_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask ignores all of one view; the others learn as if there were no more."""
    masked, fewer = trainer_of(), trainer_of()
    drawn, hidden = masked.sampler.drawn, np.zeros((30, 40), bool)
    first, ignored, *others = (masked.sampler._view(draw) for draw in range(drawn, drawn + 4))
    masked.train = replace(masked.train, load_mask=lambda i: hidden if i == ignored else None)
    masked.photos = PhotosOnDevice(masked.train, torch.device("cpu"))
    rest = iter([first, *others])
    monkeypatch.setattr(fewer.sampler, "next", lambda: next(rest))
    fewer.views = 3
    results = []
    for trainer in (masked, fewer):
        with monkeypatch.context() as patch:
            results.append(learned(trainer, patch))
    assert results[0].keys() == results[1].keys()
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def test_blocks_count_the_pixels_of_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss of a view is a mean over the pixels that count, so they are what is counted."""
    counted: list[int] = []
    monkeypatch.setattr(BlockStatistics, "update", lambda *_, pixels, **__: counted.append(pixels))
    trainer = trainer_of(merge_share=0.01)
    half = np.arange(30 * 40).reshape(30, 40) < 600
    for mask in (None, half, np.ones_like(half)):
        trainer.train = replace(trainer.train, load_mask=lambda i, mask=mask: mask)
        trainer.photos = PhotosOnDevice(trainer.train, torch.device("cpu"))
        counted.clear()
        trainer.step(30, 0.3)
        assert counted == 4 * [600 if mask is half else 1200]


def test_periods_without_views_keep_their_features() -> None:
    """In a sequential training, features of earlier stages are not to follow the new ones."""
    every, spread = training_set(300, 40, 30), []
    for views in (every.views, tuple(view for view in every.views if view.period == 0)):
        method = make(replace(every, views=views), "chronogs", "fast", {"period_decay": 30.0})
        generator = torch.Generator().manual_seed(0)
        blocks = method.trainer.model.blocks  # type: ignore[attr-defined]
        with torch.no_grad():
            blocks.copy_(torch.randn(blocks.shape, generator=generator))
        for index in range(20):
            method.step(index, 0.01)
        model = method.trainer.snapshot()  # type: ignore[attr-defined]
        spread.append(float(model.blocks[model.block_rows].std(1).mean()))
    assert spread[0] < 1e-4 and spread[1] > 0.8


def test_anchors_move_before_a_round() -> None:
    """With one view to a step its gradients of anchors are dropped; of several they are not."""
    for views in (1, 4):
        trainer = trainer_of(views_per_step=views, density_interval=30, max_anchors=0)
        before = trainer.snapshot().features.clone()
        rounds = []
        grow = trainer.density._densify_if_due
        trainer.density._densify_if_due = lambda ends, done: rounds.append(ends) or grow(ends, done)  # type: ignore[method-assign]  # noqa: B023
        trainer.density._grow = lambda statistics: None  # type: ignore[method-assign]
        trainer.density._prune = lambda statistics: None  # type: ignore[method-assign]
        trainer.density.statistics = trainer.density._new_statistics()
        trainer.step(30 - views, 0.3)
        assert rounds == [True]
        assert torch.equal(trainer.snapshot().features, before) == (views == 1)


@pytest.mark.parametrize(
    ("views", "expected"),
    [
        ([(2.0, None)], (2.0, None)),
        ([(2.0, None), (9.0, "empty"), (4.0, None)], (3.0, None)),
        ([(2.0, "not finite"), (9.0, "empty")], (5.5, "not finite")),
        ([(2.0, "empty"), (4.0, "empty")], (3.0, "empty")),
        ([(1.0, None), (2.0, "not finite")], (1.0, None)),
    ],
)
def test_the_outcome_of_a_step(
    views: list[tuple[float, Skipped | None]], expected: tuple[float, Skipped | None]
) -> None:
    found = joined([BackwardPass(*view) for view in views])
    assert (found.loss, found.skipped) == expected
