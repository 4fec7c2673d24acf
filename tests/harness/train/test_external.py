"""Methods that are other programs: what they are given, what is imported, what ends them."""

import venv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.formats import read_scene
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan.parts import make_parts
from chronoscene.harness.train.external import export_part
from chronoscene.harness.use.trained_run import open_run
from chronoscene.images.decoding import load_rgb
from chronoscene.images.store import ImageStore
from chronoscene.metrics.psnr_ssim import psnr


@pytest.fixture
def exported(make_scene, tmp_path):
    """The scene, a part of it as a program gets it, and the new names of its views."""

    def export(strategy="joint", part=0, max_width=1600, format="chronoscene", **changes):
        scene = make_scene(**changes)
        store = ImageStore(scene, max_width=max_width)
        out = tmp_path / "work/data"
        out.parent.mkdir()
        names = export_part(scene, make_parts(scene, store, strategy)[part], out, format)
        assert [path.name for path in out.parent.iterdir()] == ["data"]
        return scene, read_scene(out, format=format), names

    return export


@pytest.mark.parametrize("format", ["chronoscene", "colmap-folders", "nerfstudio"])
def test_a_training_set_has_no_test_photo_and_no_point_that_only_they_see(exported, format):
    scene, got, names = exported(format=format)
    assert [Path(name).name for name in names.values()] == [f"{i:05d}.png" for i in range(8)]
    assert set(names.values()) == {frame.name for frame in got.frames}
    assert len(got.points) == 11  # one of the twelve is seen by test images alone
    counts = np.bincount(got.points.track_frame, minlength=8)
    for frame, mine in zip(scene.frames, sorted(got.frames, key=lambda f: f.name), strict=True):
        assert mine.name == names[frame.name] and mine.split == frame.split
        assert mine.period == frame.period
        np.testing.assert_allclose(mine.cam_from_world, frame.cam_from_world, atol=1e-12)
        pixels = load_rgb(got.image_path(mine))
        if frame.split == "train":
            np.testing.assert_array_equal(pixels, load_rgb(scene.image_path(frame)))
        else:
            assert not pixels.any() and counts[got.frames.index(mine)] == 0


@pytest.mark.parametrize("format", ["chronoscene", "colmap-folders", "nerfstudio"])
def test_points_of_a_laser_scan_are_all_there(exported, make_scene, format):
    """No image observes them, and methods that are trained here start from all of them."""
    points = make_scene().points
    none = np.zeros(len(points.track_frame), bool)
    points = points.select_observations(none, np.arange(8, dtype=np.int32))
    _, got, _ = exported(format=format, points=points)
    np.testing.assert_allclose(got.points.xyz, points.xyz, atol=1e-6)


def test_the_bytes_of_test_photos_are_nowhere(exported, tmp_path):
    scene, got, _ = exported()
    photos = {load_rgb(scene.image_path(f)).tobytes() for f in scene.select(split="test")}
    assert not photos & {load_rgb(path).tobytes() for path in got.root.rglob("*.png")}


@pytest.mark.parametrize(("strategy", "frames"), [("pooled", 8), ("separate", 4)])
def test_hidden_periods_are_hidden_from_programs_too(exported, strategy, frames):
    scene, got, names = exported(strategy, part=-1)
    assert len(got.frames) == len(names) == frames and got.num_periods == 1
    expected = [f for f in scene.frames if strategy == "pooled" or f.period == 1]
    assert list(names) == [f.name for f in expected]
    assert len(got.points) == (11 if strategy == "pooled" else 6)


def test_photos_cameras_and_observations_have_the_size_of_the_evaluation(exported):
    scene, got, _ = exported(max_width=12)
    store = ImageStore(scene, max_width=12)
    for frame, mine in zip(scene.frames, got.frames, strict=True):
        assert mine.camera == store.camera(frame)
        if frame.split == "train":
            np.testing.assert_array_equal(load_rgb(got.image_path(mine)), store.load(frame))
    place = {tuple(xyz): i for i, xyz in enumerate(scene.points.xyz)}
    before = place[tuple(got.points.xyz[0])]
    start, end = got.points.track_start[:2]
    old = scene.points.track_xy[scene.points.track_start[before] :][: end - start]
    np.testing.assert_allclose(got.points.track_xy[start:end], old / 2)


def test_masks_are_of_all_images_or_of_none(exported, tmp_path):
    mask = tmp_path / "mask.png"
    grey = np.full((16, 24), 255, np.uint8)
    grey[:4] = 0
    Image.fromarray(grey).save(mask)
    _, got, names = exported(masks={"a/0.png": mask})
    assert set(got.masks) == set(names.values())
    np.testing.assert_array_equal(Image.open(got.masks[names["a/0.png"]]), grey)
    assert np.asarray(Image.open(got.masks[names["b/0.png"]])).min() == 255


