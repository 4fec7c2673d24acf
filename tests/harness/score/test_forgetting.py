"""Forgetting and transfers by hand, and the matrix that they are read from."""

import numpy as np
import pytest

from chronoscene.harness.score.forgetting import stage_matrix, transfer

STAGES = {
    "untrained": {"1": {"psnr": 8.0, "lpips_vgg": 0.9}, "2": {"psnr": 9.0, "lpips_vgg": 0.8}},
    "period-0": {"0": {"psnr": 30.0, "lpips_vgg": 0.1}, "1": {"psnr": 18.0, "lpips_vgg": 0.5}},
    "period-1": {
        "0": {"psnr": 31.0, "lpips_vgg": 0.2},
        "1": {"psnr": 26.0, "lpips_vgg": 0.1},
        "2": {"psnr": 15.0, "lpips_vgg": 0.5},
    },
    "period-2": {
        "0": {"psnr": 25.0, "lpips_vgg": 0.4},
        "1": {"psnr": 28.0, "lpips_vgg": 0.1},
        "2": {"psnr": 27.0, "lpips_vgg": 0.1},
    },
}


def test_the_matrix_has_a_row_for_each_stage_and_the_start():
    nan = np.nan
    rows = [[nan, 8, 9], [30, 18, nan], [31, 26, 15], [25, 28, 27]]
    np.testing.assert_array_equal(stage_matrix(STAGES, "psnr"), rows)


def test_forgetting_and_transfers_by_hand():
    found = transfer(STAGES)
    assert found["forgetting"]["psnr"] == pytest.approx(((31 - 25) + (26 - 28)) / 2)
    assert found["backward_transfer"]["psnr"] == pytest.approx(((25 - 30) + (28 - 26)) / 2)
    assert found["forward_transfer"]["psnr"] == pytest.approx(((18 - 8) + (15 - 9)) / 2)


def test_what_was_shown_of_a_period_before_its_stage_cannot_be_forgotten():
    early = {"0": STAGES["period-0"]["0"], "1": {"psnr": 29.0, "lpips_vgg": 0.05}}
    expected = transfer(STAGES)["forgetting"]
    assert transfer(STAGES | {"period-0": early})["forgetting"] == expected


def test_where_less_is_better_the_signs_say_the_same():
    found = transfer(STAGES)
    assert found["forgetting"]["lpips_vgg"] == pytest.approx(((0.4 - 0.1) + 0) / 2)
    assert found["backward_transfer"]["lpips_vgg"] == pytest.approx(((0.1 - 0.4) + 0) / 2)
    assert found["forward_transfer"]["lpips_vgg"] == pytest.approx(((0.9 - 0.5) + 0.3) / 2)


def test_periods_without_values_are_left_out():
    without = {
        stage: {i: v for i, v in periods.items() if i != "0"} for stage, periods in STAGES.items()
    }
    assert transfer(without)["backward_transfer"]["psnr"] == 2
    assert set(transfer({"untrained": {}, "period-0": {}, "period-1": {"1": {"psnr": 9.0}}})) == (
        set()
    )
