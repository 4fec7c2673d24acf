"""Control that contradicts itself, and control of little accuracy."""

import re

import numpy as np

from chronoscene.registration.ties.control import contradictions, fit_control
from chronoscene.scene.similarity import Sim3

NAMES = [f"g{i}" for i in range(8)]
PLACES = np.random.default_rng(3).uniform(-20, 20, (8, 3))
THERE = Sim3(2.0, np.diag([1.0, -1.0, -1.0]), np.array([5.0, 6.0, 7.0]))


def targets(off: dict[int, float]) -> np.ndarray:
    """Coordinates with a little noise; some are so far off."""
    found = THERE.apply(PLACES) + np.random.default_rng(4).normal(0, 0.01, PLACES.shape)
    for i, distance in off.items():
        found[i, 0] += distance
    return found


def test_a_list_that_contradicts_itself_is_named_point_by_point() -> None:
    for count in (5, 8):
        assert contradictions(NAMES[:count], PLACES[:count], targets({})[:count]) == []
        (one,) = contradictions(NAMES[:count], PLACES[:count], targets({2: 3.0})[:count])
        assert re.fullmatch(r"g2 is \S+ m off, and the others fit to \S+ m", one)


def test_a_point_that_is_stated_to_be_rough_is_not_wrong() -> None:
    off = targets({2: 1.5})
    found = fit_control(PLACES, off, [None] * 8)
    assert found is not None and found[1].sum() == 7 and not found[1][2]
    rough = [np.full(3, 1.0) if i == 2 else np.full(3, 0.01) for i in range(8)]
    found = fit_control(PLACES, off, rough)
    assert found is not None and found[1].all()
    np.testing.assert_allclose(found[0].scale, 2.0, atol=0.01)
