"""Aggregates by hand, views matched with care, metrics that fail are absent with a reason."""

import json
import math

import numpy as np
import pytest

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.predictions import ImageWriter, encode_png
from chronoscene.harness.files.records import (
    ViewScore,
    read_rows,
    read_run,
    run_folders,
    write_run,
    write_summary,
)
from chronoscene.harness.score.scoring import aggregate, changes, rescore, score_folder
from chronoscene.metrics.registry import Scorers, make_scorers


def rows(metric, values):
    return [ViewScore(f"{i}.png", p, p, "all", metric, v) for i, (p, v) in enumerate(values)]


def test_macro_micro_and_worst_by_hand():
    aggregates, periods = aggregate(
        [
            *rows("psnr", [(0, 10.0), (0, 20.0), (0, 30.0), (1, 40.0), (2, 12.0)]),
            *rows("lpips_vgg", [(0, 0.1), (0, 0.3), (1, 0.5), (2, 0.2)]),
        ]
    )
    assert periods == {
        "0": {"psnr": 20.0, "lpips_vgg": 0.2},
        "1": {"psnr": 40.0, "lpips_vgg": 0.5},
        "2": {"psnr": 12.0, "lpips_vgg": 0.2},
    }
    assert aggregates["macro"] == {"psnr": 24.0, "lpips_vgg": pytest.approx(0.3)}
    assert aggregates["micro"] == {"psnr": 22.4, "lpips_vgg": pytest.approx(0.275)}
    assert aggregates["worst"] == {"psnr": 12.0, "lpips_vgg": 0.5}


def test_periods_are_in_order_of_their_numbers():
    _, periods = aggregate(rows("psnr", [(10, 1.0), (2, 2.0), (0, 3.0)]))
    assert list(periods) == ["0", "2", "10"]


def test_infinite_values_stay_infinite():
    aggregates, _ = aggregate(rows("psnr", [(0, math.inf), (1, 30.0)]))
    assert aggregates["macro"]["psnr"] == math.inf
    assert aggregates["worst"]["psnr"] == 30.0


def test_parts_of_the_image_do_not_enter_the_means():
    part = ViewScore("0.png", 0, 0, "changed", "psnr", 1.0)
    both = [*rows("psnr", [(0, 9.0)]), part]
    assert aggregate(both)[0]["micro"]["psnr"] == 9.0
    assert aggregate(both, "changed") == (
        {kind: {"psnr": 1.0} for kind in ("macro", "micro", "worst")},
        {"0": {"psnr": 1.0}},
    )


def write(folder, images, *, scene_hash="h", periods=None, masks=None):
    writer = ImageWriter(folder)
    for view, image in images.items():
        period = (periods or {}).get(view, 0)
        mask = (masks or {}).get(view)
        writer.add(view, image, camera_period=period, rendered_period=period, mask=mask)
    writer.close(kind="predictions", scene="s", scene_hash=scene_hash, details={})
    return folder


