"""The page: complete in itself, names escaped, and what it shows is what was measured."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.registration.generated import CaseSettings, generate_case
from chronoscene.registration.output import inspect_registration
from chronoscene.registration.quality.certificate import certify
from chronoscene.registration.quality.position import judge_position
from chronoscene.registration.quality.rays import gather
from chronoscene.registration.quality.verdict import judge
from chronoscene.registration.report.page import render_report
from chronoscene.registration.report.pictures import PATCH, Photos, camera_map, patch_grid
from chronoscene.registration.report.spots import drawn_pairs, spots
from chronoscene.registration.result import HeldOutTracks, Registered
from chronoscene.registration.ties.tie_alignment import align_with_tie_points
from chronoscene.registration.ties.tie_points import read_tie_points

HOSTILE = '2016"><script>alert(1)</script>'


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Registered:
    """Two periods a little apart, with photos: a chequered ground seen by each camera."""
    made = generate_case(CaseSettings(seed=51, ties=300, rotation=0.4, points=1500, views=6))
    root = tmp_path_factory.mktemp("photos")
    v, u = np.mgrid[0:360, 0:480] + 0.5
    for name, pose in zip(made.model.names, made.truth, strict=True):
        path = root / name
        path.parent.mkdir(exist_ok=True)
        rays = np.stack([(u - 240) / 400, (v - 180) / 400, np.ones_like(u)], axis=-1) @ pose[:3, :3]
        centre = -pose[:3, :3].T @ pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = centre + rays * (-centre[2] / rays[..., 2])[..., None]
        check = (np.floor(ground[..., 0] / 4) + np.floor(ground[..., 1] / 4)) % 2
        check = np.where(rays[..., 2] < 0, 60 + 120 * check, 200).astype(np.uint8)
        Image.fromarray(np.stack([check] * 3, axis=-1)).save(path, quality=90)
    return replace(made.model, images_root=str(root))


class Collector(HTMLParser):
    """Tags that were opened, and everything that a page would fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [v or "" for k, v in attrs if k in ("src", "href", "srcset", "action")]


def render(model: Registered) -> str:
    certificate = certify(model)
    return render_report(model, certificate, judge(certificate), judge_position(model))


@pytest.fixture(scope="module")
def page(model: Registered) -> str:
    return render(model)


def test_page_is_complete_in_itself(page: str) -> None:
    found = Collector(page)
    assert found.links and all(link.startswith("data:image/jpeg;base64,") for link in found.links)
    assert not re.search(r"https?://|url\(|@import", page)
    assert "default-src 'none'" in page
    assert found.tags.count("script") == 1
    assert len(page) < 3_000_000


def test_page_says_what_was_measured(model: Registered, page: str) -> None:
    verdict = judge(certify(model))
    assert verdict.level == "fail"
    assert 'Alignment of the periods: <span class="badge fail">Fail</span>' in page
    assert 'Absolute position: <span class="badge doubtful">Doubtful</span>' in page
    assert "remaining rotation between two periods" in page
    for heading in (
        "Cameras from above", "The same spot at two dates", "Held-out matches",
        "Where to click next", "Certificate", "Thresholds",
    ):  # fmt: skip
        assert heading in page
    for name in model.names:
        assert f"<title>{name}</title>" in page
    assert page.count("<figure>") >= 4
    assert "prefers-reduced-motion" in page and "prefers-color-scheme" in page


def test_hostile_names_are_escaped(model: Registered) -> None:
    bad = replace(
        model,
        labels=(HOSTILE, "<b>2018</b>"),
        names=(f"t0/{HOSTILE}.jpg", *model.names[1:]),
        unregistered={"<img src=x>.jpg": "<script>"},
        unregistered_periods={"<img src=x>.jpg": 0},
    )
    page = render(bad)
    found = Collector(page)
    assert found.tags.count("script") == 1
    assert "<script>alert" not in page and "<img src=x>" not in page and "<b>2018" not in page
    assert not any("alert" in link for link in found.links)


