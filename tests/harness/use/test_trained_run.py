"""An opened run renders what the run rendered, and refuses what its models do not claim."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.errors import CheckpointError, ConfigError, SceneError, ShapeError
from chronoscene.harness.files.predictions import load_image, read_manifest, to_bytes
from chronoscene.harness.files.records import CONFIG_FILE, PREDICTIONS, SOURCE_FILE
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.scene import Camera
from chronoscene.scene.geometry import pose_from_rotation_translation

TOY = "toy_methods:MEAN"
STRATEGIES = ("joint", "pooled", "separate")


def folder_of(runs: Path, strategy: str = "joint") -> Path:
    return runs / "ring" / f"mean-{strategy}-balanced" / "seed0"


def assert_renders_its_predictions(run: TrainedRun) -> None:
    frames = {frame.name: frame for frame in run.scene().frames}
    entries = read_manifest(run.folder / PREDICTIONS).images
    assert len(entries) == 3
    for entry in entries:
        frame = frames[entry.view]
        image = run.render(frame.camera, frame.cam_from_world, frame.period).rgb
        stored = load_image(run.folder / PREDICTIONS, entry)
        np.testing.assert_array_equal(to_bytes(image), stored)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_an_opened_run_renders_its_predictions(runs, strategy):
    assert_renders_its_predictions(open_run(folder_of(runs, strategy), plugin=TOY))


def test_a_run_of_gaussians_renders_its_predictions_with_depth_in_world_units(
    scene_folder, tmp_path, runs_here
):
    """The camera, pose and training frame matter here, unlike to a method of one colour."""
    settings = bench_settings(
        scenes=(scene_folder,), methods=("3dgs",), runs=tmp_path, threads=1, iterations=5
    )
    run_bench(settings, lambda line: None)
    run = open_run(tmp_path / "ring" / "3dgs-pooled-balanced-iterations=5" / "seed0")
    assert_renders_its_predictions(run)
    scene = run.scene()
    frame = scene.frames[0]
    depth = run.render(frame.camera, frame.cam_from_world, 0).depth
    local = scene.points.xyz @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
    nearest, farthest = np.quantile(local[:, 2], [0.0, 1.0])
    assert nearest - 1 < np.median(depth[depth > 0]) < farthest + 1


def test_the_scene_may_have_moved(runs, scene_folder, tmp_path):
    run = open_run(folder_of(runs), plugin=TOY)
    run = replace(run, source=run.source.model_copy(update={"scene_root": str(tmp_path / "old")}))
    with pytest.raises(SceneError, match=r"old: expected the scene .* found nothing; .* --scene"):
        run.scene()
    moved = shutil.copytree(scene_folder, tmp_path / "moved")
    assert run.scene(str(moved)).name == "moved"
    (moved / "images/a/0.png").write_bytes((moved / "images/a/1.png").read_bytes())
    with pytest.raises(SceneError, match=r"found another scene, or a changed one; .* --scene"):
        run.scene(moved)


def test_the_method_may_be_gone(runs):
    file = folder_of(runs) / SOURCE_FILE
    source = json.loads(file.read_text())
    file.write_text(json.dumps(source | {"method": "gone", "plugin_path": None}))
    with pytest.raises(ConfigError, match="gone': expected the method of the run, from unpackaged"):
        open_run(folder_of(runs), plugin=TOY)


@pytest.mark.parametrize("plugin", ["toy_methods:BLIND", "3dgs", ()])
def test_a_run_of_another_module_needs_the_name_of_the_module(runs, plugin):
    """Even if the module is importable."""
    found = (
        r"'mean': expected an installed.*found 'toy_methods:MEAN' from .*add --plugin module:SPEC"
    )
    with pytest.raises(ConfigError, match=found):
        open_run(folder_of(runs), plugin=plugin)


def test_a_module_that_has_moved_is_found_by_the_name_of_its_method(runs):
    file = folder_of(runs) / SOURCE_FILE
    source = json.loads(file.read_text())
    file.write_text(json.dumps(source | {"method": "moved:SPEC", "plugin_path": "/old/place"}))
    assert open_run(folder_of(runs), plugin=["toy_methods:BLIND", TOY]).spec.name == "mean"


@pytest.mark.parametrize(
    ("text", "periods"), [("autumn", (1,)), ("1", (1,)), ("spring:1", (0, 1)), ("1:0", (1, 0))]
)
def test_periods_have_numbers_and_labels(runs, text, periods):
    assert open_run(folder_of(runs), plugin=TOY).parse_periods(text) == periods


def test_a_label_is_a_label_whatever_it_looks_like(runs):
    run = open_run(folder_of(runs), plugin=TOY)
    run.record.period_labels = {"0": "1", "1": "12:30"}
    assert (run.parse_periods("1"), run.parse_periods("12:30")) == ((0,), (1,))


def test_a_label_of_two_periods_names_neither(runs):
    run = open_run(folder_of(runs), plugin=TOY)
    run.record.period_labels = {"0": "May", "1": "May"}
    with pytest.raises(ConfigError, match="'May': expected the label of one period, found that of"):
        run.parse_period("May")
    assert run.parse_period("1") == 1


@pytest.mark.parametrize(
    ("strategy", "period", "message"),
    [
        ("joint", 2, "period 2: expected one from 0 to 1.*0 .spring., 1 .autumn."),
        ("joint", -1, "period -1: expected one from 0 to 1"),
        ("joint", float("nan"), "period nan: expected one from 0 to 1"),
        ("joint", "autumn", "period 'autumn': expected one from 0 to 1.*1 .autumn."),
        ("joint", 0.5, "a whole number: Mean under strategy joint.*choose 0 or 1"),
        ("separate", 0.5, "a whole number"),
        ("pooled", 0.5, "a whole number"),
    ],
)
def test_a_period_that_the_models_do_not_claim(runs, strategy, period, message):
    run = open_run(folder_of(runs, strategy), plugin=TOY)
    frame = run.scene().frames[0]
    with pytest.raises(ConfigError, match=message):
        run.render(frame.camera, frame.cam_from_world, period)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "PINHOL"}, "camera 1: model: expected one of .* did you mean 'PINHOLE'"),
        (
            {"params": (9.0, 2.0, 2.0)},
            "parameters fx, fy, cx, cy, with positive focal lengths, fou",
        ),
        ({"params": (9.0, 0.0, 2.0, 2.0)}, r"found 40, 30 and \(9.0, 0.0, 2.0, 2.0\); correct"),
        (
            {"width": 0},
            "camera 1: expected a width, a height and the parameters .* found 0, 30 and",
        ),
    ],
)
def test_a_camera_that_is_none(runs, change, message):
    run = open_run(folder_of(runs), plugin=TOY)
    camera = replace(Camera(1, "PINHOLE", 40, 30, (9.0, 9.0, 20.0, 15.0)), **change)
    with pytest.raises(ConfigError, match=message):
        run.render(camera, np.eye(4), 0)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.eye(4)[:3], r"expected shape \[4, 4\], found \[3, 4\]"),
        (np.diag([2.0, 2, 2, 1]), "expected .* a rotation R and a finite translation t, found"),
        (np.full((4, 4), np.nan), "without a scale"),
        (pose_from_rotation_translation(np.eye(3), [0, 0, np.inf]), "without a scale"),
        (pose_from_rotation_translation(np.eye(3), [0, 0, 9]).T, "without a scale"),
    ],
    ids=["3 x 4", "scaled", "not a number", "infinite", "transposed"],
)
def test_a_pose_that_is_none(runs, pose, message):
    run = open_run(folder_of(runs), plugin=TOY)
    with pytest.raises(ShapeError, match=f"^cam_from_world: .*{message}"):
        run.render(Camera(1, "PINHOLE", 40, 30, (9.0, 9.0, 20.0, 15.0)), pose, 0)


def test_a_device_that_is_none(runs):
    with pytest.raises(ConfigError, match="device: expected one of cpu, cuda, found 'auto'"):
        open_run(folder_of(runs), plugin=TOY, device="auto")


@pytest.mark.parametrize(("strategy", "claims"), [("joint", True), ("separate", False)])
def test_periods_in_between_need_a_continuous_method_that_saw_all(runs, strategy, claims):
    run = open_run(folder_of(runs, strategy), plugin=TOY)
    run = replace(run, spec=replace(run.spec, period_input="continuous"))
    assert run.is_continuous == claims


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (SOURCE_FILE, None, "earlier version.*--overwrite"),
        (SOURCE_FILE, "{}", "expected what bench wrote"),
        (SOURCE_FILE, "[", "expected what bench wrote"),
        (CONFIG_FILE, None, "expected the config of the run"),
        (CONFIG_FILE, "{}", "expected what bench wrote, found Field required"),
        (CONFIG_FILE, '{"config": {"method_config": {"of": "another"}}}', "mean: configuration"),
        ("run.json", None, "expected a finished run"),
        ("checkpoint/model.json", None, "model"),
    ],
)
def test_missing_and_damaged_files(runs, name, text, message):
    folder = folder_of(runs)
    (folder / name).unlink()
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises((CheckpointError, ConfigError, FileNotFoundError), match=message):
        open_run(folder, plugin=TOY).model(0)


@pytest.mark.parametrize("stage", [None, 0])
def test_each_stage_of_a_sequential_run_can_be_opened(bench_here, stage):
    outcome, _ = bench_here("chronogs", strategies=("sequential",), preset="fast", iterations=12)
    folder = outcome.finished[0]
    run = open_run(folder, stage=stage)
    if stage is None:
        assert_renders_its_predictions(run)
        assert run.num_periods == 2
        return
    with pytest.raises(ConfigError, match=r"period 1: expected one from 0 to 0.*0 .spring."):
        run.render(run.scene().frames[0].camera, np.eye(4), 1)
    place = folder / "stages/period-0"
    frames = {frame.name: frame for frame in run.scene().frames}
    for entry in read_manifest(place).images:
        frame = frames[entry.view]
        image = run.render(frame.camera, frame.cam_from_world, entry.rendered_period).rgb
        np.testing.assert_array_equal(to_bytes(image), load_image(place, entry))
    with pytest.raises(ConfigError, match="stage 2: expected one from 0 to 1"):
        open_run(folder, stage=2)


def test_a_run_that_is_not_in_stages_has_none(runs):
    with pytest.raises(
        ConfigError, match="stage 0: expected a run in stages, found strategy joint"
    ):
        open_run(folder_of(runs), stage=0)


def test_a_strategy_that_bench_does_not_know(runs):
    path = folder_of(runs) / "run.json"
    path.write_text(path.read_text().replace('"strategy": "joint"', '"strategy": "external"'))
    with pytest.raises(ConfigError, match=r"run\.json: strategy: expected one of joint, "):
        open_run(path.parent, stage=0)


def test_a_run_without_its_model(runs):
    folder = folder_of(runs, "separate")
    (folder / "checkpoint" / "period-1").rename(folder / "elsewhere")
    run = open_run(folder, plugin=TOY)
    run.model(0)
    with pytest.raises(CheckpointError, match="period-1: expected the model of the run"):
        run.model(1)
