"""Single views: side by side, the worst first."""

from dataclasses import replace

import pytest
from made_runs import record, scored

from chronoscene.errors import ConfigError
from chronoscene.harness.report.single_views import WORST, view_scores, worst_views


def test_views_stand_worst_first_with_seeds_averaged():
    runs = [
        scored("a", 0, psnr=[[30.0, 20.0], [10.0]]),
        scored("a", 1, psnr=[[30.0, 22.0], [14.0]]),
        scored("b", 0, psnr=[[31.0, 15.0], [24.0]]),
        scored("b", 0, psnr=[[5.0]], scene="beside"),
    ]
    scores = view_scores(runs, "psnr")
    assert [*scores.columns] == ["A (joint, fast)", "B (joint, fast)"]
    views = [("beside", 0, "0/view0.png")]
    views += [("plaza", 0, "0/view1.png"), ("plaza", 1, "1/view0.png"), ("plaza", 0, "0/view0.png")]
    assert [*scores.index] == views
    assert scores.loc["plaza"].to_numpy().tolist() == [[21.0, 15.0], [12.0, 24.0], [30.0, 31.0]]
    beside, plaza = worst_views(scores, runs, "psnr")
    assert [first for first, _ in beside.head_lines] == ["view", "period", "B"]
    assert plaza.flat_heads[2:] == ["A (joint, fast)", "B (joint, fast)"]
    assert plaza.rows[1] == ["1/view0.png", "period 1", "12.00", "24.00"]
    assert plaza.rows[0][1] == "May_2016 & before"


def test_what_is_low_may_be_good():
    run = scored(psnr=[[30.0, 20.0]])
    rows = [replace(row, metric="lpips_vgg") for row in run.rows]
    scores = view_scores([run.model_copy(update={"rows": rows})], "lpips_vgg")
    assert [view for *_, view in scores.index] == ["0/view0.png", "0/view1.png"]


def test_the_table_is_short_and_says_so():
    runs = [scored(psnr=[[*map(float, range(20, 20 + WORST + 3))]])]
    (table,) = worst_views(view_scores(runs, "psnr"), runs, "psnr")
    assert len(table.rows) == WORST and table.title.endswith(f"{WORST} of {WORST + 3}")


def test_a_metric_that_nobody_computed():
    with pytest.raises(ConfigError, match="--metric ssim: expected a metric that the runs were"):
        view_scores([scored(psnr=[[20.0]]), record()], "ssim")
