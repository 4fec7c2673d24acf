"""Fixtures of the rasterizer's tests."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from rasterizer_cases.comparison import Comparison, compare, steady_pixels, thresholds
from rasterizer_cases.scenes import SmallScene, crowd, random_scene


@pytest.fixture(scope="session")
def tolerances() -> ModuleType:
    return importlib.import_module("tolerances")


@pytest.fixture(scope="session")
def tools() -> SimpleNamespace:
    """Functions that the test files share."""
    return SimpleNamespace(
        compare=compare,
        random_scene=random_scene,
        crowd=crowd,
        steady_pixels=steady_pixels,
        thresholds=thresholds,
    )


@pytest.fixture(scope="session")
def check_agreement(tolerances: ModuleType) -> Callable[..., Comparison]:
    """Assert that a backend agrees with the reference on a scene."""

    def check(scene: SmallScene, backend: str = "cpu", device: str = "cpu") -> Comparison:
        comparison = compare(scene, backend, device)
        if backend == "cuda":
            comparison = comparison.without_grazing()
        limits = {
            "image": tolerances.IMAGE,
            "alphas": tolerances.ALPHA,
            "depths": tolerances.DEPTH,
            "means2d": tolerances.MEANS2D,
            "z": tolerances.MEANS2D,
        }
        for name in comparison.expected:
            if name != "radii":
                error = comparison.error(name, tolerances.FLOOR)
                assert error <= limits.get(name, tolerances.GRADIENT), (name, error)
        radii = comparison.got["radii"] - comparison.expected["radii"]
        assert np.abs(radii).max(initial=0) <= 1  # rounded up: a hair above an integer is one more
        return comparison

    return check
