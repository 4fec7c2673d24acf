"""Images of other programs: found by name or by a table, of two sizes, scored as any run."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import CheckpointError, ConfigError, ImageError, SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.files.records import read_rows, read_run
from chronoscene.harness.report.summary import read_runs
from chronoscene.harness.report.tables import format_runs
from chronoscene.harness.score.images import find_images, score_images
from chronoscene.harness.score.scoring import rescore
from chronoscene.images.decoding import load_rgb
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.metrics.registry import make_scorers

VIEWS = ("a/2.png", "b/1.png", "b/2.png")


@pytest.fixture
def scene(scene_folder):
    return read_scene(scene_folder)


@pytest.fixture
def images(tmp_path):
    """A grey image of each test view."""
    folder = tmp_path / "images"
    for view in VIEWS:
        (folder / view).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (24, 16), (90, 90, 90)).save(folder / view)
    return folder


@pytest.fixture
def score(scene, images, tmp_path):
    def run(**options):
        chosen = {"max_width": 1600, "name": "Some Program 2", "runs": tmp_path / "runs", **options}
        scorers = make_scorers(["psnr", "ssim"])
        return score_images(chosen.pop("scene", scene), images, scorers=scorers, **chosen)

    return run


def test_the_row_has_the_values_of_the_images(score, scene, tmp_path):
    folder = score()
    assert folder == tmp_path / "runs/ring/Some-Program-2-external-images/seed0"
    found = {row.view: row.value for row in read_rows(folder) if row.metric == "psnr"}
    grey = np.full((16, 24, 3), 90, np.uint8)
    frames = {frame.name: frame for frame in scene.frames}
    photos = {view: load_rgb(scene.image_path(frames[view])) for view in VIEWS}
    assert found == {view: psnr(grey, photo) for view, photo in photos.items()}
    record = read_run(folder)
    assert record.aggregates["micro"]["psnr"] == pytest.approx(np.mean(list(found.values())))
    assert (record.seconds, record.primitives, record.peak_memory_bytes) == (None, None, None)
    assert set(record.absent) >= {"seconds", "peak_memory_bytes"} and record.notices == []


def test_transparent_images_are_refused_and_an_opaque_alpha_channel_is_not(score, images):
    first, second = images / VIEWS[0], images / VIEWS[1]
    Image.new("RGBA", (24, 16), (90, 90, 90, 255)).save(first)
    assert read_run(score()).notices == []
    Image.new("RGBA", (24, 16), (90, 90, 90, 254)).save(second)
    with pytest.raises(ImageError, match=r"1\.png: expected an image without transparent pixels"):
        score(seed=1)


def test_the_run_stands_beside_those_of_bench(score, bench_here, tmp_path):
    bench_here("toy_methods:MEAN", iterations=5)
    score()
    score(seed=1)
    text = format_runs(*read_runs([tmp_path / "runs"]), "table")
    assert (
        "Some Program 2 (external, images)" in text
        and "Mean (joint, balanced, iterations=5)" in text
    )
    why = "Some Program 2 is another program, and only its images are here"
    assert "absent: training [s], iterations, primitives, rendering [ms], checkpoint [MB]" in text
    assert why in text
    (again, *_) = rescore(tmp_path / "runs", make_scorers(["psnr", "ssim"]))
    assert again.error is None and again.changes == []


def test_a_table_of_foreign_runs_alone_has_no_costs(score, tmp_path):
    score()
    text = format_runs(*read_runs([tmp_path / "runs"]), "table", ["psnr"])
    assert "ring: PSNR [dB] (psnr)" in text and "ring: cost" not in text
    entries = json.loads(format_runs(*read_runs([tmp_path / "runs"]), "json"))["entries"]
    assert {entry["quantity"] for entry in entries} == {"psnr", "ssim"}


def test_full_size_is_resized_by_the_rule_of_the_photos(score, scene, images):
    rng = np.random.default_rng(0)
    for view in VIEWS:
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), dtype=np.uint8)).save(images / view)
    Image.open(images / VIEWS[2]).resize((12, 8), Image.Resampling.BICUBIC).save(images / VIEWS[2])
    folder = score(max_width=12)
    for view in VIEWS:
        expected = load_rgb(images / view, size=(12, 8))
        np.testing.assert_array_equal(load_rgb(folder / f"predictions/{view}.png"), expected)
    assert "2 images of full size resized like the photos" in read_run(folder).notices[0]


def test_another_size_is_refused(score, images, tmp_path):
    Image.new("RGB", (23, 16)).save(images / VIEWS[1])
    message = r"b/1\.png: expected 12 x 8 or 24 x 16 pixels, .* found 23 x 16"
    with pytest.raises(ImageError, match=message):
        score(max_width=12)
    assert not (tmp_path / "runs/ring").exists()


def test_names_of_files(scene, images):
    """The extension of the photo may stay, and folders are not needed where files tell apart."""
    (images / "b/2.png").rename(images / "b/2.png.png")
    (images / "b/1.png").rename(images / "b/1.jpg")
    with pytest.raises(ImageError, match=r"found no image of 'b/1\.png'; name"):
        find_images(images, scene)
    (images / "b/1.jpg").rename(images / "b/1.png")
    assert find_images(images, scene)["b/2.png"] == images / "b/2.png.png"
    frames = [replace(f, name=f"{f.image_id}/{f.image_id}.JPG") for f in scene.frames]
    tests = [frame for frame in frames if frame.split == "test"]
    shutil.rmtree(images)
    images.mkdir()
    for frame in tests:
        (images / f"{frame.image_id}.png").touch()
    found = find_images(images, replace(scene, frames=tuple(frames)))
    assert found == {f.name: images / f"{f.image_id}.png" for f in tests}


def test_missing_extra_and_misnamed_images_are_named_at_once(scene, images):
    (images / "b/2.png").rename(images / "b/7.png")
    shutil.copy(images / "a/2.png", images / "a/1.png")  # a training view
    shutil.copy(images / "a/2.png", images / "2.png")  # of a/2 or b/2
    message = (
        r"images: expected one PNG image of each of 3 test views, found no image of 'b/2\.png'; "
        r"'2\.png', 'a/1\.png', 'b/7\.png', which is not the one file of one test view; name"
    )
    with pytest.raises(ImageError, match=message):
        find_images(images, scene)


def test_a_table_says_which_file_shows_which_view(scene, images, tmp_path):
    (images / "b/2.png").rename(images / "00002.png")
    (images / "more.png").write_bytes(b"is not looked at")
    table = tmp_path / "map.csv"
    table.write_text("view,file\na/2.png,a/2.png\nb/1,b/1.png\nb/2.png,00002.png\n")
    found = find_images(images, scene, table)
    assert {view: path.name for view, path in found.items()} == dict(
        zip(VIEWS, ("2.png", "1.png", "00002.png"), strict=True)
    )
    table.write_text("view,file\na/2.png,a/2.png\na/2.png,b/1.png\nb/9.png,00002.png\n")
    with pytest.raises(ImageError, match=r"no image of 'b/1.*'b/1\.png', '00002\.png', which"):
        find_images(images, scene, table)
    table.write_text("image,view\na,b\n")
    with pytest.raises(SceneError, match="expected the columns file and view"):
        find_images(images, scene, table)


@pytest.mark.parametrize("name", ["", "///"])
def test_a_name_that_says_nothing_is_refused(score, name):
    with pytest.raises(ConfigError, match="--name: expected letters or digits"):
        score(name=name)


def test_a_second_run_of_the_name_is_refused(score):
    before = (score() / "run.json").read_bytes()
    with pytest.raises(ConfigError, match="choose another --name or --seed, or delete it"):
        score()
    assert (score(seed=1).parent / "seed0/run.json").read_bytes() == before


def test_a_scene_without_test_views_is_refused(score, scene):
    frames = [replace(frame, split="train") for frame in scene.frames]
    with pytest.raises(SceneError, match="expected test views to score, found none"):
        score(scene=scene.with_frames(frames))


def test_there_is_no_model_to_open(score):
    from chronoscene.harness.use.trained_run import open_run

    with pytest.raises(CheckpointError, match="expected a run with a model"):
        open_run(score())
