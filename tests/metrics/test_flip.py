"""FLIP through the package of its authors, and through a stand-in where that is not installed."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from chronoscene.metrics.flip import flip
from chronoscene.metrics.registry import make_scorers


def noisy_pair():
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    noise = rng.integers(-40, 41, photo.shape)
    return np.clip(photo.astype(int) + noise, 0, 255).astype(np.uint8), photo


def test_golden_value():
    """Mean error maps of flip-evaluator 1.7 with its default parameters.

    Means are in double precision; that of the package is 0.967395 for black and white.
    """
    pytest.importorskip("flip_evaluator")
    image, photo = noisy_pair()
    assert flip(image, photo) == pytest.approx(0.180027, abs=1e-6)
    assert flip(photo, photo) == 0
    black, white = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 255, np.uint8)
    assert flip(black, white) == pytest.approx(0.967388, abs=1e-6)


def test_the_error_map_is_averaged_over_the_mask(monkeypatch):
    asked = []

    def evaluate(reference, test, dynamic_range, **options):
        asked.append((reference, test, dynamic_range, options))
        return np.linspace(0, 1, 6, dtype=np.float32).reshape(2, 3, 1), -1, {}

    monkeypatch.setitem(sys.modules, "flip_evaluator", SimpleNamespace(evaluate=evaluate))
    image, photo = np.zeros((2, 3, 3), np.uint8), np.full((2, 3, 3), 51, np.uint8)
    mask = np.array([[False, True, True], [False, False, False]])
    assert flip(image, photo) == pytest.approx(0.5)
    assert flip(image, photo, mask) == pytest.approx(0.3)
    reference, test, dynamic_range, options = asked[0]
    assert (reference == np.float32(0.2)).all() and not test.any() and dynamic_range == "LDR"
    assert reference.dtype == test.dtype == np.float32
    distance, pixels, width = options["parameters"]["vc"]
    assert distance * pixels / width * np.pi / 180 == pytest.approx(67.02, abs=0.01)


def test_without_the_package_it_is_absent_with_a_reason(monkeypatch):
    monkeypatch.setattr("chronoscene.metrics.registry.find_spec", lambda name: None)
    scorers = make_scorers(["psnr", "flip"])
    assert list(scorers.functions) == ["psnr"]
    assert scorers.skipped == {"flip": "not installed: pip install flip_evaluator"}
