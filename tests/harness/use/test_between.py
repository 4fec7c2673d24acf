"""``chronoscene compare --periods``: trained runs rendered between two dates."""

import csv
import io
import re
import shutil
from functools import partial

import numpy as np
import pytest
from command_line import invoke
from PIL import Image

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.files.records import CHECKPOINT, read_with_rows, write_run
from chronoscene.harness.score.between import FRACTIONS, BetweenScore, squared_distances
from chronoscene.harness.use.between import measure_between, parse_dates
from chronoscene.harness.use.trained_run import open_run
from chronoscene.images.truth import GEOMETRY, truth_place

CHANGED = np.zeros((16, 24), np.uint8)
CHANGED[:, :9] = GEOMETRY


@pytest.fixture
def runs(trained, tmp_path):
    """A copy of the trained runs, to write figures to."""
    return shutil.copytree(trained["chronogs"].parents[2], tmp_path / "runs")


@pytest.fixture
def scene(scene_folder, tmp_path):
    """The scene with change masks, and an image of one view at the other date."""
    root = shutil.copytree(scene_folder, tmp_path / "ring")
    for view, other in (("a/2.png", 1), ("b/1.png", 0), ("b/2.png", 0)):
        path = root / "gt" / truth_place("change", view, other)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(CHANGED).save(path)
    path = root / "gt" / truth_place("cross_rgb", "a/2.png", 1)
    path.parent.mkdir(parents=True)
    Image.fromarray(np.full((16, 24, 3), 128, np.uint8)).save(path)
    return root


compare = partial(invoke, "compare")


def test_a_figure_and_the_scores(runs, scene):
    result = compare(runs, "--periods", "0:1", "--scene", scene)
    assert result.exit_code == 0, result.output
    assert f"{3 * 16 * 9} pixels that change by the ground truth" in result.stdout
    lines = [line.strip() for line in result.stdout.splitlines()]
    (separate,) = [line for line in lines if line.startswith("4DGS")]
    assert separate.split()[-3:] == ["-", "-", "-"]
    assert sum(bool(re.search(r"\d\.\d{3}$", line)) for line in lines) == 2
    path = runs / "figures/ring_between_0_1.png"
    assert f"wrote {path}" in result.stderr
    assert Image.open(path).width > 1000


def test_scores_are_those_of_the_renders(trained, scene):
    run = open_run(trained["chronogs"])
    whole = run.scene(scene)
    found = measure_between([run], whole, (1, 0), "a/2.png", progress=lambda *done: None)
    sums = 0
    for frame in whole.select(split="test"):
        times = [1.0, *(1 - f for f in FRACTIONS), 0.0]
        images = [
            to_bytes(run.render(frame.camera, frame.cam_from_world, time).rgb) for time in times
        ]
        sums += squared_distances(images, CHANGED > 0)
        if frame.name == "a/2.png":
            for shown, image in zip(found.methods[0].images, images, strict=True):
                assert np.array_equal(shown, image)
    assert found.pixels == 3 * 16 * 9 and found.from_truth
    assert found.methods[0].score == BetweenScore.of(sums, found.pixels)
    other, photo = found.truths
    assert np.all(other == 128) and photo.std() > 0


def test_csv_without_masks_of_the_scene(runs, tmp_path):
    out = tmp_path / "between.csv"
    result = compare(runs, "--periods", "spring:autumn", "--format", "csv", "--out", out)
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert [row["mask"] for row in rows] == ["renders"] * 3
    assert {(row["scene"], row["from"], row["to"]) for row in rows} == {("ring", "0", "1")}
    assert len({row["pixels"] for row in rows}) == 1
    (separate,) = [row for row in rows if row["method"].startswith("4DGS")]
    assert separate["nearer_date"] == separate["ratio"] == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0:0", "expected two neighbouring periods"),
        ("1", "found one period"),
        ("0:0.5", "expected two neighbouring periods"),
        ("0:2", "period 2: expected one from 0 to 1"),
        ("0:winter", "period 'winter': expected one from 0 to 1"),
    ],
)
def test_periods_that_cannot_be(trained, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse_dates(open_run(trained["chronogs"]), text)


def test_images_of_other_programs_are_left_out(runs, scene):
    for folder in (runs / "ring").glob("3dgs*/seed0"):
        shutil.rmtree(folder / CHECKPOINT)
        run = read_with_rows(folder).model_copy(update={"threads": None})
        write_run(folder, run, run.rows)
    result = compare(runs, "--periods", "0:1", "--scene", scene)
    assert "seed 0: left out, as another program made its images" in result.stderr
    assert "ChronoGS" in result.stdout and "3DGS" not in result.stdout


def test_a_run_without_its_model(runs, scene):
    shutil.rmtree(next(runs.glob("ring/chronogs*/seed0/checkpoint")))
    with pytest.raises(CheckpointError, match="expected a run with a model"):
        compare(runs, "--periods", "0:1", "--scene", scene)
    assert not (runs / "figures").exists() or not any((runs / "figures").glob("*between*"))


@pytest.mark.parametrize("option", [("--views", 2), ("--metric", "psnr"), ("--html", "x.html")])
def test_options_without_effect_are_refused(runs, option):
    with pytest.raises(ConfigError, match=f"{option[0]}: expected no such option with --periods"):
        compare(runs, "--periods", "0:1", *option)


def test_a_scene_without_effect_is_refused(runs, scene):
    with pytest.raises(ConfigError, match="--scene: expected no such option without --periods"):
        compare(runs, "--scene", scene)
