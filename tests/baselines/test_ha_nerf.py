"""Ha-NeRF as its card defines it: the light of a photo is what its encoder sees in it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, pad

from baselines.nerf.encoder import encode_photos, initial_encoder, small_photo
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import TrainingSet, build_config, import_object, load_spec

SMALL = {"samples": 2_048, "levels": 4, "log2_rows": 12, "finest": 64, "hidden": 16, "cells": 16}


def begun(data: TrainingSet, **options: Any) -> Any:
    spec = load_spec("ha-nerf")
    config = build_config(spec, preset="fast", overrides=SMALL | {"photos": 4} | options)
    method = import_object(spec.method)(config)
    method.setup(data, seed=0, device="cpu")
    return method


@pytest.fixture(scope="module")
def trained() -> Any:
    method = begun(make_training_set(3))
    for i in range(3):
        method.step(i, i / 3)
    return method


def test_the_encoder_is_five_convolutions_and_a_mean() -> None:
    layers = initial_encoder(4, 6, torch.Generator().manual_seed(0))
    for bias in layers[1::2]:
        bias += 0.1
    x = torch.rand(2, 3, 32, 32) * 2 - 1
    found = encode_photos(x, layers)
    for i, (edge, stride) in enumerate(((7, 1), (4, 2), (4, 2), (4, 2), (4, 2))):
        matrix, bias = layers[2 * i : 2 * i + 2]
        filters = matrix.view(len(matrix), -1, edge, edge)
        padded = pad(x, 4 * [3 if i == 0 else 1], mode="reflect")
        x = torch.relu(conv2d(padded, filters, bias, stride))
    assert x.shape == (2, 16, 2, 2)
    expected = x.mean((2, 3)) @ layers[-2].T + layers[-1]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_what_a_mask_ignores_is_grey_for_the_encoder() -> None:
    photo = np.full((40, 60, 3), 200, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[:, 30:] = True
    small = small_photo(photo, mask, 16)
    assert small.shape == (16, 16, 3)
    assert (small[:, :7] == 128).all()
    assert (small[:, 9:] == 200).all()


def test_the_light_of_a_view_is_the_mean_of_its_periods_photos(trained: Any) -> None:
    own = torch.tensor([i for i, view in enumerate(trained.pool.views) if view.period == 1])
    codes = trained.lights(own).detach()
    found = trained.view_codes(0.0, 1.0).color
    torch.testing.assert_close(found, codes.mean(0, keepdim=True))
    assert not torch.allclose(found, trained.view_codes(0.0, 0.0).color)


def test_photos_of_other_periods_do_not_reach_a_view() -> None:
    """The model stores the means of training photos; another photo alters that of its period."""
    data = make_training_set(3)
    last = max(i for i, view in enumerate(data.views) if view.period == 2)
    other = replace(data, load_image=lambda i: 255 * (i == last) ^ data.load_image(i))
    first, second = (begun(d).stored()["period_lights"] for d in (data, other))
    assert torch.equal(first[:2], second[:2])
    assert not torch.equal(first[2], second[2])


def test_the_light_alters_no_geometry(trained: Any) -> None:
    view = make_training_set(3).views[0]
    images = [trained.render(view, float(period)) for period in (0, 2)]
    assert np.array_equal(images[0].depth, images[1].depth)
    assert not np.array_equal(images[0].rgb, images[1].rgb)


def test_a_step_draws_rays_of_a_few_photos(trained: Any) -> None:
    rays = trained.draw_rays(np.random.default_rng(0))
    assert len(np.unique(rays.views)) == 4
    view = trained.pool.views[0]
    column, row = np.rint(rays.pixels[0].numpy() * [view.width, view.height] - 0.5).astype(int)
    image = make_training_set(3).load_image(int(rays.views[0]))
    np.testing.assert_allclose(rays.colors[0], image[row, column] / 255, atol=1e-6)


def test_masks_become_cheaper() -> None:
    method = begun(make_training_set(1))
    steps = method.config.iterations
    assert method.mask_weight(0.0) == 0.05
    assert method.mask_weight(0.5) == pytest.approx(0.05 * math.exp(-0.001 * 0.5 * steps))
    assert begun(make_training_set(1), iterations=100_000).mask_weight(1.0) == 0.006
