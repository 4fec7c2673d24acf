"""Summaries of runs: means, spreads and intervals by hand, what is paired, what is averaged."""

from dataclasses import replace

import numpy as np
import pytest
from made_runs import record, scored, smooth
from scipy.special import stdtrit

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.records import ViewScore
from chronoscene.harness.report.comparable import apart
from chronoscene.harness.report.intervals import (
    degrees_of_freedom,
    interval,
    pooled_freedom,
    resampled_means,
)
from chronoscene.harness.report.published import load_published
from chronoscene.harness.report.summary import (
    in_unit,
    over_scenes,
    published_entries,
    read_runs,
    summarise,
)

RUNS = [
    record(seed=0, psnr=(20.0, 30.0), ssim=(0.5, 0.75)),
    record(seed=1, psnr=(22.0, 31.0), ssim=(0.5, 0.75)),
    record("3dgs", psnr=(10.0, 40.0), ssim=(0.25, 0.5), strategy="pooled"),
]


def test_statistics_by_hand():
    runs = [record(seed=i, psnr=(value,)) for i, value in enumerate((1.0, 2.0, 4.0))]
    (value,) = summarise(runs).query("quantity == 'psnr' and column == 'macro'").itertuples()
    assert value.mean == pytest.approx(7 / 3) and value.n == 3
    assert value.sd == pytest.approx(1.5275252316519468)
    assert value.text == "2.33 ± 1.53"
    (value,) = summarise(runs[:1]).query("quantity == 'checkpoint_bytes'").itertuples()
    assert (value.mean, value.n, value.text) == (1_234_000.0, 1, "1.234")
    runs = [record(psnr=(float("inf"),)), record(seed=1, psnr=(1.0,))]
    assert summarise(runs).text[0] == "inf ± nan"


def test_what_rounds_to_zero_has_no_sign():
    assert [in_unit("psnr", value) for value in (-0.004, -0.006, 0.0)] == ["0.00", "-0.01", "0.00"]


def test_entries_by_hand():
    found = {(e.method, e.quantity, e.column): e for e in summarise(RUNS).itertuples()}
    mine = found["chronogs", "psnr", "period 0"]
    assert (mine.mean, mine.n, mine.seeds) == (21.0, 2, "0 1")
    assert mine.sd == pytest.approx(2**0.5)
    assert found["chronogs", "psnr", "macro"].mean == 25.75
    assert found["chronogs", "psnr", "worst"].mean == 21.0
    assert found["3dgs", "psnr", "worst"].mean == 10.0 and found["3dgs", "psnr", "worst"].n == 1
    assert found["3dgs", "checkpoint_bytes", ""].mean == 1_234_000
    assert ("3dgs", "peak_device_memory_bytes", "") not in found


def test_runs_with_other_configs_stay_apart():
    other = record(config_hash="another", seed=0, psnr=(1.0, 2.0))
    assert summarise([*RUNS[:2], other]).label.unique().tolist() == [
        "CHRONOGS (joint, fast) [config hash-o]",
        "CHRONOGS (joint, fast) [config anothe]",
    ]


def test_folders_of_runs(runs, tmp_path):
    records, failures = read_runs([runs])
    assert len(records) == 4 and len(failures) == 3
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="no run in it; run bench first"):
        read_runs([runs, tmp_path / "empty"])


def macro(records):
    """PSNR, macro, by method."""
    entries = summarise(records, ["psnr"]).query("column == 'macro'")
    return {entry.method: entry for entry in entries.itertuples()}


VIEWS = 20 + 4 * smooth(np.random.default_rng(1), (2, 9))
NOISE = np.random.default_rng(2).normal(size=(2, 9))


def test_periods_are_resampled_apart_and_seeds_are_averaged():
    runs = [scored(seed=0, psnr=VIEWS), scored(seed=1, psnr=VIEWS + 1 + NOISE)]
    mean = VIEWS + 0.5 + NOISE / 2
    drawn = [
        resampled_means({f"{i}/view{k}.png": v for k, v in enumerate(mean[i])}, f"plaza/{i}")
        for i in range(2)
    ]
    found = summarise(runs, ["psnr"]).set_index("column")
    expected = {"macro": np.mean(drawn, axis=0), "micro": np.mean(drawn, axis=0)}
    expected |= {f"period {i}": means for i, means in enumerate(drawn)}
    for column, means in expected.items():
        freedom = degrees_of_freedom(9) if column.startswith("period") else pooled_freedom([9, 9])
        assert (found.low[column], found.high[column]) == pytest.approx(interval(means, freedom))
    assert found.low["worst"] < found["mean"]["worst"] < found.high["worst"]
    assert found["mean"]["best"] == pytest.approx(max(mean.mean(axis=1)))
    assert found["mean"]["median of periods"] == pytest.approx(mean.mean())