def test_page_without_photos_matches_or_points(model: Registered) -> None:
    bare = replace(
        model,
        images_root="/nowhere",
        held_out_tracks=HeldOutTracks.empty(),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        track_start=np.zeros(1, np.int64),
        track_image=np.zeros(0, np.int64),
        track_xy=np.zeros((0, 2)),
        georeference=None,
        gps_enu=np.full_like(model.gps_enu, np.nan),
    )
    page = render(bare)
    assert "Fail" in page and "Cameras from above" in page
    assert "<figure>" not in page


def test_spots_are_seen_well_inside_both_images(model: Registered) -> None:
    certificate = certify(model)
    (pair,) = certificate.pairs
    for gaps in (False, True):
        found = spots(model, certificate.evidence.seen, pair, 4, gaps=gaps, twice=True)
        assert found
        for spot in found:
            assert model.periods[spot.a] == 0 and model.periods[spot.b] == 1
            for xy in (spot.xy_a, spot.xy_b):
                assert (xy > [20, 20]).all() and (xy < [460, 340]).all()
            assert spot.more_a is not None and spot.more_a[0] != spot.a
            assert np.linalg.norm(spot.normal) == pytest.approx(1)
            assert spot.tied is not gaps


def test_patches_show_the_plane_of_the_spot_upright(model: Registered) -> None:
    certificate = certify(model)
    spot = spots(model, certificate.evidence.seen, certificate.pairs[0], 1, gaps=False)[0]
    grid = patch_grid(model, spot)
    assert grid.shape == (PATCH, PATCH, 3)
    np.testing.assert_allclose(grid[PATCH // 2 - 1 : PATCH // 2 + 1,
                                    PATCH // 2 - 1 : PATCH // 2 + 1].mean(axis=(0, 1)),
                               spot.xyz, atol=1e-9)  # fmt: skip
    assert np.abs((grid - spot.xyz) @ spot.normal).max() < 1e-6
    local = grid @ model.cam_from_world[spot.a, :3, :3].T
    assert (np.diff(local[..., 0], axis=1) > 0).all()  # right is right
    assert (np.diff(local[..., 1], axis=0) > 0).all()  # down is down
    assert Photos(model).patches(spot) is not None
    assert Photos(replace(model, images_root="/nowhere")).patches(spot) is None


def test_pairs_are_drawn_from_best_to_worst(model: Registered) -> None:
    pairs = drawn_pairs(model, gather(model))
    medians = [p.median for p in pairs]
    assert len(pairs) > 2 and medians == sorted(medians)
    assert all(model.periods[p.a] != model.periods[p.b] for p in pairs)
    assert medians[-1] > 1.0  # 0.4 degrees are 2.8 pixels


def test_map_has_north_up_and_cuts_gross_gps(model: Registered) -> None:
    gps = model.gps_enu.copy()
    gps[0] += [5000.0, 0.0, 0.0]
    drawn = camera_map(replace(model, gps_enu=gps))
    assert drawn.north and drawn.gross >= 1
    assert drawn.cameras[0].cut and drawn.cameras[0].gps is not None
    assert drawn.cameras[0].gps[0] > drawn.cameras[0].x  # east is right
    xy = np.array([[c.x, c.y] for c in drawn.cameras])
    assert (xy >= 0).all() and (xy <= [drawn.width, drawn.height]).all()
    north = int(np.argmax(-np.einsum(
        "nji,nj->ni", model.cam_from_world[:, :3, :3], model.cam_from_world[:, :3, 3])[:, 1]
    ))  # fmt: skip
    assert north == int(np.argmin(xy[:, 1]))


def test_inspection_writes_json_and_page(model: Registered, tmp_path: Path) -> None:
    found = inspect_registration(model, tmp_path, page=True)
    data = json.loads((tmp_path / "registration.json").read_text())
    assert data["alignment"]["verdict"] == found.verdict.level == "fail"
    assert data["absolute_position"]["verdict"] == found.position.level == "doubtful"
    assert found.summary.startswith("alignment of the periods: fail. The periods do not fit")
    assert "\nabsolute position: doubtful. " in found.summary
    assert "to do: " in found.summary
    assert "<h2" in (tmp_path / "registration.html").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["registration.html", "registration.json"]


def test_tie_points_are_listed(model: Registered, tmp_path: Path) -> None:
    rows = []
    for track in range(0, 40, 5):
        span = slice(model.track_start[track], model.track_start[track + 1])
        for i, (x, y) in zip(model.track_image[span], model.track_xy[span], strict=True):
            rows.append(f"p{track},{model.names[i]},{x},{y}")
    path = tmp_path / "ties.csv"
    path.write_text("\n".join(rows))
    points = read_tie_points(path)
    ties = align_with_tie_points(model, points, mode="check")
    inspect_registration(ties.model, tmp_path, page=True, ties=ties, tie_points=points)
    page = (tmp_path / "registration.html").read_text()
    assert "Clicked points" in page and "click consistency, px" in page and "<td>p35</td>" in page
    assert json.loads((tmp_path / "registration.json").read_text())["tie_points"]["points"]


def test_page_fits_a_phone(browser: Any, page: str, tmp_path: Path) -> None:
    """Only tables in scroll boxes of their own are wider than a narrow window, with whole words."""
    (tmp_path / "page.html").write_text(page)
    tab = browser.new_page(viewport={"width": 360, "height": 800})
    errors: list[str] = []
    tab.on("pageerror", lambda e: errors.append(str(e)))
    tab.on("console", lambda m: errors.append(m.text))
    tab.goto(f"file://{tmp_path / 'page.html'}")
    assert tab.evaluate("document.body.scrollWidth") <= 360
    name = tab.get_by_role("cell", name="held-out reprojection error, median").first
    assert name.bounding_box()["width"] > 80  # "reprojection" in one line
    tab.get_by_label("Blink all").check()
    assert tab.locator(".blink:checked").count() == tab.locator("figure").count()
    assert errors == []
    tab.close()


def test_suggested_points_have_names_of_their_own(model: Registered) -> None:
    """A name that two pairs of periods share would join their clicks to one point."""
    certificate = certify(model)
    twice = replace(certificate, pairs=certificate.pairs * 2)
    page = render_report(model, twice, judge(certificate), judge_position(model))
    points = re.findall(r"<td>(p\d+)</td>", page)
    assert len(points) > 2 and points == [f"p{i + 1}" for i in range(len(points))]


def test_rings_of_gps_are_drawn_in_the_frame_of_gps_only(model: Registered) -> None:
    assert any(c.gps is not None for c in camera_map(model).cameras)
    bare = camera_map(replace(model, georeference=None))
    assert all(c.gps is None for c in bare.cameras)


def test_the_page_does_not_call_what_rises_misaligned(page: str) -> None:
    text = " ".join(page.split())
    assert "if they jump, the periods are misaligned" not in text
    assert "What rises above the plane" in text and "shifts even where the alignment" in text


def test_nobody_is_asked_to_click_on_sky(model: Registered) -> None:
    photos = Photos(model)
    found = spots(model, gather(model).seen, certify(model).pairs[0], 6, gaps=False)
    ground = [s for s in found if photos.is_textured(s)]
    assert ground  # the chequered ground
    sky = replace(ground[0], xy_a=np.array([240.0, 20.0]))
    with Image.open(Path(model.images_root) / model.names[sky.a]) as image:
        blank = Image.new("RGB", image.size, (200, 215, 235))
    assert photos.is_textured(ground[0])
    photos._load = lambda index: np.asarray(blank)  # type: ignore[assignment]
    assert not photos.is_textured(sky)
