"""The heat map of runs in stages."""

import numpy as np
from PIL import Image

from chronoscene.figures import canvas
from chronoscene.harness.files.records import read_rows, read_run, run_folders, write_run
from chronoscene.harness.report.figures.stage import draw_stages
from chronoscene.harness.report.summary import read_runs


def test_runs_in_stages_are_drawn_and_no_others(bench_here, tmp_path):
    runs = tmp_path / "runs"
    bench_here("toy_methods:MEAN")
    assert draw_stages(runs, read_runs([runs])[0]) == []
    bench_here("toy_methods:MEAN", "toy_methods:BLIND", strategies=("sequential",), seeds=(0, 1))
    assert draw_stages(runs, read_runs([runs])[0]) == [runs / "figures/ring_stages.png"]
    pixels = np.array(Image.open(runs / "figures/ring_stages.png").convert("RGB")).reshape(-1, 3)
    assert len(pixels) > 10_000
    assert (pixels == [255, 0, 0]).all(axis=1).any(), "the line around what was seen"


def test_stages_without_test_views_have_no_figure(bench_here, tmp_path):
    bench_here("toy_methods:MEAN", strategies=("sequential",))
    (run,) = read_runs([tmp_path / "runs"])[0]
    kinds = {kind: {} for kind in run.aggregates}
    empty = {"aggregates": kinds, "periods": {}, "stages": {name: {} for name in run.stages}}
    assert draw_stages(tmp_path / "runs", [run.model_copy(update=empty)]) == []


def test_names_are_no_formulas(bench_here, tmp_path):
    bench_here("toy_methods:MEAN", strategies=("sequential",))
    (run,) = read_runs([tmp_path / "runs"])[0]
    names = {"scene": "$_$", "title": "$_$", "period_labels": {"0": "$_$", "1": "1"}}
    (path,) = draw_stages(tmp_path / "runs", [run.model_copy(update=names)])
    assert path.stat().st_size > 1_000


def test_infinite_scores_of_all_stages_are_drawn(bench_here, tmp_path):
    bench_here("toy_methods:MEAN", strategies=("sequential",))
    (run,) = read_runs([tmp_path / "runs"])[0]
    stages = {
        name: {i: dict.fromkeys(values, float("inf")) for i, values in periods.items()}
        for name, periods in run.stages.items()
    }
    (path,) = draw_stages(tmp_path / "runs", [run.model_copy(update={"stages": stages})])
    assert path.stat().st_size > 1_000


def test_methods_with_one_title_have_a_map_each(bench_here, tmp_path, monkeypatch):
    bench_here("toy_methods:MEAN", "toy_methods:TUNED", strategies=("sequential",))
    runs, drawn = tmp_path / "runs", []
    for folder in run_folders(runs):
        run = read_run(folder).model_copy(update={"title": "Toy"})
        write_run(folder, run, read_rows(folder))
    monkeypatch.setattr(canvas, "save", lambda figure, *_, **__: drawn.append(figure))
    draw_stages(runs, read_runs([runs])[0])
    titles = [axes.get_title() for axes in drawn[0].axes if axes.get_title().endswith("PSNR [dB]")]
    assert [title.partition("\n")[0] for title in titles] == ["Toy [mean]", "Toy [tuned]"]
