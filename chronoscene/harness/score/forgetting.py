"""Effect of each stage of the strategy ``sequential`` on the periods before and after it.

R[k, i] is the mean of a metric over the test views of period i, rendered after stage k, of T. Where
less is better, as for LPIPS, its sign is changed in all of these:

    forgetting         mean over i < T - 1 of  max over i <= l < T - 1 of R[l, i]  -  R[T - 1, i]
    backward transfer  mean over i < T - 1 of  R[T - 1, i] - R[i, i]
    forward transfer   mean over i > 0 of      R[i - 1, i] - b[i]

where b[i] is the quality of period i before the first stage. A method that takes the period is
asked for its last one in R[i - 1, i] and b[i], as it does not know period i.

Source: forgetting, Chaudhry et al. 2018 (Riemannian Walk, ECCV); the transfers, Lopez-Paz and
Ranzato 2017 (Gradient Episodic Memory, NeurIPS), whose b is the quality at initialisation, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from chronoscene.arrays import Array
from chronoscene.harness.files.records import UNTRAINED, Values
from chronoscene.harness.files.strategies import period_part
from chronoscene.metrics.registry import all_metrics

Stages = Mapping[str, Mapping[str, Values]]
"""Stage to period id to metric to value, as `RunRecord.stages`."""


def stage_matrix(stages: Stages, metric: str) -> Array:
    """Return b as row 0 and R[k] as row k + 1; NaN where nothing was rendered. [T + 1, T]"""
    periods = range(len(stages) - 1)
    names = [UNTRAINED, *map(period_part, periods)]
    values = [[stages[n].get(str(i), {}).get(metric, math.nan) for i in periods] for n in names]
    return np.array(values)


def transfer(stages: Stages) -> dict[str, Values]:
    """Compute forgetting and transfers of each metric, as far as there are values.

    Returns:
        ``forgetting``, ``backward_transfer`` and ``forward_transfer``, each metric to value.
    """
    found: dict[str, Values] = {}
    for name, metric in all_metrics().items():
        matrix = stage_matrix(stages, name) * (1 if metric.higher_is_better else -1)
        before, after = matrix[:-1].diagonal(), matrix[1:].diagonal()  # R[i - 1, i], R[i, i]
        last, earlier = matrix[-1], matrix[1:-1]
        best = [earlier[i:, i].max() for i in range(len(earlier))]
        changes = {
            "forgetting": best - last[:-1],
            "backward_transfer": (last - after)[:-1],
            "forward_transfer": (before - matrix[0])[1:],
        }
        for kind, values in changes.items():
            known = values[~np.isnan(values)]
            if len(known):
                found.setdefault(kind, {})[name] = float(known.mean())
    return found
