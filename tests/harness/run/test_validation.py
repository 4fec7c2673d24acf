"""Runs scored on views held back from the training views: test views are never read."""

import shutil

import pytest

from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import read_manifest
from chronoscene.harness.files.records import read_config, read_run
from chronoscene.harness.use.trained_run import open_run

TESTS = ("a/2.png", "b/1.png", "b/2.png")


def views(folder):
    return {image.view for image in read_manifest(folder).images}


def test_test_views_are_never_read(bench_here, scene_folder, tmp_path):
    """Neither by the training nor by the scores: their photos can be anything."""
    broken = tmp_path / "broken/ring"
    shutil.copytree(scene_folder, broken)
    for name in TESTS:
        (broken / "images" / name).write_bytes(b"no image")
    records = {}
    for root in (scene_folder, broken):
        out = tmp_path / root.parent.name / "runs"
        options = {"scenes": (root,), "runs": out, "validation": True}
        outcome, _ = bench_here("3dgs", "toy_methods:MEAN", iterations=5, **options)
        assert not outcome.failures
        records[root] = [read_run(folder) for folder in outcome.finished]
        scored = views(out / "ground_truth/ring")
        assert scored and not scored & {*TESTS}
        for folder, record in zip(outcome.finished, records[root], strict=True):
            assert record.variant.endswith("validation=true")
            assert folder.parent.name.endswith("validation=true")
            assert views(folder / "predictions") == scored
            if record.method == "3dgs":  # the same scene, to whoever opens the run
                scene = open_run(folder).scene()
                assert {f.name for f in scene.select(split="test")} == scored
                assert not {f.name for f in scene.frames} & {*TESTS}
    for intact, damaged in zip(*records.values(), strict=True):
        for name in ("aggregates", "scene_hash", "split_hash", "config_hash"):
            assert getattr(intact, name) == getattr(damaged, name)


def test_validation_is_part_of_the_settings_where_it_is_set(bench_here, tmp_path):
    (plain,), (held_back,) = (
        bench_here("toy_methods:MEAN", runs=tmp_path / str(on), validation=on)[0].finished
        for on in (False, True)
    )
    assert "validation" not in read_config(plain)["config"]
    assert read_config(held_back)["config"]["validation"] is True
    assert read_run(plain).split_hash != read_run(held_back).split_hash


def test_a_folder_of_runs_has_one_split(bench_here):
    bench_here("toy_methods:MEAN")
    with pytest.raises(ConfigError, match=r"another split of it.*choose another folder with --out"):
        bench_here("toy_methods:MEAN", validation=True)


def test_another_seed_holds_other_views_back(bench_here, tmp_path):
    found = []
    for seed in (0, 1, 2):
        options = {"runs": tmp_path / str(seed), "validation": True, "validation_seed": seed}
        (folder,) = bench_here("3dgs", iterations=5, **options)[0].finished
        found.append(views(folder / "predictions"))
        assert not found[-1] & {*TESTS}
        assert {f.name for f in open_run(folder).scene().select(split="test")} == found[-1]
        assert read_run(folder).variant.endswith(f",validation_seed={seed}") is (seed > 0)
    assert found[1] != found[0] or found[2] != found[0]
    with pytest.raises(ConfigError, match=r"--validation-seed: expected --validation with it"):
        bench_here("toy_methods:MEAN", validation_seed=1)
