"""Finished runs of radiance fields: every command uses them, or refuses them by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run_command
from training_here import train_here

from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.harness.view.paths import KeyView
from chronoscene.harness.view.pictures import Side, draw_picture
from chronoscene.scene import WorldFrame

SMALL = {"samples": 2_048, "levels": 4, "log2_rows": 10, "finest": 64, "hidden": 16, "cells": 16}
METHODS = {"nerf-t": "NeRF-T", "clnerf": "CLNeRF"}
USED = {
    "render": ("render", "{run}", "--out", "{out}", "--period", "0.5"),
    "appearance": (
        *("render", "{run}", "--out", "{out}", "--period", "0", "--appearance-period", "1"),
        *("--cameras", "orbit", "--frames", "2", "--size", "24x16"),
    ),
    "changes": ("changes", "{run}", "--out", "{out}"),
    "survey": ("survey", "{run}", "--out", "{out}", "--resolution", "0.2"),
    "leakage": ("leakage", "{run}", "--truth", "{truth}", "--out", "{out}"),
    "verify": ("verify", "{run}"),
    "table": ("table", "{runs}", "--out", "{out}"),
    "compare": ("compare", "{runs}", "--html", "{out}"),
    "between": ("compare", "{runs}", "--periods", "0:1"),
    "tradeoff": ("tradeoff", "{runs}", "--figures", "{out}"),
    "score": ("score", "{runs}", "--truth", "{truth}"),
    "submit": ("submit", "{run}", "--to", "{out}"),
}
"""Commands that show what a field shows; those with ``{out}`` write it."""
REFUSED = {
    "page": ("page", "{run}", "--out", "{out}"),
    "export": ("export", "{run}", "--period", "0", "--out", "{out}.ply"),
    "export all": ("export", "{run}", "--period", "all", "--to", "spz", "--out", "{out}"),
    "compress": ("compress", "{run}"),
}
"""Commands that need Gaussians."""


@pytest.fixture(scope="module")
def trained_fields(
    scene_folder: Path, made_once: Callable[..., Path], write_truth: Callable[..., Path]
) -> Path:
    """Folder with ``runs`` of a few steps and the ``truth``."""

    def fill(folder: Path) -> None:
        overrides = {name: str(value) for name, value in SMALL.items()}
        with pytest.MonkeyPatch.context() as patch:
            train_here(patch)
            settings = bench_settings(
                scenes=(scene_folder,),
                methods=tuple(METHODS),
                runs=folder / "runs",
                strategies=("joint",),
                preset="fast",
                iterations=24,
                overrides=overrides,
            )
            outcome = run_bench(settings, lambda line: None)
        assert outcome.failures == ()
        write_truth(open_run(outcome.finished[0]).scene(), folder / "truth")

    return made_once("fields", fill)


@pytest.fixture
def call(
    trained_fields: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Caller of a command about the run of a method, on a georeferenced scene."""
    read = TrainedRun.scene
    world = WorldFrame("metre", "EPSG:32632", (680_000.0, 5_152_000.0, 0.0))
    monkeypatch.setattr(TrainedRun, "scene", lambda *args: replace(read(*args), world=world))

    def run(method: str, words: tuple[str, ...]) -> Any:
        runs, out = trained_fields / "runs", tmp_path / "out"
        (folder,) = runs.glob(f"ring/{method}-*/seed0")
        places = {"run": folder, "runs": runs, "out": out, "truth": trained_fields / "truth"}
        return run_command(*(word.format(**places) for word in words))

    return run


@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param(name, method, marks=() if method == "nerf-t" else pytest.mark.slow)
        for name in USED
        for method in METHODS
    ],
)
def test_a_command_uses_a_field(
    name: str, method: str, call: Callable[..., Any], tmp_path: Path
) -> None:
    result = call(method, USED[name])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out").exists() == ("{out}" in USED[name])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", REFUSED)
def test_a_command_refuses_a_field_by_name(
    name: str, method: str, call: Callable[..., Any], tmp_path: Path
) -> None:
    result = call(method, REFUSED[name])
    assert result.exit_code == 2
    (line,) = (line for line in result.output.splitlines() if line.startswith("error: "))
    assert re.search("expected a (method|model made of Gaussians)", line)
    assert f"found {METHODS[method]}; " in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("method", METHODS)
def test_a_field_is_viewed(method: str, trained_fields: Path) -> None:
    (folder,) = trained_fields.glob(f"runs/ring/{method}-*/seed0")
    run = open_run(folder)
    assert run.record.empty_steps == run.record.skipped_steps == 0
    view = KeyView(run.scene().frames[0].cam_from_world, 0.8, 0.0)
    (rgb, depth), (other_rgb, other_depth) = (
        draw_picture(view, (24, 16), [Side(run, 0.0, appearance)], 24 * 16)
        for appearance in (None, 1.0)
    )
    assert np.isfinite(rgb).all()
    assert np.array_equal(depth, other_depth)
    assert not np.array_equal(rgb, other_rgb)
