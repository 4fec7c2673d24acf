"""Stages of the CPU rasterizer, timed one by one."""

from benchmarks.rasterizer.limits import Stages
from benchmarks.rasterizer.scenes import surfaces


def test_every_stage_of_a_scene_is_timed_beside_its_limit() -> None:
    stages = Stages(surfaces(2_000, 96, 64))
    times, work = stages.run()
    assert work.entries > 0 and all(spent >= 0 for spent in times.values())
    assert stages.least(work, (1e9, 1e9, 1e9)).keys() == times.keys()
