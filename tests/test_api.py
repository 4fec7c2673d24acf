"""The public interface, by the blocks of its guide and by wrong input."""

from __future__ import annotations

import ast
import math
import re
import shutil
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from fresh_process import loaded_by

import chronoscene as cs
from chronoscene import api
from chronoscene.harness.files.records import ROW_COLUMNS, RUN_COLUMNS
from chronoscene.rasterizer import rasterize
from chronoscene.training.spherical_harmonics import basis

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs/guides/python-api.md"
TESTS = ["a/0002.png", "b/0003.png"]


def test_import_is_light():
    """torch, Numba and pandas take seconds; the version needs none of them."""
    heavy = {"torch", "numba", "pandas", "numpy"}
    assert not loaded_by("import chronoscene; chronoscene.__version__") & heavy


def test_names_are_those_of_the_api():
    """The lazy names, those for type checkers and those of the module agree."""
    assert sorted(api.__all__) == sorted(cs.__all__)
    tree = ast.parse((ROOT / "chronoscene/__init__.py").read_text())
    (branch,) = (node for node in tree.body if isinstance(node, ast.If))
    assert sorted(alias.name for alias in branch.body[0].names) == sorted(cs.__all__)
    for name in cs.__all__:
        assert getattr(cs, name) is getattr(api, name)
        assert name in dir(cs)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        cs.nothing  # noqa: B018


def test_no_name_is_that_of_a_package():
    """Importing a package replaces the attribute of its name."""
    packages = {path.stem for path in (ROOT / "chronoscene").iterdir()}
    assert packages.isdisjoint(cs.__all__)


@pytest.fixture
def in_folder(make_scene_folder, tmp_path, monkeypatch):
    """The scene of the guide, in the place where the guide has it."""
    folder = make_scene_folder(name="data/plaza", tests=TESTS)
    monkeypatch.chdir(tmp_path)
    return folder


def test_the_blocks_of_the_guide_run(in_folder, capsys, runs_here):
    text = GUIDE.read_text()
    assert "iterations=1000" in text
    blocks = re.findall(r"```python\n(.*?)```", text.replace("=1000", "=6"), re.DOTALL)
    assert len(blocks) == 10
    names = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"block {number} of {GUIDE.name}", "exec"), names)
    said = capsys.readouterr().out
    assert "plaza 2 4 30" in said
    assert "valid" in said and "errors" not in said
    assert "period 7: expected one from 0 to 1" in said
    assert len(names["result"].runs) == 2 and not names["result"].failures
    assert set(names["table"].quantity) >= {"psnr", "ssim"}
    assert names["image"].shape == (240, 320, 3)
    assert list(names["errors"]) == [0, 1]
    assert_gaussians_are_in_the_world(names["run"], names["scene"], names["tensors"])
    assert_views_are_those_that_were_scored(names["run"], names["views"])


def assert_gaussians_are_in_the_world(run, scene, tensors):
    """Drawn with the poses of the scene, they give the picture of the model."""
    import torch

    frame = scene.select(split="train", period=0)[0]
    pose, K = (
        torch.tensor(m, dtype=torch.float32)[None] for m in (frame.cam_from_world, frame.camera.K)
    )
    centre = -frame.cam_from_world[:3, :3].T @ frame.cam_from_world[:3, 3]
    directions = tensors["means"] - torch.tensor(centre, dtype=torch.float32)
    values = basis(torch.nn.functional.normalize(directions), 3)
    colors = ((values[..., None] * tensors["sh_coeffs"]).sum(1) + 0.5).clamp_min(0)
    shape = [tensors[name] for name in ("means", "quats", "scales", "opacities")]
    raster = rasterize(
        *shape, colors, pose, K, *frame.camera.size, antialiased=run.config.antialiased
    )
    own = run.render(frame.camera, frame.cam_from_world, 0).rgb
    assert np.abs(raster.image[0].numpy() - own).mean() < 0.02
    assert own.std() > 0.01


def assert_views_are_those_that_were_scored(run, rows):
    """PSNR computed from the arrays is that of the table."""
    rows = rows[(rows.metric == "psnr") & (rows.method == run.record.method)]
    scored = rows.set_index("view").value
    for view in run.test_views():
        error = np.mean((view.prediction.astype(float) - view.truth) ** 2)
        assert -10 * np.log10(error) == pytest.approx(scored[view.name], abs=1e-4)
    assert sorted(scored.index) == sorted(TESTS)


def test_statistics_of_a_folder_and_of_a_scene(in_folder):
    ours = cs.stats("data/plaza", count="seen")
    assert list(ours.periods.images) == [2, 2] and ours.whole["images"] == 4
    assert list(ours.periods.points) == list(ours.periods.points_seen)
    assert ours.overlap.shape == ours.in_view.shape == (2, 2)
    with pytest.raises(cs.ChronoSceneError, match="count: expected"):
        cs.stats(in_folder, count="all")