def noise(seed, shape=(12, 13, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_scores_are_those_of_the_metrics(tmp_path):
    periods = {"a.png": 0, "b.png": 1}
    truth = {"a.png": noise(0), "b.png": noise(1)}
    guess = {"a.png": noise(2), "b.png": noise(3)}
    scorers = make_scorers(["psnr", "ssim"])
    scores = score_folder(
        write(tmp_path / "p", guess, periods=periods),
        write(tmp_path / "t", truth, periods=periods),
        scorers,
    )
    found = {(r.view, r.camera_period, r.metric): r.value for r in scores.rows}
    assert found == {
        (view, periods[view], name): function(guess[view], truth[view])
        for view in truth
        for name, function in scorers.functions.items()
    }
    assert {r.region for r in scores.rows} == {"all"} and scores.skipped == {}


MASK = np.ones((12, 13), bool)
MASK[:, 12] = False


def test_what_a_mask_ignores_is_not_scored(tmp_path):
    """Neither in the pixels that count nor in the windows around them."""
    guess, photo, scores = {"a.png": noise(0), "b.png": noise(1)}, noise(2), []
    masks = {"a.png": MASK}
    truth = write(tmp_path / "t", {"a.png": photo, "b.png": photo}, masks=masks)
    scorers = make_scorers(["psnr", "ssim", "ssim_valid"])
    for k in range(2):
        guess["a.png"][:, 12] = 255 * k
        scores.append(score_folder(write(tmp_path / f"p{k}", guess), truth, scorers))
    assert scores[0] == scores[1] and scores[0].unscored == ()
    guess["a.png"][:, 12] = photo[:, 12]
    found = {(r.view, r.metric): r.value for r in scores[0].rows}
    for name, function in scorers.functions.items():
        assert found["a.png", name] == function(guess["a.png"], photo, MASK)
        assert found["b.png", name] == function(guess["b.png"], photo)


def test_the_half_that_was_fitted_to_is_not_scored(tmp_path):
    guess, photo, scorers = noise(0), noise(2), make_scorers(["psnr", "ssim"])
    truth = write(tmp_path / "t", {"a.png": photo}, masks={"a.png": MASK})
    right = MASK & (np.arange(13) >= 6)
    for k, changed in enumerate((guess, np.where(right[..., None], guess, 0))):
        predictions = write(tmp_path / f"p{k}", {"a.png": changed})
        scores = score_folder(predictions, truth, scorers, fitted="left half")
        outside = np.where(right[..., None], guess, photo)
        for row in scores.rows:
            assert row.value == scorers.functions[row.metric](outside, photo, right)


def test_views_of_which_nothing_counts_have_no_values(tmp_path):
    images, nothing = {"a.png": noise(0), "b.png": noise(1)}, np.zeros((12, 13), bool)
    predictions, scorers = write(tmp_path / "p", images), make_scorers(["psnr", "ssim"])
    truth = write(tmp_path / "t", images, masks={"a.png": nothing})
    scores = score_folder(predictions, truth, scorers)
    assert {r.view for r in scores.rows} == {"b.png"}
    assert scores.unscored == ("a.png",) and scores.skipped == {}
    truth = write(tmp_path / "u", images, masks=dict.fromkeys(images, nothing))
    scores = score_folder(predictions, truth, scorers)
    reason = "the masks of all test views ignore every pixel"
    assert scores.rows == () and scores.skipped == {"psnr": reason, "ssim": reason}


def test_a_metric_that_one_view_does_not_allow_is_absent_with_a_reason(tmp_path):
    images = {"a.png": noise(0), "b.png": noise(1, (8, 13, 3))}
    scores = score_folder(
        write(tmp_path / "p", images),
        write(tmp_path / "t", images),
        make_scorers(["ssim", "ssim_valid"]),
    )
    assert {r.metric for r in scores.rows} == {"ssim"}
    assert "b.png" in scores.skipped["ssim_valid"] and "11 x 11" in scores.skipped["ssim_valid"]


def test_a_metric_that_gives_no_number_is_absent_with_a_reason(tmp_path):
    """A record with NaN could not be read again."""
    images = {"a.png": noise(0), "b.png": noise(1)}
    predictions, truth = write(tmp_path / "p", images), write(tmp_path / "t", images)
    functions = {"psnr": lambda *given: 12.5, "ssim": lambda *given: math.nan}
    scores = score_folder(predictions, truth, Scorers(functions, {}))
    assert {r.metric for r in scores.rows} == {"psnr"}
    assert scores.skipped == {"ssim": "b.png: its value is not a number"}


def test_an_image_of_another_period_is_no_prediction_of_a_photo(tmp_path):
    truth = write(tmp_path / "t", {"a.png": noise(0)})
    writer = ImageWriter(tmp_path / "p")
    writer.add("a.png", noise(0), camera_period=0, rendered_period=1)
    writer.close(kind="predictions", scene="s", scene_hash="h", details={})
    with pytest.raises(CheckpointError, match=r"a difference at 'a\.png'"):
        score_folder(tmp_path / "p", truth, make_scorers(["psnr"]))


@pytest.mark.parametrize(
    ("guess", "scene_hash", "message"),
    [
        ({"a.png": noise(0)}, "h", "a difference at 'b.png'"),
        ({"a.png": noise(0), "b.png": noise(1), "c.png": noise(1)}, "h", "difference at 'c.png'"),
        ({"a.png": noise(0), "b.png": noise(1, (9, 9, 3))}, "h", "expected 13 x 12 pixels"),
        ({"a.png": noise(0), "b.png": noise(1)}, "other", "expected scene h"),
    ],
)
def test_folders_that_do_not_belong_together(tmp_path, guess, scene_hash, message):
    truth = write(tmp_path / "t", {"a.png": noise(0), "b.png": noise(1)})
    predictions = write(tmp_path / "p", guess, scene_hash=scene_hash)
    with pytest.raises(CheckpointError, match=message):
        score_folder(predictions, truth, make_scorers(["psnr"]))


def test_changes_are_told_in_words():
    def kinds(**values):
        return {kind: dict(values) for kind in ("macro", "micro", "worst")}

    before, after = kinds(psnr=20.0, ssim=0.5, lpips_vgg=0.1), kinds(psnr=21.0, ssim=0.5)
    assert changes(before, after) == ["psnr 20 -> 21 (macro)", "lpips_vgg dropped, was 0.1"]
    assert changes(after, before)[-1] == "lpips_vgg new: 0.1"
    assert changes(before, before) == []
    gone = "mae dropped, was 0.1"  # its package is not installed any more
    assert changes(kinds(mae=0.1), kinds()) == [gone]
    after = kinds(psnr=20.0, ssim=0.5, lpips_vgg=0.1)
    after["worst"]["ssim"] = 0.4
    assert changes(before, after) == ["ssim 0.5 -> 0.5 (macro)"]


JOINT = "ring/mean-joint-balanced/seed0"


@pytest.fixture
def scorers():
    return make_scorers(["psnr", "ssim", "ssim_valid"])


def test_scoring_again_changes_nothing(runs, scorers):
    before = {p: p.read_bytes() for p in runs.rglob("rows.csv")}
    records = [read_run(p) for p in run_folders(runs)]
    told = []
    outcomes = rescore(runs, scorers, progress=lambda done, total: told.append((done, total)))
    assert len(outcomes) == 4 and told == [(done, 4) for done in range(4)]
    assert all(not o.changes and o.error is None for o in outcomes)
    assert {p: p.read_bytes() for p in runs.rglob("rows.csv")} == before
    for old, folder in zip(records, run_folders(runs), strict=True):
        new = read_run(folder)
        assert (new.aggregates, new.periods) == (old.aggregates, old.periods)
        assert (new.seconds, new.peak_memory_bytes) == (old.seconds, old.peak_memory_bytes)


def test_a_corrected_metric_is_told_and_written(runs):
    before = read_run(runs / JOINT).aggregates["macro"]["psnr"]
    outcomes = rescore(runs, Scorers({"psnr": lambda image, reference, mask: 12.5}, {}))
    told = {str(o.folder.relative_to(runs)): o.changes for o in outcomes}
    assert told[JOINT][0] == f"psnr {before:.6g} -> 12.5 (macro)"
    assert any("ssim dropped" in change for change in told[JOINT])
    for folder in run_folders(runs):
        assert read_run(folder).aggregates["worst"] == {"psnr": 12.5}
    document = json.loads((runs / "results.json").read_text())
    assert {run["aggregates"]["micro"]["psnr"] for run in document} == {12.5}
    assert all(
        line.endswith("psnr,12.5")
        for line in (runs / "rows.csv").read_text().split()[1:]
        if "psnr" in line
    )


def test_an_edited_image_is_an_error_for_its_run_only(runs, scorers):
    path = runs / JOINT / "predictions/a/2.png.png"
    path.write_bytes(encode_png(np.zeros((16, 24, 3), np.uint8)))
    before = (runs / JOINT / "run.json").read_bytes()
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, scorers)}
    assert "SHA-256" in outcomes[JOINT].error and "2.png.png" in outcomes[JOINT].error
    assert (runs / JOINT / "run.json").read_bytes() == before
    assert [o.error for name, o in outcomes.items() if name != JOINT] == [None] * 3