def test_a_mean_over_views_weighs_periods_by_their_views():
    few = [VIEWS[0][:3], VIEWS[1]]
    drawn = [
        resampled_means({f"{i}/view{k}.png": v for k, v in enumerate(values)}, f"plaza/{i}")
        for i, values in enumerate(few)
    ]
    found = summarise([scored(psnr=few)], ["psnr"]).set_index("column")
    for column, weights in {"macro": [1, 1], "micro": [3, 9]}.items():
        means = np.average(drawn, axis=0, weights=weights)
        expected = interval(means, pooled_freedom([3, 9], weights))
        assert (found.low[column], found.high[column]) == pytest.approx(expected)
    assert pooled_freedom([3, 9], [3, 9]) > 1.3 * pooled_freedom([3, 9])


def test_other_regions_and_other_periods_are_no_views_of_the_run():
    run = scored(psnr=VIEWS)
    rows = [*run.rows, ViewScore("0/view0.png", 0, 1, "all", "psnr", 0.0)]
    rows.append(ViewScore("0/view0.png", 0, 0, "changed", "psnr", 0.0))
    assert macro([scored(psnr=VIEWS, rows=rows)])["chronogs"].low == macro([run])["chronogs"].low


def test_differences_are_paired():
    found = macro([scored("a", psnr=VIEWS), scored("b", psnr=VIEWS - 0.5)])
    assert found["a"].low < found["b"].high  # apart, the two could not be told from each other
    mine = found["b"]
    assert (mine.difference, mine.difference_low, mine.difference_high) == pytest.approx([-0.5] * 3)
    assert not mine.tied and np.isnan(found["a"].difference)


def test_what_views_do_not_tell_apart_is_tied():
    found = macro([scored("a", psnr=VIEWS), scored("b", psnr=VIEWS - 0.1 + NOISE - NOISE.mean())])
    assert found["b"].tied and found["b"].difference == pytest.approx(-0.1)
    assert found["b"].difference_low < 0 < found["b"].difference_high


@pytest.mark.parametrize(
    ("column", "views", "shown"),
    [("period 0", 4, False), ("period 0", 5, True), ("macro", 2, False), ("macro", 3, True)],
)
def test_a_few_views_tie_without_an_interval(column, views, shown):
    some, others = VIEWS[:, :views], (VIEWS - 1 + NOISE)[:, :views]
    found = summarise([scored("a", psnr=some), scored("b", psnr=others)], ["psnr"])
    (b,) = found[(found.method == "b") & (found.column == column)].itertuples()
    assert b.tied and np.isfinite(b.difference_low) == shown


def test_what_seeds_do_not_tell_apart_is_tied():
    shifts = {"a": (0.0, 2.0), "b": (-1.0, 1.0), "c": (-29.0, -29.0)}
    runs = [scored(m, i, psnr=VIEWS + s[i]) for m, s in shifts.items() for i in range(2)]
    found = macro(runs)
    assert not macro(runs[::2])["b"].tied  # views alone tell them apart
    assert found["b"].tied and not found["c"].tied
    # Pooled variance (2 + 2 + 0) / 3, but 2 of their own; t of 3 degrees of freedom
    assert found["b"].by_seeds == pytest.approx(3.1824463 * 2**0.5)
    assert found["c"].by_seeds == pytest.approx(3.1824463 * (2 / 2 + 4 / 3 / 2) ** 0.5)


def test_a_second_seed_does_not_tie_what_the_first_told_apart():
    rng = np.random.default_rng(3)
    means = dict(zip("abcdefgh", 0.5 * np.arange(8), strict=True))
    runs = [
        scored(m, seed, psnr=VIEWS - mean + 0.1 * rng.normal() + 0.2 * rng.normal(size=(2, 9)))
        for seed in range(2)
        for m, mean in means.items()
    ]
    for some in (runs[:8], runs):
        assert [m for m, entry in macro(some).items() if entry.tied] == []
    assert np.isnan(macro(runs[:8])["b"].by_seeds)


def test_seeds_alone_tie_what_has_no_views():
    runs = [record(m, i, psnr=(p + i,)) for m, p in (("a", 20.0), ("b", 19.0)) for i in range(2)]
    (b,) = (entry for entry in macro(runs).values() if entry.method == "b")
    assert (
        b.tied and np.isnan(b.difference_low) and b.by_seeds == pytest.approx(4.3026527 * 0.5**0.5)
    )


def test_other_views_are_not_paired():
    rows = [replace(row, view=f"other/{row.view}") for row in scored(psnr=VIEWS).rows]
    found = macro([scored("a", psnr=VIEWS), scored("b", psnr=VIEWS, rows=rows)])
    assert np.isnan(found["b"].difference_low) and not found["b"].tied


