"""Runs that nobody trained, for tests of what is made of runs."""

from pathlib import Path
from zlib import crc32

import numpy as np

from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter
from chronoscene.harness.files.records import PREDICTIONS, RunRecord, ViewScore, write_run
from chronoscene.harness.score.scoring import aggregate


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


def rows_of(run):
    """Rows that a run of one test view per period has."""
    whole = {"periods": run.periods}
    return [
        ViewScore(f"{i}.png", int(i), int(i), region, metric, value)
        for region, part in {"all": whole, **run.regions}.items()
        for i, values in part["periods"].items()
        for metric, value in values.items()
    ]


def scored(method="chronogs", seed=0, *, psnr, **changes):
    """A run with the PSNR of each view, by period. [P][N]"""
    rows = [
        ViewScore(f"{i}/view{k}.png", i, i, "all", "psnr", float(value))
        for i, values in enumerate(psnr)
        for k, value in enumerate(values)
    ]
    aggregates, periods = aggregate(rows)
    own = {"rows": rows, "aggregates": aggregates, "periods": periods}
    return record(method, seed, **own | changes)


def write_scored(
    runs: Path, method="3dgs", seed=0, *, psnr=((20.0, 21.0, 22.0), (24.0, 25.0, 26.0)), **changes
) -> Path:
    """A folder of such a run, with predictions and ground truth of noise."""
    hashes = {"scene_hash": "a" * 64, "split_hash": "b" * 64}
    hashes["config_hash"] = format(crc32(method.encode()), "064x")
    run = scored(method, seed, psnr=psnr, **hashes | changes)
    folder = runs / run.scene / f"{method}-joint-fast" / f"seed{seed}"
    places = {"ground truth": ground_truth_folder(runs, run.scene)}
    places["predictions"] = folder / PREDICTIONS
    for kind, place in places.items():
        if kind == "ground truth" and place.exists():
            continue
        rng = np.random.default_rng(crc32(f"{kind} {method} {seed}".encode()))
        writer = ImageWriter(place)
        for row in run.rows:
            pixels = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
            period = row.camera_period
            writer.add(row.view, pixels, camera_period=period, rendered_period=period)
        details = {"max_width": run.max_width}
        writer.close(kind=kind, scene=run.scene, scene_hash=hashes["scene_hash"], details=details)
    write_run(folder, run, run.rows)
    return folder


def smooth(rng, shape, correlation=0.3):
    """Standard normal values, each correlated with the one before on the last axis."""
    values = rng.standard_normal(shape)
    for i in range(1, shape[-1]):
        own = np.sqrt(1 - correlation**2) * values[..., i]
        values[..., i] = correlation * values[..., i - 1] + own
    return values
