"""Stages of a registration by their functions, and the table of their growth."""

import time

import pytest

from benchmarks.registration.size import COMMAND, TASKS, Clock, growth_table, timed
from chronoscene.registration import output, pipeline


def test_time_belongs_to_the_innermost_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter(range(100))
    monkeypatch.setattr(time, "process_time", lambda: float(next(seconds)))
    clock = Clock("rest")  # at 0 s; each look at the clock takes one
    monkeypatch.setattr(output, "certify", lambda: None)
    monkeypatch.setattr(pipeline, "inspect_registration", lambda: output.certify())
    stages = {"pipeline.inspect_registration": "inspection", "output.certify": "certificate"}
    with timed(clock, stages):
        pipeline.inspect_registration()
    assert clock.stage == "rest"
    found = {stage: time for stage, (time, _) in clock.record().items()}
    assert found == {"rest": 2.0, "inspection": 2.0, "certificate": 1.0}


@pytest.mark.parametrize("stages", [COMMAND, TASKS], ids=["command", "tasks"])
def test_all_stages_are_functions_of_the_package(stages: dict[str, str]) -> None:
    with timed(Clock("rest"), stages):
        pass


def test_growth_is_the_exponent_between_neighbouring_sizes() -> None:
    runs = [
        {
            "photos": n, "counts": {"pairs": n * n}, "seconds": 2.0 * n, "verdict": "pass",
            "stages": {"mapping": [n**1.5, 2e9], "page": [0.1, 1e9]},
            "periods": [(0.01, 9.0, 0.002, 9.0), (0.02, 9.0, 0.001, 9.0)],
        }
        for n in (10, 40)
    ]  # fmt: skip
    rows = growth_table(runs).splitlines()
    assert rows[0] == "|  | 10 photos | 40 photos | 10 to 40 |"
    assert rows[2] == "| pairs | 100 | 1,600 | 2.00 |"
    assert rows[3] == "| mapping | 31.6 s, 2.00 GB | 253.0 s, 2.00 GB | 1.50 |"
    assert rows[4] == "| page | 0.1 s, 1.00 GB | 0.1 s, 1.00 GB | - |"
    assert rows[5] == "| all | 20 s | 80 s | 1.00 |"
    assert rows[6] == "| worst date, verdict | 0.020°, 0.002 %, pass | 0.020°, 0.002 %, pass |  |"
