"""No method reads memory that nobody wrote, which may hold anything from run to run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from unwritten_memory import filled_with_nan

from chronoscene.fields.config import FieldConfig
from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train.painted_balls import make_training_set
from chronoscene.methods import import_object, load_spec, method_names

from .small_fields import SAME_NETWORKS, SMALL_FIELD

STEPS = 12
FIELD_STEPS = 4


@pytest.mark.filterwarnings("ignore:.*deterministic")
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in SAME_NETWORKS else ()) for n in method_names()],
)
def test_no_method_reads_memory_that_nobody_wrote(name: str) -> None:
    spec = load_spec(name)
    data = make_training_set(tiny_training.periods_for(spec))
    config, steps = tiny_training.small_config(spec), STEPS
    if isinstance(config, FieldConfig):
        config, steps = dataclasses.replace(config, **SMALL_FIELD), FIELD_STEPS

    def image() -> np.ndarray:
        method = import_object(spec.method)(config)
        method.setup(data, seed=0, device="cpu")
        for index in range(steps):
            method.step(index, index / steps)
        found: np.ndarray = method.render(data.views[0], 0.0).rgb
        return found

    usual = image()
    with filled_with_nan():
        assert np.array_equal(image(), usual)