def test_validate_wants_one_scene(in_folder):
    assert cs.validate(in_folder, select=["CS3"]).is_valid
    (in_folder / "images" / TESTS[0]).unlink()
    report = cs.validate(in_folder)
    assert not report.is_valid and report.count("error")
    shutil.copytree(in_folder, in_folder.with_name("other"))
    with pytest.raises(cs.ChronoSceneError, match="a folder of 2 scenes"):
        cs.validate(in_folder.parent)
    with pytest.raises(cs.ChronoSceneError, match="found nothing"):
        cs.validate("nowhere")
    with pytest.raises(cs.ChronoSceneError, match="CS999"):
        cs.validate(in_folder, select=["CS999"])
    assert cs.validate(in_folder, select="CS3").is_valid


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"methods": "4gs"}, "expected one of"),
        ({"strategies": "alone"}, "strategy: expected"),
        ({"budget": "soon"}, "budget: expected a positive time"),
        ({"budget": 0}, "--budget: expected a positive number of seconds, found 0;"),
        ({"budget": -5.0}, "--budget: expected a positive number of seconds, found -5.0;"),
        ({"budget": math.nan}, "--budget: expected a positive number of seconds, found nan;"),
        ({"budget": f"{10**400}h"}, "--budget: expected a positive number of seconds, found inf;"),
        ({"seeds": (0, -1)}, r"--seed: expected seeds from 0 to 2\^64 - 1, found -1;"),
        ({"seeds": (2**64,)}, "--seed: expected seeds from 0 to .*, found 18446744073709551616;"),
        ({"seeds": (1.5,)}, r"--seed: expected seeds from 0 to 2\^64 - 1, found 1.5;"),
        ({"seeds": (True,)}, r"--seed: expected seeds from 0 to 2\^64 - 1, found True;"),
        ({"budget": timedelta(0, 3)}, "--budget: expected a positive number of seconds, found 0:0"),
        ({"overrides": {"size": date(2020, 1, 1)}}, "value of an option: expected .*, found dat"),
        ({"seeds": 3}, r"seeds: expected seeds such as \[0\] or range\(3\), found 3;"),
        ({"seeds": "0"}, r"seeds: expected seeds such as \[0\] or range\(3\), found '0';"),
        ({"seeds": ()}, "seeds: expected at least one, found none;"),
        ({"methods": []}, "methods: expected at least one, found none;"),
        ({"scenes": []}, "scenes: expected at least one, found none;"),
        ({"max_width": 0}, "--max-width: expected a whole number of 1 or more, found 0;"),
        ({"threads": -1}, "--threads: expected a whole number of 1 or more, found -1;"),
        ({"threads": 1.5}, "--threads: expected a whole number of 1 or more, found 1.5;"),
        ({"jobs": 0}, "--jobs: expected a whole number of 1 or more, found 0;"),
        ({"preset": "quick"}, "--preset"),
        ({"overrides": {"chronogs.size": 3}}, "--set"),
        ({"scenes": "nowhere"}, "nowhere: expected"),
        ({"out": "data/plaza/runs"}, "--out data/plaza/runs: expected a place outside the scene"),
        ({"out": "data"}, "--out .*data: expected a folder without the scene"),
    ],
)
def test_bench_refuses_before_it_trains(in_folder, wrong, message):
    right = {"scenes": "data/plaza", "methods": "chronogs", "out": "runs"}
    with pytest.raises(cs.ChronoSceneError, match=message):
        cs.bench(**right | wrong)
    assert not list(Path().glob("runs/plaza/*"))


def test_bench_wants_folders_and_says_so_of_a_scene(in_folder):
    with pytest.raises(cs.ChronoSceneError, match="scenes: expected folders, found a Scene; name "):
        cs.bench(cs.read_scene(in_folder), "chronogs", out="runs")


def test_rows_keep_names_of_digits_and_have_their_columns_without_runs(tmp_path):
    """pandas would read the scene 007 as 7, and an empty variant as not a number."""
    columns = [*RUN_COLUMNS, *ROW_COLUMNS]
    line = dict.fromkeys(columns, "") | {"scene": "007", "view": "NA", "value": "inf"}
    line |= dict.fromkeys(("seed", "camera_period", "rendered_period"), "2")
    text = f"{','.join(columns)}\n{','.join(line.values())}\n"
    (tmp_path / "rows.csv").write_text(text)
    rows = cs.BenchmarkResult((tmp_path,), ()).rows()
    assert rows.loc[0, ["scene", "view", "variant", "seed", "value"]].tolist() == [
        *("007", "NA", "", 2, math.inf)
    ]
    assert [*cs.BenchmarkResult((), ()).rows()] == [*rows] == columns
