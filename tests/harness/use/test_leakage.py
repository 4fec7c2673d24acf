"""Leakage of constructed images has closed forms; a run is measured against files of the truth."""

import csv
import io
import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import succeed
from PIL import Image

from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.files.records import ViewScore, read_rows
from chronoscene.harness.use.leakage import (
    depth_values,
    leakage_table,
    measure_leakage,
    pair_values,
)
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.images.decoding import load_rgb
from chronoscene.images.store import ImageStore
from chronoscene.images.truth import APPEARANCE, GEOMETRY, truth_place
from chronoscene.metrics.psnr_ssim import psnr

ALL = np.ones((6, 8), bool)
CHANGED = np.zeros((6, 8), bool)
CHANGED[:, :3] = True
CHANGES = np.where(CHANGED, GEOMETRY, 0).astype(np.uint8)
CHANGES[0, :3] = APPEARANCE


@pytest.fixture
def truths():
    """Two periods that differ in three columns alone."""
    rng = np.random.default_rng(0)
    own = 2 * rng.integers(0, 128, (6, 8, 3))
    other = np.where(CHANGED[..., None], 2 * rng.integers(0, 128, own.shape), own)
    return own.astype(np.uint8), other.astype(np.uint8)


def values_of(own, other, truths, counted=ALL):
    return pair_values(own, other, *truths, CHANGES, counted)


def test_a_perfect_model(truths):
    values = values_of(*truths, truths)
    assert values["changed", "ghosting"] == 0
    assert values["changed", "sensitivity"] == pytest.approx(1)
    assert values["all", "change_ap"] == values["all", "change_ap_geometry"] == 1
    assert values["all", "change_ap_appearance"] == 1
    for key in (("changed", "psnr"), ("invariant", "psnr"), ("invariant", "consistency")):
        assert values[key] == math.inf
    assert values["invariant", "consistency_truth"] == math.inf


def test_a_model_that_cannot_tell_the_periods_apart(truths):
    """It shows their mean, which is exact in bytes as all values are even."""
    mean = ((truths[0].astype(int) + truths[1]) // 2).astype(np.uint8)
    values = values_of(mean, mean, truths)
    assert values["changed", "ghosting"] == pytest.approx(0.5)
    assert values["changed", "sensitivity"] == 0
    assert values["invariant", "consistency"] == math.inf
    assert values["all", "change_ap"] == 3 / 8  # the share of changed pixels


def test_a_model_that_mixes_the_periods_up(truths):
    values = values_of(*truths[::-1], truths)
    assert values["changed", "ghosting"] == pytest.approx(1)
    assert values["changed", "sensitivity"] == pytest.approx(-1)
    assert values["changed", "psnr"] == psnr(*truths, CHANGED)


def test_a_flicker_where_nothing_changed(truths):
    own, other = truths[0], truths[1].copy()
    other[:, 3:] = np.where(other[:, 3:] > 127, other[:, 3:] - 51, other[:, 3:] + 51)
    values = values_of(own, other, truths)
    assert values["invariant", "consistency"] == pytest.approx(-20 * math.log10(0.2))
    assert values["invariant", "psnr"] == values["invariant", "consistency"]
    assert values["invariant", "consistency_truth"] == math.inf
    assert values["changed", "sensitivity"] == pytest.approx(1)
    assert values["all", "change_ap"] < 1


def test_without_truth_of_the_other_period(truths):
    own, other = truths
    images = own, other, own, None
    assert {key[1] for key in pair_values(*images, CHANGES, ALL)} == {
        *("change_ap", "change_ap_geometry", "change_ap_appearance", "consistency")
    }
    everywhere = np.full(CHANGES.shape, GEOMETRY)
    values = pair_values(*images, everywhere, ALL)
    assert {key[1] for key in values} == {"change_ap", "change_ap_geometry"}


def test_pixels_that_do_not_count(truths):
    own, other = truths
    other = other.copy()
    other[:, 7] = 255 - other[:, 7]
    assert values_of(own, other, truths)["invariant", "psnr"] < math.inf
    counted = ALL.copy()
    counted[:, 7] = False
    assert values_of(own, other, truths, counted)["invariant", "psnr"] == math.inf


def test_pixels_that_do_not_count_are_in_no_value(truths):
    """All values are those of images without these pixels."""
    rng = np.random.default_rng(1)
    photo, other = truths
    other = other.copy()
    other[:, 7] ^= 1  # where nothing changed, the light is another
    shown = rng.integers(0, 256, (2, 6, 8, 3)).astype(np.uint8)
    counted = ALL.copy()
    counted[:, [0, 7]] = False
    images = (*shown, photo, other, CHANGES, counted)
    expected = pair_values(*(image[:, 1:7] for image in images))
    assert {region for region, _ in expected} == {"all", "changed", "invariant"}
    assert pair_values(*images) == pytest.approx(expected)


def test_depth_counts_where_pixels_do():
    depth, counted = np.full((6, 8), 2.2), ALL.copy()
    depth[:, 0], counted[:, 0] = 9.0, False
    assert depth_values(depth, np.full((6, 8), 2.0), counted) == pytest.approx(
        {("all", "depth_abs_rel"): 0.1, ("all", "depth_rmse"): 0.2, ("all", "depth_delta"): 1.0}
    )
    assert depth_values(depth, np.where(counted, 0.0, 2.0), counted) == {}


def test_masks_of_photos_and_all_other_periods(make_scene, tmp_path):
    """Three periods; a view of which nothing counts is left out."""
    mask = np.zeros((16, 24), bool)
    mask[:, 5:] = True
    masks = {"a/2.png": mask, "b/1.png": np.zeros((16, 24), bool)}
    for name, values in masks.items():
        Image.fromarray(values).save(tmp_path / name.replace("/", "_"))
    scene = make_scene(masks={name: tmp_path / name.replace("/", "_") for name in masks})
    rng = np.random.default_rng(2)
    shown = rng.random((3, 16, 24, 3))
    for other in (1, 2):
        path = tmp_path / truth_place("cross_rgb", "a/2.png", other)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), dtype=np.uint8)).save(path)
    run = SimpleNamespace(
        photos=ImageStore,
        num_periods=3,
        render=lambda camera, pose, period: SimpleNamespace(rgb=shown[period], depth=None),
    )
    found = {rows[0].view: rows for rows in measure_leakage(run, scene, tmp_path)}
    assert found.keys() == {"a/2.png", "b/2.png"}
    truths = [load_rgb(scene.images_root / "a/2.png")]
    truths += [load_rgb(tmp_path / truth_place("cross_rgb", "a/2.png", p)) for p in (1, 2)]
    assert [(row.rendered_period, row.value) for row in found["a/2.png"]] == [
        (p, psnr(to_bytes(shown[p]), truths[p], mask)) for p in range(3)
    ]


