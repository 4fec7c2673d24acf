"""Figures show the right images: compared by the pixels that are drawn."""

import cv2
import numpy as np

from chronoscene.bench.comparison_figure import (
    chosen_views,
    draw_figures,
    first_seeds,
    mean_error,
    period_title,
)
from chronoscene.bench.predictions import ground_truth_folder, load_image, read_manifest
from chronoscene.bench.results import read_run

JOINT = "ring/mean-joint-balanced/seed0"


def test_every_scene_gets_its_figures(runs):
    paths = draw_figures(runs)
    assert [p.name for p in paths] == ["ring_comparison.png", "ring_errors.png"]
    image = cv2.imread(str(paths[0]))[..., ::-1]
    # Photos and predictions are there, each larger than a cell's half: nearly constant colours.
    truth = ground_truth_folder(runs, "ring")
    pooled = runs / "ring/mean-pooled-balanced/seed0/predictions"
    for folder in (truth, pooled):
        for entry in read_manifest(folder).images:
            color = load_image(folder, entry).mean(axis=(0, 1))
            assert (np.abs(image - color).max(axis=2) < 14).mean() > 0.02, entry
    assert image.shape[1] > 1200 and image.shape[0] > 500
    assert not list((runs / "figures").glob(".*"))


def test_views_are_spread_over_the_periods(runs):
    truth = ground_truth_folder(runs, "ring")
    assert [e.view for e in chosen_views(truth, 1)] == ["a/2.png", "b/2.png"]
    assert [e.view for e in chosen_views(truth, 5)] == ["a/2.png", "b/1.png", "b/2.png"]


def test_one_column_per_method_and_strategy(runs):
    record = read_run(runs / JOINT)
    later = record.model_copy(update={"seed": 4})
    other = record.model_copy(update={"strategy": "pooled"})
    found = [(runs / "c", later), (runs / "b", record), (runs / "a", other)]
    assert first_seeds(found) == [(runs / "a", other), (runs / "b", record)]


def test_error_is_the_mean_over_channels():
    black = np.zeros((2, 2, 3), np.uint8)
    image = black.copy()
    image[0, 0] = (255, 0, 51)
    np.testing.assert_allclose(mean_error(image, black), [[0.4, 0], [0, 0]])
    np.testing.assert_allclose(mean_error(black, image), [[0.4, 0], [0, 0]])


def test_period_titles():
    assert period_title(1, {"1": "autumn"}) == "autumn"
    assert period_title(1, {"1": "1"}) == "period 1"
    assert period_title(2, {}) == "period 2"
