"""Schedules that are not stretched: moments are steps under every strategy."""

import pytest

from chronoscene.gaussians.trainer import Timeline
from chronoscene.harness.files.records import read_run
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.training.schedules import log_linear


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("method", ["3dgs-period", "4dgs"])
def test_moments_are_the_steps_of_each_model_or_stage(bench_here, monkeypatch, method, strategy):
    due, at = [], Timeline.at

    def watched(timeline, index, progress, views):
        due.append((index, at(timeline, index, progress, views)))
        return due[-1][1]

    monkeypatch.setattr(Timeline, "at", watched)
    options = {"stretch": "false", "densify_from": "2", "densify_interval": "2"}
    if method == "4dgs":
        options |= {"coarse_until": "0"}
    outcome, _ = bench_here(
        method, strategies=(strategy,), preset="fast", iterations=9, overrides=options
    )
    (folder,) = outcome.finished
    kind = STRATEGIES[strategy]
    parts = [5, 4] if kind.model_per_period or kind.in_order else [9]
    assert read_run(folder).iterations == 9
    steps = [found.moment for _, found in due[-9:]]
    assert steps == [moment for length in parts for moment in range(1, length + 1)]
    for index, found in due[-9:]:
        assert found.densify == (index + 1 > 2 and (index + 1) % 2 == 0)
        rate = log_linear(found.moment / 30_000, 1.6e-4, 1.6e-6)
        assert method == "4dgs" or found.position_lr == rate
