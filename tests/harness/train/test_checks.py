"""What a method returns is checked field by field."""

from dataclasses import replace

import numpy as np
import pytest

from chronoscene.harness.train.checks import (
    MethodError,
    check_prediction,
    check_sharing,
    check_size,
    check_step,
)
from chronoscene.methods import MethodSize, PeriodSharing, Prediction, StepReport, View

VIEW = View(np.eye(3), 6, 4, np.eye(4))
GREY = Prediction(np.zeros((4, 6, 3), np.float32), np.ones((4, 6), np.float32), drawn=3)


def test_what_is_right_passes():
    check_step(StepReport(float("nan"), np.int64(3), "not finite"), "step 1")
    check_size(MethodSize(1, np.int32(2)), "size")
    check_sharing(PeriodSharing((1, 2), (4, 5), 6, 7), MethodSize(3, 22), "sharing")
    check_prediction(GREY, VIEW, "render")
    check_prediction(replace(GREY, alpha=None, drawn=None), VIEW, "render")


@pytest.mark.parametrize(
    ("check", "value", "message"),
    [
        (check_step, None, "at: expected a StepReport, found NoneType;"),
        (check_step, StepReport("a", 1), "at: StepReport.loss: expected a number, found 'a';"),
        (check_step, StepReport(1.0, 1.5), "at: StepReport.primitives: expected an integer, found"),
        (check_step, StepReport(1.0, 1, "no"), "at: StepReport.skipped: expected None, 'empty' or"),
        (check_step, StepReport(1.0, 1, views=1.5), "at: StepReport.views: expected an integer, f"),
        (check_step, StepReport(1.0, 1, views=0), "at: StepReport.views: expected at least 1, f"),
        (check_size, (1, 2), "at: expected a MethodSize, found tuple;"),
        (check_size, MethodSize(None, 2), "at: MethodSize.primitives: expected an integer, f"),
        (check_step, StepReport(1.0, -1), "at: StepReport.primitives: expected at least 0, fou"),
        (check_size, MethodSize(1, -2), "at: MethodSize.parameters: expected at least 0, found -2"),
        (check_size, MethodSize(1, 2.5), "at: MethodSize.parameters: expected an integer, f"),
    ],
)
def test_numbers(check, value, message):
    with pytest.raises(MethodError) as error:
        check(value, "at")
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("sharing", "message"),
    [
        (None, "at: expected a PeriodSharing, found NoneType;"),
        (PeriodSharing((1, 1), (4, 5), 6, 7), "at: PeriodSharing.blocks: expected 3 primitives in"),
        (PeriodSharing((1, 2), (4, 5), 6, 6), "at: PeriodSharing: expected 22 parameters in all"),
    ],
)
def test_what_is_shared_adds_up(sharing, message):
    with pytest.raises(MethodError) as error:
        check_sharing(sharing, MethodSize(3, 22), "at")
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": None}, "rgb: expected a finite float32 array of shape [4, 6, 3], found NoneType"),
        ({"rgb": np.zeros((4, 6, 3))}, "rgb: expected a finite float32 array of shape [4, 6"),
        ({"alpha": np.ones((6, 4), np.float32)}, "alpha: expected a finite float32 array of shape"),
        ({"depth": np.full((4, 6), np.inf, np.float32)}, "depth: expected a finite float32 array"),
        ({"drawn": 0.5}, "drawn: expected an integer, found 0.5"),
    ],
    ids=str,
)
def test_images(change, message):
    with pytest.raises(MethodError) as error:
        check_prediction(replace(GREY, **change), VIEW, "at")
    assert str(error.value).startswith(f"at: Prediction.{message}")