def test_depth_of_the_size_of_the_truth_only():
    depth = np.full((6, 8), 2.2)
    values = depth_values(depth, np.full((6, 8), 2.0), ALL)
    assert values["all", "depth_abs_rel"] == pytest.approx(0.1)
    assert depth_values(depth, np.ones((3, 4)), ALL) == {}
    assert depth_values(depth, np.zeros((6, 8)), ALL) == {}


def test_the_table_has_means_over_views_and_pairs():
    values = {(0, 0): (20, 30), (0, 1): (10,), (1, 0): (13, 17), (1, 1): (40,)}
    rows = [ViewScore(str(i), *pair, "all", "psnr", v) for pair in values
            for i, v in enumerate(values[pair])]  # fmt: skip
    rows.append(ViewScore("0", 0, 1, "changed", "ghosting", 0.25))
    table = leakage_table(rows, {"0": "may", "1": "june"}, "title")
    assert table.heads == ["camera of", "rendered", "PSNR [dB]", "ghosting"]
    assert table.rows == [
        ["may", "may", "25.00", "-"],
        ["may", "june", "10.00", "0.250"],
        ["june", "may", "15.00", "-"],
        ["june", "june", "40.00", "-"],
        ["mean", "own", "32.50", "-"],
        ["mean", "another", "12.50", "0.250"],
    ]


@pytest.fixture
def run(trained):
    return open_run(trained["chronogs"])


@pytest.fixture
def truth(run, write_truth, tmp_path):
    return write_truth(run.scene(), tmp_path / "gt")


leakage = partial(succeed, "leakage")


def test_a_run_is_measured(run, truth):
    text = leakage(run.folder, "--truth", truth, "--format", "csv").stdout
    found = {
        (r["view"], int(r["rendered_period"]), r["region"], r["metric"]): float(r["value"])
        for r in csv.DictReader(io.StringIO(text))
    }
    for row in read_rows(run.folder):  # at the period of the photo, what bench measured
        if row.metric == "psnr":
            assert found[row.view, row.camera_period, "all", "psnr"] == row.value
    for frame in run.scene().select(split="test"):
        own, other = frame.period, 1 - frame.period
        predictions = [run.render(frame.camera, frame.cam_from_world, p) for p in (own, other)]
        photo = load_rgb(truth / truth_place("cross_rgb", frame.name, other))
        image = to_bytes(predictions[1].rgb)
        mask = np.arange(24) < np.full((16, 1), 9)
        assert found[frame.name, other, "all", "psnr"] == psnr(image, photo)
        assert found[frame.name, other, "invariant", "psnr"] == psnr(image, photo, ~mask)
        error = np.abs(predictions[0].depth - 3).mean() / 3
        assert found[frame.name, own, "all", "depth_abs_rel"] == pytest.approx(error, rel=1e-5)
        assert (frame.name, other, "all", "depth_abs_rel") not in found


def test_the_command_prints_a_table(run, truth, tmp_path):
    result = leakage(run.folder, "--truth", truth, "--format", "markdown", "--out", tmp_path / "x")
    lines = (tmp_path / "x").read_text().splitlines()
    assert lines[0] == "**ring: chronogs joint fast iterations=12 seed 0**"
    measures = [f"{name} [dB]" for name in ("PSNR", "PSNR changed", "PSNR invariant")]
    assert [head.strip() for head in lines[2].split("|")[3:6]] == measures
    assert [line.split("|")[1:3] for line in lines[4:]] == [
        *([" spring ", f" {label} "] for label in ("spring", "autumn")),
        *([" autumn ", f" {label} "] for label in ("spring", "autumn")),
        *([" mean ", f" {kind} "] for kind in ("own", "another")),
    ]
    assert "no truth, or nothing rendered, for: AP appearance, AbsRel, RMSE, delta" in result.stderr


def test_a_scene_without_truth_is_refused_before_long_work(run, monkeypatch):
    monkeypatch.setattr(TrainedRun, "render", pytest.fail)
    with pytest.raises(ConfigError, match=r"gt: expected change masks, .*found none .* --truth"):
        leakage(run.folder)
