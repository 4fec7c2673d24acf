"""Entries of the repository: of scenes with a role; of today's presets, unless they say so."""

from functools import cache
from pathlib import Path

import pytest

import leaderboard
from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.resolve import resolve_method
from chronoscene.harness.plan.settings import RunSettings
from chronoscene.methods import installed_methods, load_spec
from leaderboard import entries
from leaderboard.entries import entry_files
from leaderboard.scenes import fixed_scenes

FOLDER = Path(leaderboard.__file__).parent / "entries/measured"
EACH = pytest.mark.parametrize(
    "path", entry_files(FOLDER), ids=lambda path: f"{path.parent.name}/{path.stem}"
)

read_entry = cache(entries.read_entry)
"""Each is large, and read by several tests."""


@EACH
def test_an_entry_is_of_a_scene_with_a_role_and_its_split(path):
    record = read_entry(path).runs[0].record
    (scene,) = [s for s in fixed_scenes().values() if s.scene_hash == record.scene_hash]
    assert record.split_hash == scene.split_hash
    assert scene.role != "tuning"


@EACH
def test_an_entry_has_the_configuration_of_today_or_says_that_it_is_outdated(path):
    record = read_entry(path).runs[0].record
    if record.variant or record.method not in installed_methods():
        pytest.skip("no preset alone made it")
    settings = RunSettings(Path(), preset=record.preset, max_width=record.max_width)
    job = Job(
        origin=RunOrigin(method=record.method, scene_root="", scene_format=""),
        scene="", scene_hash="", split_hash="",
        method_name=record.method, strategy=record.strategy, seed=0,
        settings=settings,
    )  # fmt: skip
    run = resolve_method(record.method, load_spec(record.method), settings).run(job)
    assert read_entry(path).outdated or run.document["config_hash"] == record.config_hash, (
        f"{path}: the preset has changed since; run it again, or set outdated to true"
    )
