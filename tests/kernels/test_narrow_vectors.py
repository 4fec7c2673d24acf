"""Kernels as other processors run them: compiled for narrower vectors, in another process."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from chronoscene.kernels.vectors import LANES

TESTS = Path(__file__).parents[1]
NARROWER = {
    "8 lanes": ("haswell", "+avx,+avx2,+fma,+bmi,+bmi2,+popcnt,+lzcnt,+f16c,+movbe,+sse4.2"),
    "4 lanes": ("x86-64", "+sse2"),
}
SMALL_TESTS = ("kernels/test_vectors.py", "registration/features/test_nearest.py")
LARGE_TESTS = (
    "rasterizer/test_agreement.py",
    "rasterizer/test_extremes.py",
    "anchors/test_decode.py",
    "fields/test_kernels.py",
    "training/test_losses.py",
    "training/test_photometric.py",
    "training/test_spherical_harmonics.py",
    "training/optimizers/test_row_adam.py",
)


def run_narrow(lanes: str, tests: tuple[str, ...], cache: Path) -> None:
    """Run tests in a process whose kernels have that many lanes."""
    processor, features = NARROWER[lanes]
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("needs an x86-64 processor")
    if lanes == "8 lanes" and "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("needs a processor with AVX2")
    environment = dict(
        os.environ,
        NUMBA_CPU_NAME=processor,
        NUMBA_CPU_FEATURES=features,
        NUMBA_CACHE_DIR=str(cache),
        EXPECTED_LANES=lanes.split()[0],
    )
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    result = subprocess.run(
        [*command, str(Path(__file__)) + "::test_this_process_has_the_lanes_that_it_should",
         *(str(TESTS / test) for test in tests)],
        env=environment,
        capture_output=True,
        text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-1000:]


@pytest.mark.slow
@pytest.mark.parametrize("lanes", NARROWER)
def test_narrow_vectors_agree(lanes: str, pytestconfig: pytest.Config, tmp_path: Path) -> None:
    if int(lanes.split()[0]) == LANES:
        pytest.skip("this processor has as many lanes: the other tests are these")
    # Kept between runs, as compiling takes nearly all of the time.
    cache = pytestconfig.cache
    folder = cache.mkdir("kernels_of_" + lanes.replace(" ", "_")) if cache else tmp_path
    run_narrow(lanes, SMALL_TESTS, folder)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", NARROWER)
def test_narrow_vectors_agree_in_every_case(lanes: str, tmp_path: Path) -> None:
    run_narrow(lanes, LARGE_TESTS, tmp_path)


def test_this_process_has_the_lanes_that_it_should() -> None:
    assert int(os.environ.get("EXPECTED_LANES", LANES)) == LANES
