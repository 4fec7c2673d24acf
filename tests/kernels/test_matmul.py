"""Products of matrices inside compiled kernels."""

import platform

import numpy as np
import pytest
from numba import njit

from chronoscene.kernels.matmul import PADDING, ROW_TILE, _make_product, byte_product
from chronoscene.kernels.vectors import BYTE_PRODUCTS, LANES, emit_add_pair_products


@pytest.mark.parametrize("machine", [platform.machine(), "another"])
@pytest.mark.parametrize("columns", [LANES, 3 * LANES])
def test_products_of_pairs_are_exact(
    machine: str, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a processor has no instruction for them."""
    monkeypatch.setattr(platform, "machine", lambda: machine)
    product = _make_product(emit_add_pair_products)

    @njit
    def run(left, right, first, out):  # type: ignore[no-untyped-def]
        rows, depth = left.shape
        width = right.shape[1]
        factors = (left, 0, depth, 1), (right, 0, width)
        product(*factors, (first, 0, 0), (out, 0, width), rows, width, depth)

    rng = np.random.default_rng(0)
    left = rng.integers(-3000, 3000, (2 * ROW_TILE, 2 * PADDING)).astype(np.int16)
    right = rng.integers(-3000, 3000, (PADDING, columns, 2)).astype(np.int16)
    first = rng.integers(-1000, 1000, columns).astype(np.int32)
    out = np.zeros((2 * ROW_TILE, columns), np.int32)
    run(left.view(np.int32), right.view(np.int32)[..., 0], first, out)
    wanted = first + np.einsum(
        "rkp,kcp->rc", left.reshape(-1, PADDING, 2).astype(int), right.astype(int)
    )
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.skipif(not BYTE_PRODUCTS, reason="the processor has no products of bytes")
def test_products_of_bytes_are_exact() -> None:
    @njit
    def run(left, right, first, out):  # type: ignore[no-untyped-def]
        rows, depth = left.shape
        width = right.shape[1]
        factors = (left, 0, depth, 1), (right, 0, width)
        byte_product(*factors, (first, 0, 0), (out, 0, width), rows, width, depth)

    rng = np.random.default_rng(0)
    left = rng.integers(0, 256, (2 * ROW_TILE, 4 * PADDING)).astype(np.uint8)
    right = rng.integers(-128, 128, (PADDING, 3 * LANES, 4)).astype(np.int8)
    first = rng.integers(-1000, 1000, 3 * LANES).astype(np.int32)
    out = np.zeros((2 * ROW_TILE, 3 * LANES), np.int32)
    run(left.view(np.int32), right.view(np.int32)[..., 0], first, out)
    wanted = first + np.einsum(
        "rkp,kcp->rc", left.reshape(-1, PADDING, 4).astype(int), right.astype(int)
    )
    np.testing.assert_array_equal(out, wanted)
