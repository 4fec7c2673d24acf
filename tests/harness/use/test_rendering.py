"""``chronoscene render``: pictures of finished runs as files, and what it refuses."""

import errno
import os

import av
import numpy as np
import pytest
from command_line import succeed
from PIL import Image

from chronoscene.errors import CheckpointError, ConfigError, DiskFullError, SceneError
from chronoscene.harness.files.predictions import load_image, read_manifest
from chronoscene.harness.files.records import PREDICTIONS
from chronoscene.harness.use.trained_run import open_run

TOY = ("--plugin", "toy_methods:MEAN")


def render(folder, out, *options):
    result = succeed("render", folder, "--out", out, *options)
    assert f"wrote {out}" in result.stderr


@pytest.mark.parametrize("name", ["chronogs", "4dgs"])
def test_pictures_of_the_test_views_are_the_predictions(trained, tmp_path, name):
    folder = trained[name]
    render(folder, tmp_path / "out")
    entries = read_manifest(folder / PREDICTIONS).images
    assert len(entries) == 3
    for entry in entries:
        with Image.open(tmp_path / "out" / entry.file) as image:
            np.testing.assert_array_equal(image, load_image(folder / PREDICTIONS, entry))


def test_an_orbit_through_the_periods_as_a_film(trained, tmp_path):
    out = tmp_path / "film.mp4"
    options = ("--cameras", "orbit", "--period", "spring:autumn", "--frames", 5, "--fps", 10)
    render(trained["chronogs"], out, *options)
    with av.open(str(out)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 5 and frames[0].shape == (16, 24, 3)


def test_an_orbit_of_another_size_and_shape(trained, tmp_path):
    options = ("--cameras", "orbit", "--period", "0", "--frames", 2, "--size", "30x10")
    for radius in (3, 6):
        render(trained["chronogs"], tmp_path / str(radius), *options, "--radius", radius)
    near, far = (np.asarray(Image.open(tmp_path / r / "0000.png")) for r in ("3", "6"))
    assert near.shape == far.shape == (10, 30, 3) and (near != far).any()


@pytest.mark.parametrize("name", ["chronogs", "3dgs-period"])
def test_the_geometry_of_a_period_in_the_light_of_another(bench_here, name):
    outcome, _ = bench_here(name, preset="fast", iterations=60)  # long enough to tell two lights
    run = open_run(outcome.finished[0])
    frame = run.scene().frames[0]
    shown = {
        (p, q): run.render(frame.camera, frame.cam_from_world, p, appearance_period=q)
        for p in (0, 1)
        for q in (0, 1)
    }
    alone = run.render(frame.camera, frame.cam_from_world, 1)
    np.testing.assert_array_equal(shown[1, 1].rgb, alone.rgb)
    np.testing.assert_array_equal(shown[0, 1].alpha, shown[0, 0].alpha)
    assert np.abs(shown[0, 1].rgb - shown[0, 0].rgb).max() > 1e-4


def test_methods_without_geometry_of_their_own_refuse_another_light(runs, trained, tmp_path):
    message = "appearance of period 1: expected one model of all periods"
    for folder in (runs / "ring/mean-joint-balanced/seed0", trained["4dgs"]):
        with pytest.raises(ConfigError, match=message):
            render(folder, tmp_path / "out", "--appearance-period", "autumn", *TOY)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--period", "2"), "period 2: expected one from 0 to 1"),
        (("--period", "winter"), "period 'winter': .*choose among 0 .spring., 1 .autumn."),
        (("--period", "0:0.5"), "period 0.5: expected a whole number: 4DGS under strategy sep"),
        (("--cameras", "orbit"), "--period: expected a period"),
        (("--radius", 3), "--size, --radius, --height: expected --cameras orbit"),
        (("--cameras", "orbit", "--size", "0x9"), "--size: expected sides from 1 to 16384 pixels"),
        (("--cameras", "orbit", "--radius", 1e300), "--radius: expected at most 1e.12 units"),
        (("--cameras", "orbit", "--height", -1e308), "--height: .* of the scene, found -1e.308;"),
        (("--frames", 5), "--frames: expected no such option where cameras and periods give"),
        (("--fps", 5), "--fps: expected no such option for a folder of pictures"),
    ],
)
def test_what_a_run_cannot_show(trained, tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        render(trained["4dgs"], tmp_path / "out", *options)
    assert not list(tmp_path.iterdir())


def test_a_film_has_one_size(trained, tmp_path, monkeypatch):
    folder = trained["chronogs"]
    sizes = iter([(24, 16), (12, 8)] * 9)
    monkeypatch.setattr(
        "chronoscene.images.store.evaluation_size", lambda *size_and_limit: next(sizes)
    )
    with pytest.raises(ConfigError, match="expected cameras of one size, found 12 x 8, 24 x 16"):
        render(folder, tmp_path / "film.mp4")


def test_webp_has_a_largest_side(trained, tmp_path):
    options = ("--cameras", "orbit", "--period", "0", "--frames", "2", "--size", "16384x1")
    with pytest.raises(ConfigError, match=r"at most 16383 pixels a side.*found 16384 x 1"):
        render(trained["4dgs"], tmp_path / "film.webp", *options)
    assert not list(tmp_path.iterdir())


def test_places_that_are_refused(trained, scene_folder, tmp_path):
    folder = trained["chronogs"]
    with pytest.raises(ConfigError, match="a place outside the scene"):
        render(folder, scene_folder / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").touch()
    with pytest.raises(SceneError, match="a new or empty folder"):
        render(folder, tmp_path / "out")
    with pytest.raises(ConfigError, match=r"--out .*film.mp4: expected a file"):
        render(folder, tmp_path / "nowhere" / "film.mp4")
    with pytest.raises(ConfigError, match=r"that ends in .mp4 or .webp, found .*film.gif"):
        render(folder, tmp_path / "film.gif")


def test_a_run_without_a_model(runs, tmp_path):
    folder = runs / "ring/mean-separate-balanced/seed0"
    (folder / "checkpoint/period-1").rename(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="period-1: expected the model of the run"):
        render(folder, tmp_path / "out", *TOY)
    (folder / "checkpoint").rename(tmp_path / "checkpoint")
    with pytest.raises(CheckpointError, match="expected a run with a model"):
        render(folder, tmp_path / "out", *TOY)


def test_no_space_leaves_nothing_behind(runs, tmp_path, monkeypatch):
    def full(image):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("chronoscene.harness.use.rendering.encode_png", full)
    (tmp_path / "new").mkdir()
    with pytest.raises(DiskFullError, match="out: expected space"):
        render(runs / "ring/mean-joint-balanced/seed0", tmp_path / "new" / "out", *TOY)
    assert not list((tmp_path / "new").iterdir())
