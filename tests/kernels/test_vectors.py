"""Vectors in compiled kernels do to each lane what NumPy does to each number."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from numba import njit

from chronoscene.kernels import vectors
from chronoscene.kernels.memory import load, store
from chronoscene.kernels.vectors import LANES, select, splat

A = np.linspace(-3.1, 4, LANES, dtype=np.float32)
B = np.where(np.arange(LANES) % 3 == 0, A, np.linspace(5, 1, LANES)).astype(np.float32)


def apply(function: Callable[..., Any], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Run a function of two vectors in compiled code."""
    inner: Any = njit(function)

    def run(a: Any, b: Any, out: Any) -> None:
        store(out, 0, inner(load(a, 0), load(b, 0)))

    out = np.zeros_like(a)
    compiled: Any = njit(run)
    compiled(a, b, out)
    return out


@pytest.mark.parametrize("op", [operator.add, operator.sub, operator.mul, operator.truediv])
def test_arithmetic(op: Callable[..., Any]) -> None:
    np.testing.assert_allclose(apply(lambda a, b: op(a, b), A, B), op(A, B), rtol=3e-7)


def test_whole_numbers() -> None:
    a = np.arange(LANES, dtype=np.int32) - 3
    np.testing.assert_array_equal(
        apply(lambda a, b: ((a + b) * a - b) << 2 | 1, a, a[::-1].copy()),
        ((a + a[::-1]) * a - a[::-1]) << 2 | 1,
    )
    np.testing.assert_array_equal(apply(lambda a, b: a >> 1 & b, a, a + 1), a >> 1 & a + 1)


@pytest.mark.parametrize("op", [operator.lt, operator.le, operator.gt, operator.ge])
def test_comparisons_are_masks_and_nan_is_in_none(op: Callable[..., Any]) -> None:
    a = A.copy()
    a[1] = np.nan
    chosen = apply(lambda a, b: select(op(a, b), a, b), a, B)
    np.testing.assert_array_equal(chosen, np.where(op(a, B), a, B))


def test_numbers_stand_for_vectors() -> None:
    found = apply(lambda a, b: 2 - a * 3 + splat(np.float32(7)) / b, A, B)
    np.testing.assert_allclose(found, 2 - A * 3 + 7 / B, rtol=0, atol=1e-5)


def test_widths_do_not_mix() -> None:
    narrow = vectors.make_splat("f32", LANES // 2)

    with pytest.raises(numba.TypingError):
        apply(lambda a, b: a + narrow(np.float32(1)), A, B)


@pytest.mark.parametrize(
    ("features", "lanes"),
    [("+avx,+avx2,+avx512f", 16), ("+avx,+avx2,-avx512f", 8), ("+sse2,+avx", 4), ("", 4)],
)
def test_registers(monkeypatch: pytest.MonkeyPatch, features: str, lanes: int) -> None:
    monkeypatch.setattr(numba.config, "CPU_FEATURES", features)
    assert vectors._register_lanes() == lanes
