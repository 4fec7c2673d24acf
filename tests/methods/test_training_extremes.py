"""Trainings at the extremes that are cheap: a finite model, or one clear error."""

import extreme_trainings
import numpy as np
import pytest

from chronoscene.methods import load_spec, method_names

CHEAP = [e for e in extreme_trainings.EXTREMES[1:] if e.cheap]

SLOW = {n for n in method_names() if load_spec(n).mixes_views}
SLOW |= {"gs-w", "3dgs-period", "scaffold-gs"}
"""The last two have the code of others."""

SHARE = 9
"""Pairs of extreme and method of which one is tested by default: each method that is not slow
meets a share of the extremes, each extreme a share of the methods."""


def pairs():
    for i, extreme in enumerate(CHEAP):
        for j, name in enumerate(method_names()):
            quick = (i + j) % SHARE == 0 and name not in SLOW
            marks = () if quick else pytest.mark.slow
            yield pytest.param(extreme, name, id=f"{extreme.name}-{name}", marks=marks)


@pytest.mark.parametrize(("extreme", "name"), list(pairs()))
def test_a_training_ends_in_a_model_or_in_one_clear_error(extreme, name):
    outcome = extreme_trainings.run(extreme, load_spec(name), "fast")
    assert outcome.clear, outcome.error
    if outcome.error is not None:
        assert extreme.advice is not None and extreme.advice in outcome.error
        return
    assert outcome.reports[-1].primitives > 0
    if extreme.rates > 1 or extreme.points == 3:
        return  # a model, but it may be worse than the initial one
    assert np.isfinite([report.loss for report in outcome.reports]).all()
    assert outcome.after > outcome.before - 0.05
