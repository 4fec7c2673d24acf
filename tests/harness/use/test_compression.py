"""``chronoscene compress``: runs whose models take few bytes, beside those that they come from."""

import shutil
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from command_line import invoke, succeed

from chronoscene.cli import cli
from chronoscene.compression.columns import Columns
from chronoscene.compression.file import encode, read_compressed
from chronoscene.compression.positions import Grid, morton
from chronoscene.errors import CheckpointError, ConfigError, SceneError
from chronoscene.harness.files.predictions import load_image, read_manifest, to_bytes
from chronoscene.harness.files.records import read_run, run_folders
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.use import compression
from chronoscene.harness.use.compression import compress_run
from chronoscene.harness.use.trained_run import open_run
from chronoscene.images.store import ImageStore
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene.scene import spread_frames


def compress(folder, *options):
    """Compress a run; returns the folder of the new one, and what is printed."""
    result = succeed("compress", folder, *options)
    (out,) = {*run_folders(folder.parents[2])} - {folder}
    return out, result.stdout


@pytest.fixture
def copied(trained, tmp_path):
    """A function that copies a trained run into runs of its own, with the ground truth."""

    def copy(method):
        folder = trained[method]
        runs = tmp_path / "runs"
        shutil.copytree(folder.parents[2] / "ground_truth", runs / "ground_truth")
        shutil.copytree(folder, runs.joinpath(*folder.parts[-3:]))
        return runs.joinpath(*folder.parts[-3:])

    return copy


@pytest.mark.parametrize("method", ["chronogs", "3dgs-period", "4dgs"])
def test_the_plain_form_is_a_run_that_renders_and_scores_as_before(copied, method):
    folder = copied(method)
    out, printed = compress(folder, "--plain")
    before, after = read_run(folder), read_run(out)
    files = [file for file in (out / "checkpoint").rglob("*") if file.is_file()]
    assert {file.name for file in files} == {"model.json", "model.compressed"}
    assert after.checkpoint_bytes == sum(file.stat().st_size for file in files)
    assert f"{before.checkpoint_bytes:,} bytes -> {after.checkpoint_bytes:,} bytes" in printed
    assert after.checkpoint_bytes < 0.7 * before.checkpoint_bytes
    assert after.render_seconds and after.device == before.device
    assert after.variant.endswith("compressed=plain") and after.config_hash != before.config_hash
    macro = before.aggregates["macro"]["psnr"]
    assert after.aggregates["macro"]["psnr"] == pytest.approx(macro, abs=0.02)
    run = open_run(out)
    for frame in run.scene().select(split="test"):
        entry = next(e for e in read_manifest(out / "predictions").images if e.view == frame.name)
        image = run.render(frame.camera, frame.cam_from_world, frame.period).rgb
        written = load_image(out / "predictions", entry)
        np.testing.assert_allclose(255 * image.clip(0, 1), written, atol=0.51)


def test_the_time_of_rendering_is_not_that_of_another_device(copied, monkeypatch):
    folder, other = copied("3dgs-period"), "cpu (Other, 1 thread)"
    monkeypatch.setattr(compression, "describe_device", lambda *machine: other)
    out, _ = compress(folder, "--plain")
    assert read_run(folder).render_seconds and read_run(out).render_seconds is None
    assert other in read_run(out).absent["render_seconds"]
    printed = succeed("table", folder.parents[2]).stdout
    assert "absent: rendering [ms]: compressed on another device" in printed


def training_psnr(folder):
    """Mean over the training views."""
    run = open_run(folder)
    scene, values = run.scene(), []
    for frame in scene.select(split="train"):
        image = to_bytes(run.render(frame.camera, frame.cam_from_world, frame.period).rgb)
        values.append(psnr(image, ImageStore(scene).load(frame)))
    return np.mean(values)


def test_training_views_lose_what_is_allowed_and_hardly_less(copied, monkeypatch):
    pytest.importorskip("constriction", reason="coded models need constriction")
    monkeypatch.setattr("chronoscene.harness.use.compression.MIN_ROWS", 4)
    folder = copied("chronogs")
    out, _ = compress(folder, "--max-loss", "0.5")
    assert read_run(out).variant.endswith("compressed=0.5dB")
    assert 0.3 < training_psnr(folder) - training_psnr(out) <= 0.5 + 1e-6