def test_a_damaged_record_is_an_error_for_its_run_only(runs, scorers):
    (runs / JOINT / "run.json").write_text("{")
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, scorers)}
    assert "run.json" in outcomes[JOINT].error
    assert [o.error for name, o in outcomes.items() if name != JOINT] == [None] * 3
    assert len(json.loads((runs / "results.json").read_text())) == 3


def test_rows_that_are_gone_are_an_error_for_their_run_only(runs):
    (runs / JOINT / "rows.csv").unlink()
    found = rescore(runs, make_scorers(["psnr"]))  # the others keep their values
    outcomes = {str(o.folder.relative_to(runs)): o for o in found}
    assert "rows.csv" in outcomes[JOINT].error
    assert [o.error for name, o in outcomes.items() if name != JOINT] == [None] * 3
    assert len(json.loads((runs / "results.json").read_text())) == 3
    with pytest.raises(CheckpointError, match=r"rows\.csv: expected a text file, found nothing"):
        write_summary(runs)


def test_values_of_a_metric_that_is_not_installed_are_not_lost(runs, scorers):
    path = runs / JOINT / "rows.csv"
    before = (runs / JOINT / "run.json").read_text().replace('"psnr"', '"mae"')
    (runs / JOINT / "run.json").write_text(before)
    path.write_text(path.read_text().replace(",psnr,", ",mae,"))
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, scorers)}
    assert "metrics that are installed, found 'mae'" in outcomes[JOINT].error
    assert (runs / JOINT / "run.json").read_text() == before


