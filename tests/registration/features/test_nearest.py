"""Matches of descriptors against a plain search in float64."""

from __future__ import annotations

import numpy as np
import pytest

from chronoscene.registration.features.nearest import Descriptors, mutual_matches


def found(a: np.ndarray, b: np.ndarray) -> list[tuple[int, int]]:
    matches = mutual_matches(Descriptors.of(a), Descriptors.of(b))
    assert matches.dtype == np.uint32
    assert matches.shape[1] == 2
    return [(int(i), int(j)) for i, j in matches]


def expected(a: np.ndarray, b: np.ndarray) -> list[tuple[int, int]]:
    """COLMAP's rule, pair by pair."""
    one, two = _best(a, b), _best(b, a)
    return [(i, j) for i, j in one.items() if two.get(j) == i]


def _best(queries: np.ndarray, searched: np.ndarray) -> dict[int, int]:
    best = {}
    for i, query in enumerate(queries.astype(np.float64)):
        squares = ((searched.astype(np.float64) - query) ** 2).sum(axis=1)
        order = np.argsort(squares, kind="stable")
        if not len(order) or squares[order[0]] > (0.7 * 512) ** 2:
            continue
        # 0.8 is 4 / 5: squared and in whole numbers, ties are exact.
        if len(order) > 1 and 25 * squares[order[0]] >= 16 * squares[order[1]]:
            continue
        best[i] = int(order[0])
    return best


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Such as RootSIFT makes: of length 512, with many small numbers."""
    shares = rng.gamma(0.4, 1.0, (count, 128))
    roots = np.sqrt(shares / shares.sum(axis=1, keepdims=True))
    return np.minimum(np.rint(512 * roots), 255).astype(np.uint8)


def disturbed(rng: np.random.Generator, values: np.ndarray, noise: float) -> np.ndarray:
    return np.clip(values + rng.normal(0, noise, values.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("n", "m"), [(300, 420), (530, 1100), (97, 96), (1, 200), (200, 1), (2, 2), (1, 1)]
)
def test_matches_are_those_of_a_plain_search(n: int, m: int) -> None:
    rng = np.random.default_rng(n + m)
    a, b = descriptors(rng, n), descriptors(rng, m)
    same = min(n, m) // 2 + 1
    noise = np.linspace(2, 40, same)[:, None]  # from clear ones to some that fail
    b[:same] = disturbed(rng, a[:same], noise)
    b = b[rng.permutation(m)]
    assert found(a, b) == expected(a, b)
    assert found(b, a) == expected(b, a) == sorted((j, i) for i, j in found(a, b))
    assert len(found(a, b)) >= max(1, same // 3)


def test_ties_and_limits_are_exact() -> None:
    base = np.zeros(128, np.uint8)
    base[0] = 200

    def moved(amount: int, dimension: int) -> np.ndarray:
        other = base.copy()
        other[dimension] += amount
        return other

    query = base[None]
    assert found(query, np.stack([moved(5, 1), moved(5, 2)])) == []  # equally near
    assert found(query, np.stack([moved(4, 1), moved(5, 2)])) == []  # a ratio of 0.8
    assert found(query, np.stack([moved(39, 1), moved(50, 2)])) == [(0, 0)]
    assert found(query, np.stack([base, base])) == []
    far = base.copy()
    far[1:3] = 253, 254  # a distance of 358.495; the limit is 358.4
    assert found(query, far[None]) == []
    far[2] = 253
    assert found(query, far[None]) == [(0, 0)]
    # Two queries at the same distance from one: neither is its own.
    assert found(np.stack([moved(5, 1), moved(5, 2)]), query) == []


def test_equal_descriptors_in_both_images_do_not_match() -> None:
    rng = np.random.default_rng(7)
    a = descriptors(rng, 600)
    assert found(a, a) == [(i, i) for i in range(600)]
    twice = np.concatenate([a, a[:40]])
    assert found(a, twice) == expected(a, twice) == [(i, i) for i in range(40, 600)]


def test_an_image_without_features_has_no_matches() -> None:
    rng = np.random.default_rng(0)
    none, some = np.zeros((0, 128), np.uint8), descriptors(rng, 5)
    assert found(none, some) == found(some, none) == found(none, none) == []


def test_descriptors_of_the_largest_lengths() -> None:
    """Bytes of any size."""
    rng = np.random.default_rng(5)
    a = rng.integers(200, 256, (150, 128)).astype(np.uint8)
    b = np.concatenate([disturbed(rng, a[:100], 4.0), rng.integers(200, 256, (50, 128))])
    b = b.astype(np.uint8)
    assert found(a, b) == expected(a, b)
    assert len(found(a, b)) > 50
