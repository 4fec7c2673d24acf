"""The page: its data, what it shows in a browser, and that nothing breaks out of it."""

import base64
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from chronoscene.figures import viewer
from chronoscene.figures.cloud import Cloud
from chronoscene.figures.viewer import home_view, page_of, write_page
from chronoscene.formats import read_scene

NASTY = '</script><script>alert(1)</script> & "it\'s" @@DATA@@ \u2028'


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    place = np.array([4e5, 5.5e6, 100.0])
    return Cloud(
        name="place",
        unit="metre",
        labels=("0", "after the flood", "2"),
        xyz=rng.uniform([0, 0, 0], [40, 20, 2], (900, 3)) + place,
        period=np.repeat([0, 1, -1], [500, 300, 100]),
        centres=rng.normal([20, 10, 50], 1, (6, 3)) + place,
        directions=np.tile([0.0, 0.0, -1.0], (6, 1)),
        tops=np.tile([0.0, 1.0, 0.0], (6, 1)),
        camera_period=np.array([0, 0, 1, 1, 2, 2]),
    )


def colors(cloud: Cloud) -> np.ndarray:
    return (np.arange(3 * len(cloud.xyz)).reshape(-1, 3) % 256).astype(np.uint8)


def data_of(page: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 3)


def test_all_points_are_there_by_period(cloud):
    data = data_of(page_of(cloud, colors(cloud)))
    assert [p["points"] for p in data["periods"]] == [500, 300, 0, 100]
    assert [p["shown"] for p in data["periods"]] == [500, 300, 0, 100]
    assert [p["cameras"] for p in data["periods"]] == [2, 2, 2, 0]
    assert (data["points"], data["left_out"]) == (900, 0)
    xyz, rgb = floats(data["xyz"]), base64.b64decode(data["rgb"])
    assert len(rgb) == 3 * len(xyz) == 2700
    offset = cloud.xyz.mean(axis=0) - xyz.mean(axis=0)
    for span in (slice(0, 500), slice(500, 800), slice(800, 900)):
        order, wanted = (np.lexsort(a.T) for a in (xyz[span], cloud.xyz[span]))
        np.testing.assert_allclose(xyz[span][order] + offset, cloud.xyz[span][wanted], atol=1e-5)
        pixels = np.frombuffer(rgb, np.uint8).reshape(-1, 3)[span]
        np.testing.assert_array_equal(pixels[order], colors(cloud)[span][wanted])


def test_many_points_are_thinned_evenly_and_equally(cloud, monkeypatch):
    monkeypatch.setattr(viewer, "MAX_POINTS", 200)
    page = page_of(cloud, colors(cloud))
    data = data_of(page)
    shown = [p["shown"] for p in data["periods"]]
    assert sum(shown) == 200 and shown[0] == pytest.approx(111, abs=25)
    assert [p["points"] for p in data["periods"]] == [500, 300, 0, 100]
    assert page == page_of(cloud, colors(cloud))


