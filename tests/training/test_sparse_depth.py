"""The term of depth against its definition; when a step has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import SparseDepths
from chronoscene.methods.interface import no_depths
from chronoscene.training.sparse_depth import INTERVAL, DepthTarget, SparseDepth


def test_the_term_is_the_mean_relative_deviation_of_the_pixels_with_points() -> None:
    rng = np.random.default_rng(0)
    rendered, depths = rng.uniform(1, 3, (5, 7, 1)), rng.uniform(1, 3, 4)
    alphas = rng.uniform(0, 1, (5, 7, 1))
    pixels = np.array([0, 8, 20, 34])
    target = DepthTarget(torch.from_numpy(pixels), torch.from_numpy(depths), 0.5)
    image, opacity = (torch.from_numpy(x).requires_grad_() for x in (rendered, alphas))
    term = target.term(image, opacity)
    deviations = alphas.flat[pixels] * np.abs(rendered.flat[pixels] / depths - 1)
    expected = 0.5 * np.mean(deviations)
    assert term.item() == pytest.approx(expected, rel=1e-12)
    term.backward()
    gradient = np.zeros(35)
    signs = np.sign(rendered.flat[pixels] - depths)
    gradient[pixels] = 0.5 * alphas.flat[pixels] * signs / depths / 4
    assert opacity.grad is None
    np.testing.assert_allclose(image.grad.flatten(), gradient, rtol=1e-12)


def test_a_view_without_points_has_no_term() -> None:
    data = make_training_set(1)
    some = replace(
        data, load_depths=lambda index: (no_depths if index else data.load_depths)(index)
    )
    depths = SparseDepth(0.1, some, torch.device("cpu"))
    assert depths.target(0, INTERVAL) is not None and depths.target(1, INTERVAL) is None


def test_every_so_many_views_have_the_term_with_a_weight_that_makes_up_for_the_others() -> None:
    data, loaded = make_training_set(1), []

    def load(index: int) -> SparseDepths:
        loaded.append(index)
        return data.load_depths(index)

    depths = SparseDepth(0.1, replace(data, load_depths=load), torch.device("cpu"))
    loaded.clear()
    targets = [depths.target(2, drawn) for drawn in range(1, 4 * INTERVAL + 1)]
    given = [target for target in targets if target is not None]
    assert [i for i, t in enumerate(targets, 1) if t] == [n * INTERVAL for n in (1, 2, 3, 4)]
    assert {target.weight for target in given} == {0.1 * INTERVAL} and loaded == [2]
    np.testing.assert_array_equal(given[0].pixels, data.load_depths(2).pixels)
    assert SparseDepth(0.0, data, torch.device("cpu")).target(2, INTERVAL) is None
