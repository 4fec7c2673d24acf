"""Fronts by hand, devices apart, means over common scenes, and the configuration for limits."""

import numpy as np
import pytest
from made_runs import record

from chronoscene.errors import ConfigError
from chronoscene.harness.report.tables import ALL_SCENES
from chronoscene.harness.report.tradeoff import (
    Limits,
    as_configurations,
    choose,
    front_points,
    front_tables,
    on_front,
)

OTHER = "cuda (Test)"


def run(method, psnr, seconds, size=1_000_000, seed=0, **changes):
    costs = {"seconds": seconds, "checkpoint_bytes": size, "render_seconds": 0.1}
    return record(method, seed, psnr=(psnr,), **costs | changes)


RUNS = [run("quick", 20.0, 5.0), run("slow", 25.0, 50.0, 9_000_000), run("bad", 19.0, 60.0)]


def on(points, cost, scene="plaza", device=None):
    """Labels on the front of PSNR in one panel, the cheapest first."""
    return [
        p.method
        for p in points.itertuples()
        if (p.cost, p.metric, p.scene) == (cost, "psnr", scene)
        and p.on_front
        and device in (None, p.device)
    ]


def test_a_front_is_what_nothing_else_beats():
    costs, quality = np.array([1.0, 2, 2, 3, 4]), np.array([10.0, 12, 11, 12, 13])
    assert on_front(costs, quality).tolist() == [True, True, False, False, True]
    twins = on_front(np.array([1.0, 1.0]), np.array([2.0, 2.0]))
    assert twins.all(), "equal points do not beat each other"


def test_fronts_of_runs():
    points = front_points(RUNS)
    assert on(points, "seconds") == on(points, "checkpoint_bytes") == ["quick", "slow"]
    assert on(points, "render_seconds") == ["slow"]
    assert {*points[points.device != ""].cost} == {"seconds", "render_seconds"}


def test_where_less_is_better_the_front_turns():
    runs = [run("a", 20.0, 5.0), run("b", 20.0, 50.0)]
    for r, value in zip(runs, (0.5, 0.25), strict=True):
        for values in (*r.aggregates.values(), *r.periods.values()):
            values["lpips_vgg_3dgs"] = value
    fronts = front_points(runs).query("cost == 'seconds'").groupby("metric").on_front
    assert fronts.agg(list).to_dict() == {"lpips_vgg_3dgs": [True, True], "psnr": [True, False]}


def test_seeds_are_averaged():
    seeds = [run("m", 20.0, 10.0), run("m", 22.0, 14.0, seed=1)]
    (point,) = front_points(seeds).query("cost == 'seconds'").itertuples()
    assert (point.quality, point.value, point.n) == (21.0, 12.0, 2)
    assert point.quality_sd == pytest.approx(2**0.5) and point.value_sd == pytest.approx(8**0.5)
    assert front_points(RUNS).quality_sd[0] is None


def test_times_of_devices_are_not_compared_but_sizes_are():
    runs = [run("cpu", 20.0, 50.0), run("gpu", 25.0, 5.0, device=OTHER)]
    points = front_points(runs)
    assert on(points, "seconds", device=OTHER) == ["gpu"]
    assert on(points, "seconds", device=runs[0].device) == ["cpu"]
    assert on(points, "checkpoint_bytes") == ["gpu"]


def test_the_mean_over_scenes_has_what_ran_on_all():
    quay = {"scene": "quay", "scene_hash": "q"}
    runs = [*RUNS[:2], run("quick", 24.0, 7.0, **quay), run("bad", 30.0, 1.0, **quay)]
    found = front_points(runs).query("scene == @ALL_SCENES and cost == 'seconds'")
    assert found[["method", "quality", "value"]].to_numpy().tolist() == [["quick", 22.0, 6.0]]
    assert ALL_SCENES not in {*front_points(RUNS).scene}


def test_the_table_has_the_front_alone():
    table = front_tables(front_points(RUNS))[0]
    assert table.title == "plaza: Pareto fronts of PSNR [dB] (psnr)"
    assert list(table.rows)[:2] == [
        ["training [s] on cpu (Test, 2 threads)", "QUICK (joint, fast)", "5.0", "20.00"],
        ["", "SLOW (joint, fast)", "50.0", "25.00"],
    ]
    assert "BAD" not in str(table.rows)