@pytest.fixture(scope="session")
def other_python(tmp_path_factory):
    """An interpreter of another environment, without any package."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    return str(folder / "bin/python")


def test_a_program_in_another_environment_gets_a_row(bench_here, scene_folder, other_python):
    outcome, _ = bench_here("toy_programs:PROGRAM", overrides={"python": other_python}, seeds=(4,))
    assert outcome.failures == ()
    (folder,) = outcome.finished
    record = read_run(folder)
    scene = read_scene(scene_folder)
    photos = {f.name: load_rgb(scene.image_path(f)) for f in scene.frames}
    shown = {"a/2.png": "a/0.png", "b/1.png": "b/0.png", "b/2.png": "b/0.png"}
    expected = np.mean([psnr(photos[b], photos[a]) for a, b in shown.items()])
    assert record.aggregates["micro"]["psnr"] == pytest.approx(expected)
    assert (record.iterations, record.primitives, record.primitive) == (9, 7, "points")
    assert record.seconds > 0 and record.peak_memory_bytes > 0
    assert record.render_seconds is None and "render_seconds" in record.absent
    assert record.method_version.startswith("unpackaged; Python 3")
    model = {p.name: p.stat().st_size for p in (folder / "checkpoint/model").iterdir()}
    assert set(model) == {"points.ply", "seed.txt"}
    assert record.checkpoint_bytes == sum(model.values())
    assert (folder / "checkpoint/model/seed.txt").read_text() == "4"
    log = (folder / "program.log").read_text()
    assert log.count("$ ") == 3 and "training 9 0 4" in log
    assert not (folder / "work").exists()


def test_where_a_program_is_makes_no_other_run(bench_here):
    """The prefix names an environment: the run is the same, and finished."""
    bench_here("toy_programs:PROGRAM")
    _, said = bench_here("toy_programs:PROGRAM", overrides={"prefix": "env X=1", "source": "/src"})
    assert "1 of 1 runs are finished and kept" in said


def test_one_model_per_period(bench_here):
    outcome, _ = bench_here("toy_programs:PROGRAM", strategies=("separate",))
    (folder,) = outcome.finished
    record = read_run(folder)
    assert (record.iterations, record.primitives) == (9, 14)
    assert sorted(p.name for p in (folder / "checkpoint").iterdir()) == ["period-0", "period-1"]
    log = (folder / "program.log").read_text()
    assert "training 5 0 0" in log and "training 4 0 0" in log


def test_the_budget_is_passed_on(bench_here):
    outcome, _ = bench_here("toy_programs:PROGRAM", budget_seconds=90.0)
    record = read_run(outcome.finished[0])
    assert record.iterations is None and "iterations" in record.absent
    assert "training 9 90.0 0" in (outcome.finished[0] / "program.log").read_text()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("FAILING", r"found exit status 3; program\.log ends with: .*CUDA error: no device; corr"),
        ("ABSENT", r"no-such-program .*: expected a program that can be started, found No such"),
        ("NO_POINTS", r"model/cloud\.ply: expected a PLY file, found No such file"),
        ("LEAVES_NOTHING", r"elsewhere/\*: expected files of a model .* found none; look at"),
    ],
)
def test_a_program_that_fails_is_one_error_and_keeps_its_log(bench_here, tmp_path, name, message):
    outcome, _ = bench_here(f"toy_programs:{name}")
    (failure,) = outcome.failures
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(failure.reason)
    (folder,) = (tmp_path / "runs/ring").iterdir()
    assert (folder / "seed0/program.log").is_file() and not (folder / "seed0/work").exists()


def test_a_view_without_an_image_is_named(bench_here, monkeypatch):
    monkeypatch.setenv("TOY_FORGET", "1")
    outcome, _ = bench_here("toy_programs:PROGRAM")
    assert (
        "images/00002.png: expected an image of each of 3 test views" in outcome.failures[0].reason
    )


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("NAMED", {}, "named: commands: expected one of data, hold.* found 'datum'; did you mean"),
        ("FROM_SOURCE", {}, "from-source --set source: expected a value, .* pass --set source="),
        (
            "FROM_SOURCE",
            {"overrides": {"source": "x"}, "budget_seconds": 9.0},
            "--budget: expected",
        ),
        ("PROGRAM", {"overrides": {"prefix": "env 'A=1"}}, "prefix: .* found No closing quotation"),
        ("PROGRAM", {"overrides": {"prefix": "env {A"}}, "prefix: .* found expected '}' before"),
        ("OTHER_CONFIG", {}, "toy_methods:Config: expected a ProgramConfig, .* found Config"),
        ("PROGRAM", {"keep_training": True}, "expected methods that can be trained further"),
    ],
)
def test_settings_are_checked_before_anything_is_run(bench_here, name, changes, message):
    with pytest.raises(ConfigError, match=message):
        bench_here(f"toy_programs:{name}", **changes)


def test_its_model_cannot_be_opened_here(bench_here):
    outcome, _ = bench_here("toy_programs:PROGRAM")
    with pytest.raises(CheckpointError, match="found one of Program, which is another program"):
        open_run(outcome.finished[0], plugin="toy_programs:PROGRAM")
