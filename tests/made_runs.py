"""Runs that nobody trained, for tests of what is made of runs."""

import numpy as np

from chronoscene.bench.results import Row, RunRecord
from chronoscene.bench.scoring import aggregate


def record(method="chronogs", seed=0, *, psnr=(20.0, 30.0), ssim=None, **changes):
    """A run of one test view per period."""
    values = {"psnr": psnr} | ({"ssim": ssim} if ssim else {})
    mean = {name: sum(v) / len(v) for name, v in values.items()}
    fields = {
        "method": method,
        "strategy": "joint",
        "scene": "plaza",
        "seed": seed,
        "aggregates": {
            "macro": mean,
            "micro": dict(mean),
            "worst": {name: min(v) for name, v in values.items()},
        },
        "periods": {str(i): {name: v[i] for name, v in values.items()} for i in range(len(psnr))},
        "seconds": 10.0,
        "iterations": 100,
        "primitives": 5000,
        "checkpoint_bytes": 1_234_000,
        "peak_memory_bytes": 400_000_000,
        "device": "cpu (Test, 2 threads)",
        "commit": "abc",
        "skipped": {"lpips_vgg": "no weights"},
        "title": method.upper(),
        "preset": "fast",
        "method_version": "1",
        "config_hash": f"hash-of-{method}",
        "scene_hash": "s",
        "split_hash": "p",
        "period_labels": {"0": "May_2016 & before", "1": "1"},
        "parameters": 1,
        "warmup_seconds": 0.0,
        "setup_seconds": 0.0,
        "render_seconds": 0.0,
        "peak_device_memory_bytes": None,
        "threads": 2,
        "max_width": 1600,
        "libraries": {},
        "started": "2026-01-01T00:00:00+00:00",
        "notices": [],
    }
    return RunRecord(**{**fields, **changes})


def scored(method="chronogs", seed=0, *, psnr, **changes):
    """A run with the PSNR of each view, by period. [P][N]"""
    rows = [
        Row(f"{i}/view{k}.png", i, i, "all", "psnr", float(value))
        for i, values in enumerate(psnr)
        for k, value in enumerate(values)
    ]
    aggregates, periods = aggregate(rows)
    own = {"rows": rows, "aggregates": aggregates, "periods": periods}
    return record(method, seed, **own | changes)


def smooth(rng, shape, correlation=0.3):
    """Standard normal values, each correlated with the one before on the last axis."""
    values = rng.standard_normal(shape)
    for i in range(1, shape[-1]):
        own = np.sqrt(1 - correlation**2) * values[..., i]
        values[..., i] = correlation * values[..., i - 1] + own
    return values
