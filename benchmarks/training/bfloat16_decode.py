"""Time gained and accuracy lost by decoding in bfloat16.

    python -m benchmarks.training.bfloat16_decode SCENE MODEL

Gain: the matrix products of the decode (blocks of 64 anchors through the layers of ChronoGS), once
with the float32 kernel that the decode uses and once with the processor's bfloat16 dot products
(AVX512-BF16), both on one thread, in turns. Cost: test views of a trained model (MODEL, a
checkpoint) rendered with features and weights rounded to bfloat16 before the products, as that
instruction would see them, against float32: PSNR between the two, and change of PSNR against the
photos. Products are a part of the decode; what they save at most is printed from their share.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from chronogs.config import ChronoGSConfig
from chronogs.method import ChronoGS
from chronoscene.anchors.decode import HeadWeights
from chronoscene.anchors.model import HEADS
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import code_version, processor_name
from chronoscene.harness.plan.parts import make_parts
from chronoscene.harness.train.loop import render_bytes
from chronoscene.images.store import ImageStore
from chronoscene.kernels.matmul import product
from chronoscene.metrics.psnr_ssim import psnr

ROWS, LAYERS = 64, ((48, 96), (32, 16), (32, 96), (32, 32))
"""Anchors of a block; inputs (padded) and outputs of the first layers, and of the second layers of
opacity, shape and colour."""


class _BFloat(ir.Type):
    """The type that llvmlite does not have."""

    null = "0.0"

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self))

    def __hash__(self) -> int:
        return hash(type(self))


@intrinsic
def _tile(typing: Any, left: Any, right: Any, out: Any, row: Any, column: Any, pairs: Any) -> Any:
    """8 rows by 32 columns of out = left @ right; pairs of bfloat16 as one int32.

    left: int32 [rows, pairs]; right: int32 [pairs, columns]; out: float32 [rows, columns].
    """

    def generate(context: Any, b: Any, signature: Any, args: Any) -> Any:
        word, number = ir.IntType(32), ir.FloatType()
        words, floats = ir.VectorType(word, 16), ir.VectorType(number, 16)
        halves = ir.VectorType(_BFloat(), 32)
        kind = ir.FunctionType(floats, [floats, halves, halves])
        dot = cgutils.get_or_insert_function(b.module, kind, "llvm.x86.avx512bf16.dpbf16ps.512")
        kinds = zip(signature.args[:3], args[:3], strict=True)
        arrays = [context.make_array(kind)(context, b, value) for kind, value in kinds]
        strides = [cgutils.unpack_tuple(b, a.shape, 2)[1] for a in arrays]
        top, first, pairs = args[3:]
        index = top.type

        def at(which: int, r: Any, c: Any) -> Any:
            return b.gep(arrays[which].data, [b.add(b.mul(r, strides[which]), c)])

        columns = [b.add(first, index(16 * i)) for i in range(2)]
        rows = [b.add(top, index(i)) for i in range(8)]
        zero = ir.Constant(floats, [0.0] * 16)
        sums = [[cgutils.alloca_once_value(b, zero) for _ in columns] for _ in rows]
        with cgutils.for_range(b, pairs) as loop:
            vectors = []
            for c in columns:
                pointer = b.bitcast(at(1, loop.index, c), words.as_pointer())
                value = b.load(pointer, typ=words)
                value.align = 4
                vectors.append(b.bitcast(value, halves))
            for r, row_sums in zip(rows, sums, strict=True):
                pair = b.load(at(0, r, loop.index))
                single = b.insert_element(ir.Constant(words, ir.Undefined), pair, word(0))
                spread = b.shuffle_vector(
                    single, ir.Constant(words, ir.Undefined), ir.Constant(words, [0] * 16)
                )
                factor = b.bitcast(spread, halves)
                for total, vector in zip(row_sums, vectors, strict=True):
                    b.store(b.call(dot, [b.load(total), factor, vector]), total)
        for r, row_sums in zip(rows, sums, strict=True):
            for total, c in zip(row_sums, columns, strict=True):
                pointer = b.bitcast(at(2, r, c), floats.as_pointer())
                b.store(b.load(total), pointer).align = 4
        return context.get_dummy_value()

    return types.void(left, right, out, row, column, pairs), generate


@njit
def half_product(left: Any, right: Any, out: Any, repeats: int) -> None:
    """Block products in bfloat16, again and again."""
    for _ in range(repeats):
        for column in range(0, out.shape[1], 32):
            for row in range(0, out.shape[0], 8):
                _tile(left, right, out, row, column, left.shape[1])


@njit
def single_product(left: Any, right: Any, first: Any, out: Any, repeats: int) -> None:
    """Multiply in float32, with the kernel of the decode."""
    rows, depth, columns = out.shape[0], left.shape[1], out.shape[1]
    for _ in range(repeats):
        product(
            (left.ravel(), 0, depth, 1),
            (right.ravel(), 0, columns),
            (first, 0, 0),
            (out.ravel(), 0, columns),
            rows,
            columns,
            depth,
        )


def rounded(value: torch.Tensor) -> torch.Tensor:
    """The nearest bfloat16, as float32."""
    return value.bfloat16().float()


def pairs(matrix: NDArray[np.float32], axis: int) -> NDArray[np.int32]:
    """Neighbours along an axis as two bfloat16 in one number, the first in the low half."""
    bits = torch.from_numpy(matrix).bfloat16().view(torch.int16).numpy()
    bits = np.moveaxis(bits.astype(np.uint16).astype(np.uint32), axis, -1)
    joined = (bits[..., 0::2] | bits[..., 1::2] << 16).view(np.int32)
    return np.ascontiguousarray(np.moveaxis(joined, -1, axis))


def time_products(repeats: int = 400, rounds: int = 30) -> None:
    """Print the ratio of both kernels for each layer, after checking that they agree."""
    g = np.random.default_rng(0)
    totals = np.zeros((rounds, 2))
    for depth, columns in LAYERS:
        wide = -(-columns // 32) * 32
        left = g.normal(size=(ROWS, depth)).astype(np.float32)
        right = g.normal(size=(depth, wide)).astype(np.float32)
        first, out, half = np.zeros(wide, np.float32), *np.empty((2, ROWS, wide), np.float32)
        a, b = pairs(left, 1), pairs(right, 0)
        half_product(a, b, half, 1)
        single_product(left, right, first, out, 1)
        exact = rounded(torch.from_numpy(left)) @ rounded(torch.from_numpy(right))
        np.testing.assert_allclose(half, exact, atol=1e-4)
        np.testing.assert_allclose(out, left @ right, atol=1e-4)
        for i in range(rounds):
            start = time.perf_counter()
            single_product(left, right, first, out, repeats)
            middle = time.perf_counter()
            half_product(a, b, half, repeats)
            totals[i] += middle - start, time.perf_counter() - middle
    print(f"products of a block: float32 / bfloat16 = {np.median(totals[:, 0] / totals[:, 1]):.2f}")
    anchor = 1e9 * np.median(totals, axis=0) / (repeats * ROWS)
    print(f"nanoseconds per anchor: {anchor[0]:.0f} and {anchor[1]:.0f}")


class Rounded(ChronoGS):
    """ChronoGS whose features and weights of the heads are bfloat16."""

    def round(self) -> None:
        """Round what goes into the products."""
        model = self.model
        model.features = rounded(model.features)
        for name in HEADS:
            head = model.heads[name]
            weights = (rounded(head.w1), head.b1, rounded(head.w2), head.b2)
            model.heads[name] = HeadWeights(*weights)


def compare_images(scene_folder: Path, checkpoint: Path) -> None:
    """Print what rounding does to the test views."""
    scene = read_scene(scene_folder)
    (part,) = make_parts(scene, ImageStore(scene), "joint")
    methods = [Rounded(ChronoGSConfig()) for _ in range(2)]
    for method in methods:
        method.load(checkpoint, device="cpu")
    methods[1].round()
    rows = []
    for frame in part.test:
        photo = part.store.load(frame)
        exact, half = (render_bytes(method, part, frame) for method in methods)
        rows.append((psnr(half, exact), psnr(exact, photo), psnr(half, photo)))
    between, single, half = np.mean(rows, axis=0)
    print(f"{len(rows)} test views: {between:.1f} dB between float32 and bfloat16")
    print(f"against the photos: {single:.3f} dB in float32, {half:.3f} dB in bfloat16")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("model", type=Path)
    options = parser.parse_args()
    print(f"{processor_name()}, commit {code_version()}")
    compare_images(options.scene, options.model)
    time_products()


if __name__ == "__main__":
    main()