def test_the_loss_is_that_of_the_file_though_a_position_is_far_away(tmp_path):
    pytest.importorskip("constriction", reason="coded models need constriction")
    rng = np.random.default_rng(0)
    means = rng.normal(size=(300, 3)).astype(np.float32)
    means[0] = 0, 0, 1e5
    grid = Grid.of(means, None)
    means = means[np.argsort(morton(grid.codes(means)))]
    values = rng.normal(size=(300, 4)).astype(np.float32)
    tensors, rules = {"means": means, "values": values}, {"values": Columns.of(values)}
    (tmp_path / "model").write_bytes(encode(tensors, {"means": grid}, rules))
    stored = read_compressed(tmp_path / "model")
    model = compression._SortedModel(None, (), None, None, tmp_path, tensors, {"means": grid})
    rounded = model.rounded(rules)
    for name in tensors:
        np.testing.assert_array_equal(rounded[name], stored[name])
    assert np.abs(stored["means"] - means).max() > 0.01


def test_a_loss_beyond_all_images_is_a_usage_error():
    """Its share of errors is no number that a computer has."""
    result = invoke("compress", "run", "--max-loss", "1e300")
    assert result.exit_code == 2 and "1e+300 is not in the range 0<x<=100" in result.output


def test_a_loss_means_nothing_to_the_plain_form(trained):
    with pytest.raises(ConfigError, match="--max-loss: expected no such option with --plain"):
        compress(trained["chronogs"], "--plain", "--max-loss", "0.5")


def test_a_run_is_compressed_once(copied):
    folder = copied("chronogs")
    out, _ = compress(folder, "--plain")
    for place, expected in (
        (folder, "expected no run that is compressed like this, found one; use it, or delete it"),
        (out, "expected a run as it was trained, found a compressed one"),
    ):
        result = CliRunner().invoke(cli, ["compress", str(place), "--plain"])
        assert expected in str(result.exception)


def test_a_damaged_model_is_refused(copied):
    out, _ = compress(copied("chronogs"), "--plain")
    file = out / "checkpoint/model.compressed"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"model\.compressed: .*digest"):
        open_run(out).model(0)


def test_every_period_has_a_view_however_many_there_are(copied):
    frames = open_run(copied("chronogs")).scene().frames
    many = [replace(frames[0], period=i % 40, image_id=i) for i in range(100)]
    assert [f.period for f in spread_frames(many, 9)] == list(range(40))
    assert [f.image_id for f in spread_frames(many[:1] * 7, 3)] == [0] * 3
    assert spread_frames(many[::40], 99) == tuple(many[::40])


def test_the_model_of_a_period_is_judged_by_photos_of_that_period(
    make_scene, tmp_path, monkeypatch
):
    judged = []
    (tmp_path / "ground_truth/scene").mkdir(parents=True)

    @contextmanager
    def opened(run, period, scene, frames):
        judged.append((period, {(frame.period, frame.split) for frame in frames}))
        yield SimpleNamespace(tensors={}, grids={}, scratch=None)

    for name in ("encode", "_write"):
        monkeypatch.setattr(compression, name, lambda *args: None)
    monkeypatch.setattr(compression, "_opened", opened)
    for strategy, expected in (
        ("separate", [(0, {(0, "train")}), (1, {(1, "train")})]),
        ("joint", [(0, {(0, "train"), (1, "train")})]),
    ):
        run = SimpleNamespace(
            strategy=STRATEGIES[strategy],
            record=SimpleNamespace(variant="", scene="scene"),
            photos=ImageStore,
            folder=tmp_path / "scene/method/seed0",
            num_periods=2,
        )
        with pytest.raises(SceneError, match=r"source\.json"):  # the run has no files
            compress_run(run, make_scene(), max_loss=None, log=lambda line: None)
        assert judged == expected
        judged.clear()


def test_a_run_in_stages_is_refused(copied):
    run = open_run(copied("chronogs"))
    staged = replace(run, record=run.record.model_copy(update={"strategy": "sequential"}))
    with pytest.raises(ConfigError, match=r"one model, or one per period.*sequential"):
        compress_run(staged, run.scene(), max_loss=None, log=print)


def test_a_run_away_from_its_ground_truth_is_refused_before_long_work(copied):
    run = open_run(folder := copied("chronogs"))
    shutil.rmtree(folder.parents[2] / "ground_truth")
    with pytest.raises(ConfigError, match=r"found no .*ground_truth.*copy the whole folder"):
        compress_run(run, run.scene(), max_loss=0.1, log=pytest.fail)


@pytest.mark.slow
def test_a_loss_that_half_floats_exceed_is_refused(copied, monkeypatch):
    monkeypatch.setattr("chronoscene.harness.use.compression.MIN_ROWS", 4)
    falling = count(30, -1)
    part = "chronoscene.harness.use.compression._SortedModel.psnr"
    monkeypatch.setattr(part, lambda self, tensors: next(falling))
    run = open_run(copied("chronogs"))
    with pytest.raises(ConfigError, match=r"--max-loss 0.5: .*allow more"):
        compress_run(run, run.scene(), max_loss=0.5, log=print)
