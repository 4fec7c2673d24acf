"""Colours, densities, limits and the files of the figures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.figures import canvas, projections
from chronoscene.figures.bars import _period_names, draw_bars
from chronoscene.figures.canvas import EIGHT, FOUR, period_colors, rgb_of
from chronoscene.figures.cloud import Cloud, shown_box
from chronoscene.figures.density_map import (
    MIN_OPACITY,
    Window,
    count_points,
    dot_radius,
    grow_dots,
    opacity,
    shade,
)
from chronoscene.figures.projections import draw_cloud, legend_names, readable
from chronoscene.statistics.counts import PAPER_COUNTS, PeriodCount, SceneCount


def cloud_with(xyz: np.ndarray, period: np.ndarray, periods: int = 3) -> Cloud:
    """A cloud with a camera above it per period."""
    return Cloud(
        name="place",
        unit="metre",
        labels=tuple(map(str, range(periods))),
        xyz=xyz,
        period=period,
        centres=np.array([[0.0, 0.0, 50.0 + i] for i in range(periods)]),
        directions=np.tile([0.0, 0.0, -1.0], (periods, 1)),
        tops=np.tile([0.0, 1.0, 0.0], (periods, 1)),
        camera_period=np.arange(periods),
    )


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-20, -10, 0], [20, 10, 4], (3000, 3))
    return cloud_with(xyz, rng.integers(0, 3, 3000))


@pytest.mark.parametrize("periods", [1, 2, 4, 5, 8, 9, 50])
def test_every_period_has_its_own_colour(periods):
    colors = period_colors(periods)
    assert len(set(colors)) == periods
    assert all(len(c) == 7 and 0 <= rgb_of(c).min() <= rgb_of(c).max() <= 255 for c in colors)


def test_four_periods_are_red_yellow_blue_green():
    assert period_colors(3) == list(FOUR[:3])
    red, yellow, blue, green = (rgb_of(c) for c in FOUR)
    assert red.argmax() == 0 and blue.argmax() == 2 and green.argmax() == 1
    assert yellow[:2].min() > 2 * yellow[2]


# Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
DEUTERANOPIA = [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]
PROTANOPIA = [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]


TRITANOPIA = [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]


@pytest.mark.parametrize("matrix", [np.eye(3), DEUTERANOPIA, PROTANOPIA, TRITANOPIA])
@pytest.mark.parametrize(("palette", "least"), [(FOUR, 100), (EIGHT, 85)])
def test_colours_differ_for_the_colour_blind(palette, least, matrix):
    linear = (np.array([rgb_of(c) for c in palette]) / 255) ** 2.2
    seen = 255 * np.clip(linear @ np.array(matrix).T, 0, 1) ** (1 / 2.2)
    distance = np.linalg.norm(seen[:, None] - seen, axis=2)
    assert distance[~np.eye(len(palette), dtype=bool)].min() > least


def test_a_long_ramp_goes_from_dark_to_light():
    lightness = [rgb_of(c) @ [0.2126, 0.7152, 0.0722] for c in period_colors(30)]
    assert (np.diff(lightness) > 0).all()


@given(st.lists(st.tuples(st.integers(-2, 12), st.integers(-2, 8), st.integers(-1, 2))))
def test_counts_equal_a_plain_loop(points):
    window = Window((0.0, 0.0), (10.0, 6.0), 5, 3)
    xy = np.array([(x, y) for x, y, _ in points], float).reshape(-1, 2)
    group = np.array([g for *_, g in points], np.int64)
    expected = np.zeros((3, 3, 5))
    for x, y, g in points:
        if g >= 0 and 0 <= x < 10 and 0 <= y < 6:
            expected[g, 2 - y // 2, x // 2] += 1
    np.testing.assert_array_equal(count_points(xy, group, 3, window), expected)


def test_points_that_are_nowhere_are_not_counted():
    xy = np.array([[np.nan, 1.0], [np.inf, 1.0], [1.0, 1.0]])
    counts = count_points(xy, np.zeros(3, np.int64), 1, Window((0, 0), (2, 2), 4, 4))
    assert counts.sum() == 1


def test_dots_grow_for_few_points_only():
    radii = [dot_radius(n, 100_000) for n in (10, 1_000, 2_000, 5_000, 50_000)]
    assert radii[0] > 0 and radii[-1] == 0
    assert radii == sorted(radii, reverse=True)


def test_a_dot_is_a_disc_around_its_pixel():
    counts = np.zeros((2, 9, 9), np.float32)
    counts[0, 4, 4], counts[1, 0, 0] = 1, 2
    grown = grow_dots(counts, 2)
    rows, columns = np.nonzero(grown[0])
    assert np.hypot(rows - 4, columns - 4).max() < 2.5
    np.testing.assert_array_equal(grown[0], grown[0].T)
    assert grown[0, 4, 2] == grown[0, 2, 4] == 1 and grown[0].max() == 1
    assert grown[1, 0, 2] == 2 and grown[1, 8, 8] == 0
    assert grow_dots(counts, 0) is counts


def test_overlapping_periods_share_the_pixels_by_their_counts():
    counts = np.zeros((2, 100, 100), np.float32)
    counts[0], counts[1] = 3, 1
    image = shade(counts, ["#ff0000", "#0000ff"])
    red = (image[..., 0] == 255).mean()
    assert red == pytest.approx(0.75, abs=0.02)
    assert {tuple(c) for c in image[..., :3].reshape(-1, 3)} == {(255, 0, 0), (0, 0, 255)}
    np.testing.assert_array_equal(image, shade(counts, ["#ff0000", "#0000ff"]))


def test_pixels_without_points_are_transparent_and_dense_ones_opaque():
    counts = np.zeros((1, 1, 40), np.float32)
    counts[0, 0, 1:] = np.arange(1, 40)
    alpha = shade(counts, ["#123456"])[0, :, 3].astype(int)
    assert alpha[0] == 0
    assert alpha[1] == round(255 * MIN_OPACITY)
    assert alpha[-1] == 255 and (np.diff(alpha[1:]) >= 0).all()
    assert not shade(np.zeros((1, 3, 3), np.float32), ["#123456"]).any()
    assert opacity(np.ones(5, np.float32)).tolist() == [MIN_OPACITY] * 5


def test_outliers_do_not_widen_the_panels(cloud):
    expected = shown_box(cloud, cameras=False)
    xyz = cloud.xyz.copy()
    xyz[:15] = [1e6, -1e6, 1e6]
    box = shown_box(replace(cloud, xyz=xyz), cameras=False)
    assert (box.edges < 1.25 * expected.edges).all()


def test_an_even_spread_is_shown_to_its_ends(cloud):
    box = shown_box(cloud, cameras=False)
    assert ((cloud.xyz >= box.low) & (cloud.xyz <= box.high)).all()
    assert (box.edges[:2] < 1.15 * np.ptp(cloud.xyz, axis=0)[:2]).all()


def test_cameras_are_inside_of_the_panels(cloud):
    box = shown_box(cloud, cameras=True)
    assert ((cloud.centres >= box.low) & (cloud.centres <= box.high)).all()
    assert box.high[2] > shown_box(cloud, cameras=False).high[2]


def panels(cloud: Cloud, path: Path, monkeypatch: pytest.MonkeyPatch, **options: bool) -> list:
    """Pixels per world unit of both axes of the panels, and the limits."""
    kept = []
    monkeypatch.setattr(projections.canvas, "save", lambda figure, path: kept.append(figure))
    draw_cloud(cloud, path, **options)
    found = []
    for axes in kept[0].axes:
        box, (x, y) = axes.get_window_extent(), (axes.get_xlim(), axes.get_ylim())
        found.append((box.width / (x[1] - x[0]), box.height / (y[1] - y[0]), x, y))
    return found


@pytest.mark.parametrize("cameras", [False, True])
def test_all_panels_have_one_scale_and_share_their_axes(cloud, tmp_path, monkeypatch, cameras):
    xy, xz, zy = panels(cloud, tmp_path / "a.png", monkeypatch, cameras=cameras)
    scales = [scale for panel in (xy, xz, zy) for scale in panel[:2]]
    assert np.ptp(scales) < 1e-6 * scales[0]
    assert xy[2] == xz[2] and xy[3] == zy[3] and xz[3] == zy[2]


def test_texts_of_the_figure_stay_inside_and_do_not_overlap(cloud, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(projections.canvas, "save", lambda figure, path: kept.append(figure))
    labels = tuple(f"survey of the year {2010 + i}" for i in range(9))
    period = np.arange(3000) % 9
    many = replace(cloud_with(cloud.xyz, period, 9), labels=labels, name="a place")
    draw_cloud(many, tmp_path / "a.png", cameras=True)
    (figure,) = kept
    figure.canvas.draw()
    boxes = [t.get_window_extent() for t in figure.texts]
    boxes += [legend.get_window_extent() for legend in figure.legends]
    boxes += [axes.get_tightbbox() for axes in figure.axes]
    for i, box in enumerate(boxes):
        assert box.x0 >= 0 and box.y0 >= 0
        assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        for other in boxes[:i]:
            width = min(box.x1, other.x1) - max(box.x0, other.x0)
            height = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert min(width, height) <= 1.0, (box, other)


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_equal_clouds_give_equal_files(cloud, tmp_path, suffix):
    for name in ("a", "b"):
        draw_cloud(cloud, tmp_path / f"{name}.{suffix}", cameras=True)
    first = (tmp_path / f"a.{suffix}").read_bytes()
    assert first == (tmp_path / f"b.{suffix}").read_bytes()
    assert first.startswith({"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[suffix])
    assert len(list(tmp_path.iterdir())) == 2


def test_the_colours_of_all_periods_are_in_the_picture(cloud, tmp_path):
    draw_cloud(cloud, tmp_path / "a.png")
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).reshape(-1, 3)
    for color in FOUR[:3]:
        assert (pixels == rgb_of(color)).all(axis=1).sum() > 200  # the legend alone is smaller


@pytest.mark.parametrize("unseen", [900, 3000])
def test_points_that_no_image_sees_are_grey(cloud, tmp_path, monkeypatch, unseen):
    """As those of a laser scan, from which methods start."""
    period = cloud.period.copy()
    period[:unseen] = -1
    kept, save = [], canvas.save
    monkeypatch.setattr(canvas, "save", lambda *a: (kept.append(a[0]), save(*a)))
    draw_cloud(replace(cloud, period=period), tmp_path / "a.png")
    assert kept[0].legends[0].get_texts()[-1].get_text() == "seen by no image"
    assert "3,000 points" in kept[0].texts[-1].get_text()
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).reshape(-1, 3)
    assert (pixels == rgb_of("#808080")).all(axis=1).sum() > 200
    box, whole = (
        shown_box(replace(cloud, period=p), cameras=False) for p in (period, cloud.period)
    )
    np.testing.assert_allclose(box.edges, whole.edges, rtol=0.1)


@pytest.mark.parametrize(
    ("scale", "place", "unit", "names"),
    [
        (1, (0, 0, 0), "metre", ("x [m]", "y [m]", "z [m]")),
        (1, (0, 0, 0), "unknown", ("x", "y", "z")),
        (1, (442e3, -4427e3, 90), "metre", ("x - 442,000 [m]", "y + 4,427,000 [m]", "z [m]")),
        (1e-3, (0, 0, 0), "metre", ("x [mm]", "y [mm]", "z [mm]")),
        (1e-3, (0, 0, 0), "unknown", tuple(f"{a} [$10^{{-3}}$]" for a in "xyz")),
        (5e3, (0, 0, 0), "metre", ("x [km]", "y [km]", "z [km]")),
        (5e3, (2e7, -3e7, 0), "metre", ("x - 20,000 [km]", "y + 30,000 [km]", "z [km]")),
        (1e-3, (5, 0, 0), "metre", ("x - 5,000 [mm]", "y [mm]", "z [mm]")),
        (1e6, (0, 0, 0), "unknown", tuple(f"{a} [$10^{{6}}$]" for a in "xyz")),
    ],
)
def test_numbers_beside_the_axes_are_short(cloud, scale, place, unit, names):
    there = replace(
        cloud, xyz=cloud.xyz * scale + place, centres=cloud.centres * scale + place, unit=unit
    )
    shown = shown_box(there, cameras=True)
    moved, box, found = readable(there, shown)
    assert found == names
    assert 0.1 <= box.edges.max() < 10_000
    assert max(abs(box.low.min()), abs(box.high.max())) < 25 * box.edges.max()
    np.testing.assert_array_equal(box.holds(moved.xyz), shown.holds(there.xyz))
    ratio = box.edges / shown.edges
    np.testing.assert_allclose(ratio, ratio[0])  # one factor for all axes


def test_names_with_marks_of_formulas_are_only_text(cloud, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(projections.canvas, "save", lambda figure, path: kept.append(figure))
    odd = replace(cloud, name=r"$\no $x_1$", labels=("$a$", r"\$^$", "2"))
    draw_cloud(odd, tmp_path / "a.svg", cameras=True)
    (figure,) = kept
    figure.canvas.draw()  # a formula that is none would raise
    draw_bars([counted(r"$\no $x_1$", [(1, 2)])], tmp_path / "b.svg")


def test_the_legend_is_read_line_by_line(cloud, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(projections.canvas, "save", lambda figure, path: kept.append(figure))
    labels = tuple(f"survey of {2000 + i}" for i in range(11))
    many = replace(cloud_with(cloud.xyz, np.arange(3000) % 11, 11), labels=labels)
    draw_cloud(many, tmp_path / "a.png")
    (figure,) = kept
    figure.canvas.draw()
    texts = figure.legends[0].get_texts()
    boxes = {t.get_text(): t.get_window_extent() for t in texts}
    order = sorted(boxes, key=lambda name: (-round(boxes[name].y0), boxes[name].x0))
    assert order == legend_names(labels)


@pytest.mark.parametrize(
    "xyz",
    [np.zeros((0, 3)), np.ones((1, 3)), np.full((5, 3), np.nan), np.full((4, 3), 4.5e6)],
    ids=["none", "one", "nowhere", "all in one place, far away"],
)
def test_extreme_clouds(tmp_path, xyz):
    draw_cloud(cloud_with(xyz, np.zeros(len(xyz), np.int64), 1), tmp_path / "a.png", cameras=True)
    assert Image.open(tmp_path / "a.png").size[0] > 300


def test_names_in_the_legend():
    assert legend_names(["0", "1"]) == ["Period 0", "Period 1"]
    assert legend_names(["2016", "1"]) == ["0: 2016", "1"]
    assert legend_names([str(i) for i in range(50)])[49] == "49"
    assert len(legend_names(["x" * 80])[0]) <= 28


def counted(name: str, rows: list[tuple[int, int]]) -> SceneCount:
    periods = tuple(PeriodCount(i, str(i), None, a, a, 0, b) for i, (a, b) in enumerate(rows))
    images, points = (sum(column) for column in zip(*rows, strict=True))
    return SceneCount(name, name, "x", "r", "h", "assigned", periods, images, points, 0)


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_bars_of_the_paper(tmp_path, suffix):
    path = tmp_path / f"counts.{suffix}"
    draw_bars([counted(name, list(rows)) for name, rows in PAPER_COUNTS.items()], path)
    data = path.read_bytes()
    assert data.startswith({"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[suffix])


def test_bars_are_as_long_as_the_counts(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr("chronoscene.figures.canvas.save", lambda figure, path: kept.append(figure))
    draw_bars([counted("a", [(3, 50), (2, 10)]), counted("b", [(7, 20)])], tmp_path / "x.png")
    images, points = kept[0].axes
    bars = sorted(
        (round(b.get_y() + b.get_height() / 2), b.get_x(), b.get_width()) for b in images.patches
    )
    assert bars == [(0, 0, 3), (0, 3, 2), (1, 0, 7)]
    bars = sorted(
        (round(b.get_y() + b.get_height() / 2), b.get_x(), b.get_width()) for b in points.patches
    )
    assert bars == [(0, 0, 50), (0, 50, 10), (1, 0, 20)]


def test_bars_have_the_points_that_no_image_sees(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr("chronoscene.figures.canvas.save", lambda figure, path: kept.append(figure))
    scan = replace(counted("scan", [(2, 0)]), points=40, points_without_period=40)
    draw_bars([counted("a", [(3, 50), (2, 10)]), scan], tmp_path / "x.png")
    bars = [(round(b.get_y() + 0.36), b.get_x(), b.get_width()) for b in kept[0].axes[1].patches]
    assert sorted(bars) == [(0, 0, 50), (0, 50, 10), (1, 0, 40)]
    assert kept[0].axes[1].get_xlabel() == "points, 100 in all"
    names = [text.get_text() for text in kept[0].legends[0].get_texts()]
    assert names == ["Period 0", "Period 1", "seen by no image"]


def test_the_legend_of_the_bars_has_names_that_all_scenes_share():
    one = counted("a", [(3, 50), (2, 10)])
    named = replace(one, periods=tuple(replace(p, date=f"201{p.id}") for p in one.periods))
    assert _period_names([named, named], 2) == ["0: 2010", "1: 2011"]
    assert _period_names([named, one], 2) == ["Period 0", "Period 1"]


def test_periods_of_the_bars_that_can_be_told_apart_are_all_in_the_legend(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr("chronoscene.figures.canvas.save", lambda figure, path: kept.append(figure))
    one = counted("a", [(3, 50)] * 8)
    named = replace(
        one, periods=tuple(replace(p, label=f"autumn morning {p.id}") for p in one.periods)
    )
    draw_bars([named, counted("b", [(3, 50)])], tmp_path / "x.png")
    (figure,) = kept
    figure.canvas.draw()
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 8
    box = legend.get_window_extent()
    assert box.x0 > 0 and box.y0 > figure.axes[0].get_window_extent().y1


@pytest.mark.parametrize("rows", [[(1, 0)], [(0, 0)] * 2, [(2, 30)] * 50])
def test_bars_of_extreme_scenes(tmp_path, rows):
    draw_bars([counted("n" * 200, rows)], tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 1000
