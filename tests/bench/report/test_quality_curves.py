"""Curves lie where their values are, one per model."""

import pytest
from made_runs import record

from chronoscene.bench.files.records import CURVE_FILE
from chronoscene.bench.report.quality_curves import COLORS, DASHES, HEIGHT, LEFT, WIDTH, draw_curves

HEADER = "seconds,iteration,primitives,psnr,parameters,model\n"


def run(folder, text, **changes):
    folder.mkdir()
    (folder / CURVE_FILE).write_text(HEADER + text)
    return record(folder=folder, **changes)


def test_points_lie_on_the_scales_of_the_axes(tmp_path):
    joint = run(tmp_path / "a", "5,1,1,20,1,all\n10,2,1,24,1,all\n", method="a")
    parts = "2,1,1,21,1,period-0\n4,1,1,nan,1,period-0\n3,1,1,inf,1,period-1\n3,1,1,22,1,period-2\n"
    separate = run(tmp_path / "b", parts, method="b", strategy="separate")
    curves = draw_curves([joint, separate, record(folder=tmp_path)])
    x, y = (
        {float(text): place for place, text in ticks} for ticks in (curves.x_ticks, curves.y_ticks)
    )
    first, *others = curves.lines
    assert [spot[:2] for spot in first.points] == [
        (x[5] if 5 in x else pytest.approx((x[4] + x[6]) / 2), y[20]),
        (x[10], y[24]),
    ]
    assert first.points[0][2] == "A (joint, fast): 20.00 dB at 5.0 s"
    assert [line.points[0][2] for line in others] == [
        "B (separate, fast), period-0: 21.00 dB at 2.0 s",
        "B (separate, fast), period-2: 22.00 dB at 3.0 s",
    ]
    assert len(others[0].points) == 1  # values that are not finite are nowhere
    assert curves.methods == {
        "A (joint, fast)": (COLORS[0], ""),
        "B (separate, fast)": (COLORS[1], ""),
    }
    assert x[0] == LEFT and max(x.values()) < WIDTH and y[24] < y[20] < HEIGHT


def test_more_methods_than_colors_have_dashes(tmp_path):
    names = [f"m{i}" for i in range(len(COLORS) + 1)]
    found = [run(tmp_path / name, "5,1,1,20,1,all\n", method=name) for name in names]
    keys = [*draw_curves(found).methods.values()]
    assert len({*keys}) == len(keys) and keys[-1] == (COLORS[0], DASHES[1])


def test_runs_of_other_programs_have_none(tmp_path):
    assert draw_curves([record(folder=tmp_path)]) is None
