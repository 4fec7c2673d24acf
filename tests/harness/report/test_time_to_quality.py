"""Readings of curves: closed forms, nothing beyond the last probe, seeds and scenes averaged."""

import math

import numpy as np
import pytest
from made_runs import record

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.records import CURVE_FILE, CurvePoint, run_folders
from chronoscene.harness.report.tables import ALL_SCENES
from chronoscene.harness.report.time_to_quality import (
    MAX_LEVELS,
    curve_values,
    in_time,
    psnr_after,
    psnr_levels,
    read_curve,
    seconds_until,
    time_tables,
    whole_curve,
)

CURVE = np.array([[2.0, 4.0, 8.0, 16.0], [10.0, 20.0, 19.0, 23.0]])
BETTER = CURVE + np.array([[0.0], [2.0]])


def values(found, quantity, scene="plaza"):
    """Label and place asked for, to mean, spread and number of seeds."""
    return {
        (r.label, r.at): (r.mean, r.sd, r.n)
        for r in found.itertuples()
        if (r.quantity, r.scene) == (quantity, scene)
    }


def test_psnr_is_linear_between_probes_and_unknown_beyond():
    assert [psnr_after(CURVE, t) for t in (2, 3, 6, 16)] == [10, 15, 19.5, 23]
    assert math.isnan(psnr_after(CURVE, 1.9)) and math.isnan(psnr_after(CURVE, 16.1))


def test_a_level_is_reached_when_it_is_reached_first():
    assert [seconds_until(CURVE, level) for level in (15, 20, 21)] == [3, 4, 12]
    assert seconds_until(CURVE, 5) == 2, "the first probe has it"
    assert math.isnan(seconds_until(CURVE, 23.1))


def test_models_count_as_if_trained_by_turns():
    points = [
        CurvePoint(seconds, 1, 1, psnr, 1, model)
        for model, curve in (("period-0", [(1, 10), (2, 20)]), ("period-1", [(3, 30), (6, 31)]))
        for seconds, psnr in curve
    ]
    assert whole_curve(points, "separate").tolist() == [[4, 8], [20, 25.5]]
    assert whole_curve(points, "sequential") is None, "each stage probes other views"
    unseen = [CurvePoint(s, 1, 1, math.nan, 1, "period-2") for s in (5, 9)]
    found = whole_curve([*points, *unseen], "separate")
    assert found.tolist() == [[9, 17], [20, 25.5]], "a period without test views takes time, too"
    assert whole_curve(unseen, "separate") is None
    assert whole_curve(points[:3], "separate") is None
    assert whole_curve([], "joint") is None
    assert whole_curve([CurvePoint(1, 1, 1, math.nan, 1, "all")], "joint") is None


def test_readings_of_seeds():
    runs = [record(seed=0), record(seed=1)]
    found = curve_values(runs, [CURVE, BETTER])
    name, sd = "CHRONOGS (joint, fast)", pytest.approx(2**0.5)
    after = values(found, "psnr")
    assert after[name, 5.0] == (20.75, sd, 2)
    assert {at for _, at in after} == {2.0, 5.0, 10.0}, "no value before or after the probes"
    assert values(found, "psnr_end") == {(name, None): (24.0, sd, 2)}
    assert values(found, "seconds_end") == {(name, None): (16.0, 0.0, 2)}
    assert values(found, "gain") == {(name, None): (4.0, 0.0, 2)}
    assert (name, 25.0) not in values(found, "seconds"), "one seed never has 25 dB"


def test_devices_are_apart_and_scenes_averaged():
    quay = {"scene": "quay", "scene_hash": "q"}
    runs = [record("a"), record("a", **quay), record("b"), record("a", seed=1, device="other")]
    found = curve_values(runs, [CURVE, BETTER, CURVE, CURVE])
    assert values(found, "psnr_end", ALL_SCENES) == {("A (joint, fast)", None): (24.0, None, 1)}
    assert {*found[found.scene == ALL_SCENES].device} == {runs[0].device}
    assert (found.n == 1).all()
    titles = [table.title for table in time_tables(found)]
    assert len(titles) == 8 and titles[-1].startswith("plaza: ") and titles[-1].endswith("other")


def test_tables_leave_out_what_is_not_known():
    short = CURVE[:, :2]
    after, until = time_tables(curve_values([record("a"), record("b")], [CURVE, short]))
    assert after.flat_heads == [
        *("method", "2 s", "5 s", "10 s", "at the end", "training [s]", "gain of the second half")
    ]
    assert list(after.rows) == [
        ["A (joint, fast)", "10.00", "19.75", "20.00", "23.00", "16.0", "4.00"],
        ["B (joint, fast)", "10.00", "", "", "20.00", "4.0", "10.00"],
    ]
    assert until.rows[1][-1] == "" and until.flat_heads[-1] == "23 dB"


def test_levels_are_whole_and_few():
    assert psnr_levels([np.array([[1, 2], [19.5, 22.5]])]) == [20, 21, 22]
    levels = psnr_levels([np.array([[1, 2], [10.0, 40.0]])])
    assert len(levels) <= MAX_LEVELS and levels[-1] == 40 and levels[0] > 9
    assert curve_values([record()], [None]).empty


def test_curves_of_runs_are_read(bench_here, tmp_path):
    bench_here("toy_methods:MEAN")
    (folder,) = run_folders(tmp_path / "runs")
    curve = whole_curve(read_curve(folder), "joint")
    assert curve.shape == (2, 8) and (np.diff(curve[0]) > 0).all()
    (folder / CURVE_FILE).write_text("seconds\nsoon\n")
    with pytest.raises(CheckpointError, match=r"curve.csv: expected the curve of a run"):
        read_curve(folder)
    (folder / CURVE_FILE).unlink()
    assert read_curve(folder) == []


def test_times_in_words():
    assert list(map(in_time, (5, 30, 60, 300, 3600, 86400))) == [
        *("5 s", "30 s", "1 min", "5 min", "1 h", "24 h")
    ]
