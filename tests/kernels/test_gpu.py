"""A trial of Triton on this machine, and the warning where it fails."""

import sys
import warnings
from types import SimpleNamespace

import pytest
from gpu_kernels import DEVICE, MARKS, gpu_kernels

from chronoscene.kernels import gpu

pytestmark = MARKS


@pytest.fixture(autouse=True)
def afresh():
    for function in (gpu.has_triton, gpu.compiles):
        function.cache_clear()
    yield
    for function in (gpu.has_triton, gpu.compiles):
        function.cache_clear()


def test_the_trial_runs() -> None:
    gpu_kernels("kernels.gpu_trial").run(DEVICE)


def test_without_triton_nothing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "find_spec", lambda name: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not gpu.compiles()


@pytest.mark.parametrize("message", ["Failed to find C compiler. Please specify via CC\nmore", ""])
def test_a_compiler_that_fails_is_told_once(monkeypatch: pytest.MonkeyPatch, message: str) -> None:
    def run() -> None:
        raise RuntimeError(message)

    monkeypatch.setattr(gpu, "find_spec", lambda name: name)
    monkeypatch.setitem(sys.modules, "chronoscene.kernels.gpu_trial", SimpleNamespace(run=run))
    reason = message.splitlines()[0] if message else "RuntimeError"
    with pytest.warns(UserWarning, match="Plain torch takes their place") as told:
        assert not gpu.compiles()
        assert not gpu.compiles()
    assert len(told) == 1 and f"({reason})" in str(told[0].message)