class Tags(HTMLParser):
    """Names of all elements, and everything that would load something."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)
        self.loads += [f"{tag} {k}" for k, _ in attrs if k in ("src", "href", "srcset", "onerror")]


def test_names_and_labels_are_only_text(cloud):
    nasty = replace(cloud, name=NASTY, labels=(NASTY, "1", "2"))
    page = page_of(nasty, colors(cloud))
    tags, plain = Tags(), Tags()
    tags.feed(page)
    plain.feed(page_of(cloud, colors(cloud)))
    assert tags.names == plain.names
    assert escape(NASTY) in page
    assert data_of(page)["name"] == data_of(page)["periods"][0]["label"] == NASTY


def test_nothing_is_loaded_from_elsewhere(cloud):
    page = page_of(cloud, colors(cloud))
    tags = Tags()
    tags.feed(page)
    assert tags.loads == []
    assert not re.search(r"https?:|@import|url\(|fetch\(|import\(", page)


def test_the_first_view_is_a_rotation_from_above(cloud):
    R = home_view(cloud, cloud.xyz.mean(axis=0))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    assert R[2, 2] == pytest.approx(np.sin(np.deg2rad(35)), abs=0.02)
    assert R[1, 2] > 0.7 and R[1, 1] > 0.3  # up in the page: up, and what is up in the photos
    below = replace(cloud, centres=cloud.centres * [1, 1, -1])
    assert home_view(below, cloud.xyz.mean(axis=0))[2, 2] < 0


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points(cloud, count):
    few = replace(cloud, xyz=cloud.xyz[:count], period=cloud.period[:count])
    data = data_of(page_of(few, colors(few)))
    assert data["points"] == count
    assert np.isfinite(data["home"]).all() and min(data["half"]) > 0


def test_write_page(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    write_page(scene, tmp_path / "x.html")
    data = data_of((tmp_path / "x.html").read_text(encoding="utf-8"))
    assert data["points"] == 30 and len(data["camera_period"]) == 4


SCRIPT = """
<script>
const report = {};
try {
  const count = () => {  // pixels in the colour of each period
    draw();
    return colors.map(c => pixels.reduce((sum, x) => sum + (x === c), 0));
  };
  const place = () => screen(0, 0, 0).map(Math.round);
  const key = (key, shiftKey = false) => document.dispatchEvent(
    new KeyboardEvent("keydown", { key, shiftKey, bubbles: true, cancelable: true }));
  document.documentElement.classList.remove("dark");
  report.all = count();
  const both = () => [0, 3].forEach(p => boxes[p].click());  // the first date, and unseen points
  both(); report.without = count(); both();
  only(1); report.one = count(); report.which = get("which").value;
  key("["); report.before = get("one").value; key("["); report.every = on.every(Boolean);
  only(2); key("p"); report.played = [get("one").value, get("play").textContent];
  clearInterval(player);  // time stands still here
  player = setInterval(() => {}, 1e6); only(1); key("[");
  report.stopped = [player, get("one").value];
  only(-1);
  report.dots = get("size").value;
  key("1"); draw(); report.xy = R;
  report.pressed = document.querySelector("#views [aria-pressed=true]").dataset.view;
  key("3"); report.yz = R;
  const inside = () => {
    const a = [];
    for (let i = 0; i < xyz.length; i += 3) a.push(screen(xyz[i], xyz[i + 1], xyz[i + 2]));
    return a.every(([x, y]) => x >= 0 && x < W && y >= 0 && y < H);
  };
  report.fits = ["1", "2", "3", "0"].map(k => (key(k), inside()));
  key("1"); const before = place(); key("ArrowRight", true); report.moved = place()[0] - before[0];
  key("1");
  const box = canvas.getBoundingClientRect(), corner = [xyz[0], xyz[1], xyz[2]];
  const at = screen(...corner), zoomed = zoom, mouse = at.map(x => Math.floor(x / ratio));
  canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -400, cancelable: true,
    clientX: box.left + mouse[0], clientY: box.top + mouse[1] }));
  const f = report.zoomed = zoom / zoomed, after = screen(...corner);
  report.under = [0, 1].map(i => mouse[i] * ratio + f * (at[i] - mouse[i] * ratio) - after[i]);
  key("1"); key("ArrowRight"); key("ArrowUp");
  report.turned = structuredClone(R);
  const drag = (pointerId, clientX, clientY) => canvas.dispatchEvent(
    new PointerEvent("pointermove", { pointerId, clientX, clientY }));
  fingers.set(7, [100, 100]); drag(7, 160, 90);
  report.dragged = structuredClone(R); fingers.clear();
  key("0"); const far = zoom;
  fingers.set(1, [100, 100]); fingers.set(2, [200, 100]); drag(2, 300, 100);
  report.pinched = zoom / far; fingers.clear();
  key("c"); report.cameras = get("with-cameras").checked; draw();
  get("theme").click(); report.dark = count().reduce((a, b) => a + b) > 0;
  report.labels = [...document.querySelectorAll("#periods span")].map(s => s.textContent);
  report.text = get("counts").textContent;
} catch (error) { report.error = String(error.stack || error); }
document.body.dataset.report = JSON.stringify(report);
</script>
"""


def browse(page: Path, folder: Path) -> str:
    """The document after its scripts ran, in a browser without a window and without a network."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium here")
    options = "--headless --no-sandbox --disable-quic --no-first-run --disable-gpu --disable-sync "
    options += "--disable-background-networking --disable-component-update --dump-dom"
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [browser, *options.split(), profile, "--window-size=900,700", page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120).stdout


def test_in_a_browser(cloud, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "MAX_POINTS", 700)
    xyz = cloud.xyz.copy()
    xyz[:9] = np.nan
    nasty = replace(cloud, labels=("0", NASTY, "2"), xyz=xyz)
    page = page_of(nasty, colors(cloud))
    (tmp_path / "page.html").write_text(page.replace("</body>", SCRIPT + "</body>"), "utf-8")
    found = re.search('data-report="(.*?)"', browse(tmp_path / "page.html", tmp_path))
    assert found is not None
    report = json.loads(html.unescape(found[1]))
    assert "error" not in report, report["error"]
    assert min(report["all"][:2]) > 100 and report["all"][2] == 0
    assert report["without"][0] == 0 and report["without"][1] >= report["all"][1]
    assert report["one"] == report["without"] and report["all"][3] > 0
    assert (report["which"], report["before"], report["every"]) == ("1", "0", True)
    assert report["xy"] == [[1, 0, 0], [0, 1, 0], [0, 0, 1]] and report["pressed"] == "xy"
    assert report["played"] == ["0", "stop"] and report["stopped"] == [0, "0"]
    assert report["dots"] == "3"
    assert report["yz"] == [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    assert report["fits"] == [True] * 4
    assert report["moved"] > 0
    assert report["zoomed"] == pytest.approx(np.exp(0.6))
    assert report["under"] == pytest.approx([0, 0], abs=1e-6)  # zooms about the mouse
    for name in ("turned", "dragged"):
        R = np.array(report[name])
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.abs(np.array(report["turned"]) - report["dragged"]).max() > 0.1
    assert report["pinched"] == pytest.approx(2)
    assert report["cameras"] and report["dark"]
    assert report["labels"] == ["Period 0", f"1: {NASTY}", "Period 2", "seen by no image"]
    assert report["text"] == (
        "700 of 891 points, chosen at random, 6 cameras; 9 that are not finite are left out"
    )