def test_reasons_for_the_absence_of_other_metrics_are_kept(runs):
    record = read_run(runs / JOINT)
    record.skipped = {"lpips_vgg": "no weights", "ssim_cc": "too small"}
    write_run(runs / JOINT, record, read_rows(runs / JOINT))
    rescore(runs, make_scorers(["psnr", "ssim_cc"]))
    assert read_run(runs / JOINT).skipped == {"lpips_vgg": "no weights"}


def test_edited_ground_truth_is_an_error(runs, scorers):
    path = runs / "ground_truth/ring/b/1.png.png"
    path.write_bytes(path.read_bytes() + b"\0")
    assert all("SHA-256" in o.error for o in rescore(runs, scorers))


def test_metrics_that_this_machine_lacks_keep_their_values(runs, scorers):
    record, rows = read_run(runs / JOINT), read_rows(runs / JOINT)
    rows += [
        ViewScore(v, p, p, "all", "lpips_vgg", 0.25) for v, p in (("a/2.png", 0), ("b/1.png", 1))
    ]
    for values in (*record.aggregates.values(), *record.periods.values()):
        values["lpips_vgg"] = 0.25
    write_run(runs / JOINT, record, rows)
    lacking = Scorers(scorers.functions, {"lpips_vgg": "no weights"})
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, lacking)}
    assert outcomes[JOINT].kept == ["lpips_vgg"] and outcomes[JOINT].changes == []
    again = read_run(runs / JOINT)
    assert again.aggregates["macro"]["lpips_vgg"] == 0.25 and again.skipped == {}
    assert read_run(runs / "ring/mean-pooled-balanced/seed0").skipped == {"lpips_vgg": "no weights"}


def test_a_folder_without_runs(tmp_path, scorers):
    with pytest.raises(CheckpointError, match="no finished run in it; run bench first"):
        rescore(tmp_path, scorers)


def test_stages_are_scored_again_and_keep_what_cannot_be_computed(bench_here, tmp_path):
    outcome, _ = bench_here("toy_methods:MEAN", strategies=("sequential",))
    folder, runs = outcome.finished[0], tmp_path / "runs"
    record = read_run(folder)
    right = record.stages["period-0"]["0"]["psnr"]
    record.stages["period-0"]["0"] |= {"psnr": 1.0, "lpips_vgg": 0.5}
    write_run(folder, record, read_rows(folder))
    rescore(runs, make_scorers())
    again = read_run(folder)
    assert again.stages["period-0"]["0"]["psnr"] == right
    assert again.stages["period-0"]["0"]["lpips_vgg"] == 0.5
    (folder / "stages/period-0/a/2.png.png").unlink()
    (rescored,) = rescore(runs, make_scorers())
    assert "2.png.png: expected an image" in rescored.error
