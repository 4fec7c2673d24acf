"""Triton compiles our kernels for a GPU, which it can do without one."""

import os
import subprocess
import sys

import pytest

COMPILE = """
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile

from chronoscene.anchors import visibility_gpu
from chronoscene.anchors.decode import gpu as decode
from chronoscene.kernels import gpu_trial
from chronoscene.rasterizer import clean_gpu
from chronoscene.training.photometric import ssim_gpu

TYPES = {
    "count": "i32", "plane": "i32", "width": "i32", "flags": "*i32", "ends": "*i32",
    "used": "*i64", "index": "*i64", "camera": "*fp64", "mask": "*i1", "good": "*i1", "y": "*u8",
}
NUMBERS = (
    "unit", "weight", "other_weight", "above", "near", "far", "extent", "blur", "slack", "length",
)
SIZES = {"LENGTH": 4, "BLOCK": 16, "K": 10, "WIDTH": 16, "COLUMNS": 6, "D": 3}


def build(module, name, **types):
    function = getattr(module, name)
    given = TYPES | {number: "fp32" for number in NUMBERS} | types
    names = function.arg_names
    signature = {n: "constexpr" if n in SIZES else given.get(n, "*fp32") for n in names}
    sizes = {(i,): SIZES[n] for i, n in enumerate(names) if n in SIZES}
    compile(ASTSource(function, signature, sizes), target=GPUTarget("cuda", 90, 32))
    print(name)


build(visibility_gpu, "_mark", width="fp32", height="fp32")
for name in ("_switch", "_place", "_learn"):
    build(decode, name)
build(gpu_trial, "_count", numbers="*i32")
build(clean_gpu, "_clean", opacity="fp32")
for name in ("_blur_rows_of_images", "_compare", "_blur_rows_of_slopes", "_differentiate"):
    build(ssim_gpu, name)
"""


def test_all_kernels_compile(tmp_path: os.PathLike[str]) -> None:
    pytest.importorskip("triton", reason="needs Triton")
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", COMPILE], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(done.stdout.split()) == 10