@pytest.mark.parametrize(
    ("limits", "method"),
    [
        (Limits(seconds=49.0), "slow"),  # 50 s are within 5 %
        (Limits(seconds=47.0), "quick"),
        (Limits(size=2e6), "quick"),
        (Limits(psnr=19.5), "quick"),
        (Limits(psnr=24.0), "slow"),
        (Limits(psnr=19.0, size=1e7), "quick"),
    ],
)
def test_the_configuration_for_limits(limits, method):
    (sentence,) = choose(RUNS, limits, "--what was-typed")
    assert sentence.startswith(f"plaza, cpu (Test, 2 threads): {method.upper()} (joint, fast) ")
    assert sentence.endswith("bench DIR --method module:SPEC --strategy joint --preset fast")


def test_a_training_may_exceed_a_time_by_its_last_step():
    slow = [run("m", 20.0, 90.0, iterations=2)]
    assert "M (joint, fast)" in choose(slow, Limits(seconds=60.0), "--budget 1m")[0]
    with pytest.raises(ConfigError, match="nearest: M"):
        choose(slow, Limits(seconds=30.0), "--budget 30s")


def test_a_training_is_not_cheaper_for_ending_its_budget_a_step_earlier():
    runs = [run("worse", 20.0, 60.0, 10**6), run("better", 25.0, 60.1, 9 * 10**6)]
    assert on(front_points(runs), "seconds") == ["better"]
    assert on(front_points(runs), "checkpoint_bytes") == ["worse", "better"]
    alike = [run("big", 20.001, 60.04, 2_000_000), run("small", 20.0, 60.06)]
    assert "SMALL" in choose(alike, Limits(seconds=60.0), "--budget 1m")[0]
    twins = [run("worse", 20.0, 60.04), run("better", 20.004, 60.06)]
    assert "BETTER" in choose(twins, Limits(seconds=60.0), "--budget 1m")[0]


def test_what_reads_alike_is_chosen_by_the_rest():
    runs = [run("dear", 20.001, 50.0), run("big", 20.0, 5.0, 2_000_000), run("small", 20.0, 5.0)]
    assert "SMALL" in choose(runs, Limits(seconds=60.0), "--budget 1m")[0]
    runs.append(run("better", 21.0, 5.01))
    assert "BETTER" in choose(runs, Limits(psnr=19.0), "--target-psnr 19")[0]
    with pytest.raises(ConfigError, match="nearest: BETTER"):  # a few ms further from the limit
        choose(runs, Limits(seconds=4.0), "--budget 4s")


def test_the_sentence_says_what_it_reaches_and_costs():
    seeds = [run("m", 20.0, 10.0), run("m", 22.0, 14.0, seed=1)]
    (sentence,) = choose(seeds, Limits(psnr=20.0), "--target-psnr 20")
    assert "reaches 21.00 ± 1.41 dB after 12.0 ± 2.8 s of training" in sentence
    assert "with a model of 1.0 MB" in sentence


def test_where_nothing_fits_the_nearest_is_named():
    with pytest.raises(ConfigError, match=r"--target-psnr 27: .* nearest: SLOW .*25.00 dB"):
        choose(RUNS, Limits(psnr=27.0), "--target-psnr 27")
    with pytest.raises(ConfigError, match="nearest: QUICK"):
        choose(RUNS, Limits(seconds=1.0), "--budget 1s")
    quay = run("slow", 20.0, 5.0, scene="quay", scene_hash="q")
    found = choose([*RUNS, quay], Limits(psnr=24.0), "--target-psnr 24")
    assert [line.split(",")[0] for line in found] == ["plaza", "quay", ALL_SCENES]
    assert "quay, cpu (Test, 2 threads): nothing fits --target-psnr 24; nearest: SLOW" in found[1]
    untrained = [run("foreign", 20.0, None)]
    with pytest.raises(ConfigError, match="found no run that was trained"):
        choose(untrained, Limits(psnr=1.0), "--target-psnr 1")


def test_unusual_widths_are_named():
    wide, narrow = as_configurations([run("m", 1.0, 1.0), run("m", 1.0, 1.0, max_width=800)])
    assert (wide.variant, narrow.variant) == ("", "max_width=800")