def test_the_best_three_are_ranked_as_they_read():
    values = {"a": 20.0, "b": 21.004, "c": 21.001, "d": 19.0, "e": 18.0}
    found = macro([record(method, psnr=(value,)) for method, value in values.items()])
    assert {method: entry.rank for method, entry in found.items()} == {
        "a": 3,
        "b": 1,
        "c": 1,
        "d": 0,
        "e": 0,
    }
    last = macro([record("a", psnr=(20.0,)), record("b", psnr=(21.0,))])
    assert (last["a"].rank, last["b"].rank) == (0, 1)


def test_seeds_of_several_devices_are_averaged():
    runs = [record(seed=i, psnr=(20.0 + i,), device=f"device {i}") for i in range(2)]
    entries = summarise(runs)
    (found,) = entries.query("column == 'macro'").itertuples()
    assert (found.mean, found.n, found.device) == (20.5, 2, "device 0; device 1")
    assert found.label == "CHRONOGS (joint, fast)"
    assert not {"seconds", "render_seconds"} & {*entries.quantity}


def test_the_same_seed_on_two_devices_compares_them():
    runs = [record(psnr=(20.0 + i,), device=f"device {i}") for i in range(2)]
    runs.append(record("3dgs", seed=1, device="device 1"))
    assert summarise(runs).label.unique().tolist() == [
        "CHRONOGS (joint, fast) [device 0]",
        "CHRONOGS (joint, fast) [device 1]",
        "3DGS (joint, fast)",
    ]


def test_scenes_are_averaged_with_their_intervals_and_spreads():
    runs = [
        scored(scene=scene, seed=seed, psnr=VIEWS + shift * seed)
        for scene, shift in (("plaza", 3.0), ("quay", 4.0))
        for seed in (0, 1)
    ]
    runs.append(scored("b", psnr=VIEWS))  # on one of the scenes
    entries = summarise(runs)
    mean, *costs = over_scenes(entries, "mean").itertuples()
    assert mean.mean == pytest.approx(VIEWS.mean() + 3.5 / 2)
    assert mean.sd == pytest.approx(5 / 2**0.5 / 2)  # of the mean of two: hypot(3, 4) / sqrt(2) / 2
    lows = entries.query("column == 'macro' and method == 'chronogs'").eval("mean - low")
    # Twice as many views estimate the variance: the quantile of t is smaller, too.
    smaller = stdtrit(pooled_freedom([9] * 4), 0.975) / stdtrit(pooled_freedom([9] * 2), 0.975)
    expected = lows.mean() / 2**0.5 * smaller
    assert (mean.mean - mean.low) == pytest.approx(expected, rel=0.1)
    means = {cost.quantity: cost.mean for cost in costs}
    assert (means["checkpoint_bytes"], means["seconds"]) == (1_234_000, 10.0)


def test_runs_of_another_width_do_not_change_an_interval():
    run, other = scored(psnr=VIEWS), scored(psnr=VIEWS, max_width=800)
    (alone,) = summarise([run]).query("column == 'macro'").itertuples()
    beside, _ = summarise(apart([run, other])).query("column == 'macro'").itertuples()
    assert beside.scene == "plaza [width 1600]"
    assert (beside.low, beside.high) == (alone.low, alone.high)


def test_a_scene_of_one_period_decides_the_interval_of_the_mean_of_scenes():
    """It has half of the weight, and its few views estimate the variance badly."""
    runs = [scored(psnr=[VIEWS[0]], scene="quay"), scored(psnr=[VIEWS[0]] * 9, scene="plaza")]
    entries = summarise(runs)
    (mean,) = over_scenes(entries, "mean").query("quantity == 'psnr'").itertuples()
    alone, _ = entries.query("column == 'macro'").itertuples()
    freedom = pooled_freedom([9] * 10, [9] + [1] * 9)
    assert freedom < 1.3 * degrees_of_freedom(9)
    wider = stdtrit([freedom, degrees_of_freedom(9)], 0.975)
    expected = (alone.mean - alone.low) / 2 * (1 + 1 / 9) ** 0.5 * wider[0] / wider[1]
    assert (mean.mean - mean.low) == pytest.approx(expected, rel=0.1)


def test_published_rows():
    entries = published_entries(load_published(), ["plaza", "lawncourt"])
    (mine,) = entries.query("method == 'ChronoGS' and quantity == 'psnr'").itertuples()
    assert (mine.scene, mine.column, mine.mean, mine.rank) == ("lawncourt", "macro", 22.16, 0)
    assert mine.label == "ChronoGS (published)" and mine.source.startswith("ChronoGS: Disentangl")
    (size,) = entries.query("method == 'ChronoGS' and quantity == 'checkpoint_bytes'").itertuples()
    assert size.mean == 0.52e9
