"""``chronoscene compare``: table, figures, page."""

import csv
from functools import partial
from shutil import rmtree

import numpy as np
import pytest
from command_line import succeed
from made_runs import scored, write_scored

from chronoscene.errors import ChronoSceneError
from chronoscene.harness.files.predictions import ImageWriter, safe_name
from chronoscene.harness.files.records import PREDICTIONS, Failure, write_failure


@pytest.fixture
def runs(tmp_path):
    """One run of two test views in one period, without ``curve.csv``."""
    write_scored(tmp_path / "runs", "chronogs", psnr=[[20.0, 10.0]])
    return tmp_path / "runs"


compare = partial(succeed, "compare")


def test_the_worst_views_are_printed_and_figures_drawn(runs, tmp_path):
    page = tmp_path / "page.html"
    result = compare(runs, "--html", page)
    assert result.stdout.index("0/view1.png") < result.stdout.index("0/view0.png")
    assert "10.00" in result.stdout and "plaza: PSNR [dB] (psnr)" in result.stdout
    figures = [runs / "figures" / f"plaza_{name}.png" for name in ("comparison", "errors")]
    written = [line for line in result.stderr.splitlines() if line.startswith("wrote ")]
    assert written == [f"wrote {path}" for path in (*figures, page)]
    text = page.read_text()
    assert text.startswith("<!doctype html>") and text.count('class="slider"') == 2
    assert "training time" not in text


def test_runs_of_another_width_have_no_pictures(tmp_path):
    runs = tmp_path / "runs"
    write_scored(runs, "3dgs")
    folder = write_scored(runs, "4dgs", max_width=4)
    rmtree(folder / PREDICTIONS)
    writer = ImageWriter(folder / PREDICTIONS)
    for row in scored(psnr=((1.0,) * 3,) * 2).rows:
        pixels, period = np.zeros((3, 4, 3), np.uint8), row.camera_period
        writer.add(row.view, pixels, camera_period=period, rendered_period=period)
    writer.close(kind="predictions", scene="plaza", scene_hash="a" * 64, details={})
    result = compare(runs, "--html", tmp_path / "page.html")
    assert "plaza [width 4]: no pictures" in result.stderr
    figures = [f"plaza [width 1600]_{name}.png" for name in ("comparison", "errors")]
    assert sorted(p.name for p in (runs / "figures").iterdir()) == [*map(safe_name, figures)]
    assert "are not compared, and stand apart" in (tmp_path / "page.html").read_text()


def test_csv_has_every_view_and_more_views_make_more_rows(runs, tmp_path):
    table, figure = tmp_path / "table.csv", runs / "figures/plaza_comparison.png"
    compare(runs, "--format", "csv", "--out", table)
    small = figure.stat().st_size
    rows = list(csv.DictReader(table.open()))
    assert [row["view"] for row in rows] == ["0/view1.png", "0/view0.png"]
    assert rows[0]["CHRONOGS (joint, fast)"] == "10.0" and rows[0]["period"] == "0"
    compare(runs, "--views", 2)
    assert figure.stat().st_size > small


@pytest.mark.parametrize("metric", ["ssim", "nonsense"])
def test_a_metric_that_is_not_there(runs, metric):
    with pytest.raises(ChronoSceneError, match=metric):
        compare(runs, "--metric", metric)
    assert not (runs / "figures").exists()


@pytest.mark.parametrize("options", [(), ("--periods", "0:1")])
def test_a_folder_with_failures_alone(tmp_path, options):
    folder = tmp_path / "runs/plaza/m-joint-fast/seed0"
    folder.mkdir(parents=True)
    names = {"method": "m", "strategy": "joint", "preset": "fast", "scene": "plaza", "seed": 0}
    write_failure(folder, Failure(**names, reason="no memory"))
    with pytest.raises(ChronoSceneError, match="finished run, found runs that failed: no memory"):
        compare(tmp_path / "runs", *options)


def test_names_are_no_formulas(tmp_path):
    runs = tmp_path / "runs"
    labels = {"0": "$_$", "1": "1"}
    write_scored(runs, scene="lot $5_ and $6^", title="A$_$B", period_labels=labels)
    compare(runs)
    assert len([*(runs / "figures").iterdir()]) == 2
