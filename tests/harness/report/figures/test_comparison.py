"""Figures show the right images: compared by the pixels that are drawn."""

import cv2
import numpy as np
from matplotlib.figure import Figure

from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter, load_image, read_manifest
from chronoscene.harness.files.records import read_run
from chronoscene.harness.report.figures.comparison import (
    ShownRun,
    _draw_row,
    chosen_views,
    draw_figures,
    first_seeds,
    mean_error,
    where_methods_differ,
)
from chronoscene.harness.report.summary import read_runs

JOINT = "ring/mean-joint-balanced/seed0"


def test_every_scene_gets_its_figures(runs):
    paths = draw_figures(runs, read_runs([runs])[0])
    assert [p.name for p in paths] == ["ring_comparison.png", "ring_errors.png"]
    image = cv2.imread(str(paths[0]))[..., ::-1]
    # Photos and predictions are there, each larger than a cell's half: nearly constant colours.
    truth = ground_truth_folder(runs, "ring")
    pooled = runs / "ring/mean-pooled-balanced/seed0/predictions"
    for folder in (truth, pooled):
        for entry in read_manifest(folder).images:
            color = load_image(folder, entry).mean(axis=(0, 1))
            assert (np.abs(image - color).max(axis=2) < 14).mean() > 0.02, entry
    assert image.shape[1] > 1200 and image.shape[0] > 500
    assert not list((runs / "figures").glob(".*"))


def test_views_are_spread_over_the_periods(runs):
    truth = ground_truth_folder(runs, "ring")
    assert [e.view for e in chosen_views(truth, 1)] == ["a/2.png", "b/2.png"]
    assert [e.view for e in chosen_views(truth, 5)] == ["a/2.png", "b/1.png", "b/2.png"]


def test_one_column_per_method_and_strategy(runs):
    record = read_run(runs / JOINT)
    later = record.model_copy(update={"seed": 4})
    other = record.model_copy(update={"strategy": "pooled"})
    for name, run in zip("abc", (other, record, later), strict=True):
        run.folder = runs / name
    assert first_seeds([later, record, other]) == [other, record]


def test_error_is_the_mean_over_channels():
    black = np.zeros((2, 2, 3), np.uint8)
    image = black.copy()
    image[0, 0] = (255, 0, 51)
    np.testing.assert_allclose(mean_error(image, black), [[0.4, 0], [0, 0]])
    np.testing.assert_allclose(mean_error(black, image), [[0.4, 0], [0, 0]])
    mask = np.array([[False, True], [True, True]])
    np.testing.assert_equal(mean_error(image, black, mask), [[np.nan, 0], [0, 0]])


def test_what_a_mask_ignores_is_neither_error_nor_psnr(tmp_path):
    photo, mask = np.zeros((8, 8, 3), np.uint8), np.eye(8, dtype=bool)
    image = np.where(mask[..., None], photo + 51, 200).astype(np.uint8)
    for name, pixels, masks in (("t", photo, (mask, mask & False)), ("p", image, (None, None))):
        writer = ImageWriter(tmp_path / name)
        for view, one in zip(("a", "b"), masks, strict=True):
            writer.add(view, pixels, camera_period=0, rendered_period=0, mask=one)
        writer.close(kind="predictions", scene="s", scene_hash="h", details={})
    entries = {entry.view: entry for entry in read_manifest(tmp_path / "p").images}
    for entry, label in zip(read_manifest(tmp_path / "t").images, ("13.98", "not"), strict=True):
        axes = Figure().subplots(1, 2, squeeze=False)
        column = ShownRun("", tmp_path / "p", entries)
        shown = _draw_row(axes, tmp_path / "t", entry, [column], {}, errors=True)
        assert axes[0, 1].get_xlabel().startswith(label)
        drawn = np.ma.filled(shown.get_array().astype(float), np.nan)
        if label != "not":
            np.testing.assert_allclose(drawn[mask], 0.2)
        assert np.isnan(drawn[~mask]).all()


def test_the_half_that_was_fitted_to_is_neither_error_nor_psnr(tmp_path):
    photo = np.zeros((8, 8, 3), np.uint8)
    image = photo.copy()
    image[:, 4:] = 51
    for name, pixels in (("t", photo), ("p", image)):
        writer = ImageWriter(tmp_path / name)
        writer.add("v", pixels, camera_period=0, rendered_period=0)
        writer.close(kind="predictions", scene="s", scene_hash="h", details={})
    (entry,) = read_manifest(tmp_path / "t").images
    axes = Figure().subplots(1, 2, squeeze=False)
    column = ShownRun("", tmp_path / "p", {"v": entry}, fitted="left half")
    column.entries["v"] = read_manifest(tmp_path / "p").images[0]
    shown = _draw_row(axes, tmp_path / "t", entry, [column], {}, errors=True)
    assert axes[0, 1].get_xlabel() == "13.98 dB"
    drawn = np.ma.filled(shown.get_array().astype(float), np.nan)
    assert np.isnan(drawn[:, :4]).all() and np.allclose(drawn[:, 4:], 0.2)


def test_what_is_enlarged_is_where_methods_differ():
    both, one = np.zeros((2, 40, 60))
    both[0:10, 0:15] = 0.9  # what all methods get wrong tells them apart nowhere
    one[22:28, 31:37] = 0.2
    rows, columns = where_methods_differ([both, both + one, both])
    assert (rows.stop - rows.start, columns.stop - columns.start) == (10, 15)
    assert rows.start <= 22 and rows.stop >= 28 and columns.start <= 31 and columns.stop >= 37
    masked = np.where(one > 0, np.nan, both)
    assert where_methods_differ([masked + one / 2]) == (slice(0, 10), slice(0, 15))
    assert where_methods_differ([np.zeros((1, 3))]) == (slice(0, 1), slice(0, 1))
    far = np.zeros((40, 60))
    far[-1, -1] = 1
    assert where_methods_differ([far, both * 0]) == (slice(30, 40), slice(45, 60))


def test_the_window_is_enlarged_below_each_image(tmp_path):
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    wrong = photo.copy()
    wrong[6:12, 8:16] //= 2
    columns = []
    for name, pixels in (("t", photo), ("good", photo), ("bad", wrong)):
        writer = ImageWriter(tmp_path / name)
        writer.add("v", pixels, camera_period=0, rendered_period=0)
        writer.close(kind="predictions", scene="s", scene_hash="h", details={})
        entries = {entry.view: entry for entry in read_manifest(tmp_path / name).images}
        columns.append(ShownRun(name, tmp_path / name, entries))
    (entry,) = columns[0].entries.values()
    axes = Figure().subplots(2, 3)
    _draw_row(axes, tmp_path / "t", entry, columns[1:], {}, errors=False)
    for column, pixels in zip(axes.T, (photo, photo, wrong), strict=True):
        full, enlarged = (axis.get_images()[0].get_array() for axis in column)
        np.testing.assert_array_equal(full, pixels)
        np.testing.assert_array_equal(enlarged, pixels[6:12, 8:16])
        (frame,) = column[0].patches
        assert (*frame.get_xy(), frame.get_width(), frame.get_height()) == (7.5, 5.5, 8, 6)
