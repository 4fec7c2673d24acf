"""Kernels for a GPU in tests: on one where there is one, else by Triton's interpreter on a CPU."""

import os
from importlib import import_module
from types import ModuleType

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
MARKS = [pytest.mark.gpu] if DEVICE == "cuda" else []

if DEVICE == "cpu":
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported


def gpu_kernels(name: str) -> ModuleType:
    """Import a module of kernels, or skip the tests that ask for it."""
    pytest.importorskip("triton", reason="needs Triton")
    return import_module(f"chronoscene.{name}")
