"""The benchmark of training steps: what it times is still there, and how it reads a trace."""

from __future__ import annotations

import pytest
import torch

from benchmarks.training.generated import PROGRESS, make, training_set
from benchmarks.training.gpu_trace import summary
from benchmarks.training.scaling import ROUND, measure_scaling, parallel_share, print_scaling
from benchmarks.training.step import GPU_PARTS, PARTS, measure
from chronoscene.training import devices


@pytest.mark.parametrize(
    ("name", "absent"),
    [
        ("chronogs", {"deformation", "spherical harmonics"}),
        ("3dgs", {"deformation", "frustum culling", "fetch anchors", "decode"}),
        ("4dgs", {"frustum culling", "fetch anchors", "decode"}),
    ],
)
def test_parts_of_a_step_on_a_gpu(
    name: str, absent: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code of a GPU on a CPU."""
    monkeypatch.setattr(devices, "has_kernels", lambda *tensors: False)
    method = make(training_set(200, 24, 16), name, "fast")
    assert method.size().primitives == 200
    backward = torch.Tensor.backward
    settled = []
    steps = [lambda i=i: method.step(i, PROGRESS) for i in (10, 11, 12)]
    found = measure(steps, GPU_PARTS, lambda: settled.append(1))
    assert torch.Tensor.backward is backward and len(settled) > 30
    assert {part for part, _, _ in GPU_PARTS} - found.keys() == absent
    for values in found.values():
        assert len(values) == 3 and min(values) >= 0
    parts = sum(sum(values) for part, values in found.items() if part != "step")
    assert parts == pytest.approx(sum(found["step"]))


def test_the_parallel_share_of_a_part() -> None:
    assert parallel_share(10.0, 5.0, 2) == 1.0
    assert parallel_share(10.0, 10.0, 8) == 0.0
    assert parallel_share(10.0, 4.0, 4) == pytest.approx(0.8)


@pytest.mark.parametrize("name", ["chronogs", "3dgs"])
def test_parts_of_a_step_by_threads(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = measure_scaling(
        name, 200, (24, 16), preset="fast", threads=(1, 2), steps=1, measure=measure
    )
    print_scaling("title", found, tuple(dict.fromkeys(part for part, _, _ in PARTS)))
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "title" and lines[2].split()[-2:] == ["parallel,", "2"]
    assert {"rasterize", "loss and its gradient", "check of gradients", "Adam"} <= found[2].keys()
    assert lines[-1].startswith("step") and len(found[1]["step"]) == ROUND


def test_a_trace_of_two_steps() -> None:
    """Kernels may overlap; what is not on the GPU does not occupy it."""
    copy = {"cat": "gpu_memcpy", "dur": 100.0}
    events = [
        {"cat": "kernel", "name": "a", "ts": 0.0, "dur": 1000.0},
        {"cat": "kernel", "name": "b", "ts": 500.0, "dur": 1000.0},
        {"cat": "cpu_op", "name": "aten::add", "ts": 0.0, "dur": 9000.0},
        {**copy, "name": "Memcpy DtoH (Device -> Pageable)", "ts": 2000.0, "args": {"bytes": 12}},
        {**copy, "name": "Memcpy HtoD (Pinned -> Device)", "ts": 3000.0, "args": {"bytes": 64}},
        {"cat": "gpu_memset", "name": "Memset (Device)", "ts": 3050.0, "dur": 350.0},
        {"cat": "cuda_runtime", "name": "cudaStreamSynchronize", "ts": 2000.0, "dur": 100.0},
        {"name": "process_name", "ph": "M"},
    ]
    assert summary(events, 2) == (1.0, 6.0, 0.5, 32.0, 0.5)
