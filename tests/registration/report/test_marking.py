"""The page to mark points: what is in it, and in Chromium, by mouse, keyboard and touch."""

import csv
import itertools
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chronoscene.cli.scenes.mark import command
from chronoscene.colmap.model import write_model
from chronoscene.images.store import resize_camera
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.report.marking import marking_page
from chronoscene.registration.ties.tie_points import read_tie_points
from chronoscene.scene import Scene
from chronoscene.scene.cameras import project_points

NAMES = ("2016/p0_0000.jpg", "2016/p0_0001.jpg", "2023/p1_0000.jpg")


@pytest.fixture(scope="module")
def captures(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("marking") / "captures"
    for name in NAMES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        frame = next(f for f in truth.frames if f.name == Path(name).name)
        (root / name).symlink_to(truth.image_path(frame))
    return root


@pytest.fixture(scope="module")
def model(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The true poses as a COLMAP model, under the names of the captures."""
    folder = tmp_path_factory.mktemp("model")
    known = {Path(name).name: name for name in NAMES}
    frames = [replace(f, name=known.get(f.name, f.name)) for f in truth.frames]
    write_model(folder, frames, truth.points)
    return folder


@pytest.fixture(scope="module")
def page(captures: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    points = folder / "points.csv"
    points.write_text(
        "# crs: EPSG:32632\npoint,image,x,y,X,Y,Z,role\n"
        f"</script><b>,{NAMES[0]},100,50,500000.5,5320000.25,12.125,check\n"
        "unseen,,,,500010,5320000,12,\n"
    )
    found = read_captures(captures).images
    text = marking_page(found, points=read_tie_points(points), model=model, max_size=200)
    (folder / "page.html").write_text(text)
    return folder / "page.html"


def test_nothing_is_loaded_and_names_are_escaped(page: Path) -> None:
    text = page.read_text()
    assert "default-src 'none'" in text
    assert "http://" not in text and "https://" not in text
    assert "</script><b>" not in text
    assert text.count("data:image/jpeg") == len(NAMES)


def test_a_model_of_reduced_photos_predicts_in_the_whole_ones(
    captures: Path, truth: Scene, page: Path, tmp_path: Path
) -> None:
    known = {Path(name).name: name for name in NAMES}
    frames = [
        replace(f, name=known.get(f.name, f.name), camera=resize_camera(f.camera, w // 2, h // 2))
        for f in truth.frames
        for w, h in [f.camera.size]
    ]
    (tmp_path / "half").mkdir()
    write_model(tmp_path / "half", frames, truth.points)
    text = marking_page(read_captures(captures).images, model=tmp_path / "half", max_size=200)
    numbers = re.compile(r'"intrinsics": \[(.*?)\]')
    whole, reduced = (
        np.array([line.split(",") for line in numbers.findall(each)], float)
        for each in (page.read_text(), text)
    )
    assert len(whole) == len(NAMES)
    np.testing.assert_allclose(reduced, whole)


def test_the_command_writes_a_page(captures: Path, tmp_path: Path) -> None:
    from click.testing import CliRunner

    done = CliRunner().invoke(command, [str(captures), str(tmp_path / "p.html")])
    assert done.exit_code == 0, done.output
    assert "3 photos" in done.output
    assert (tmp_path / "p.html").stat().st_size > 10_000


def test_clicks_in_other_photos_are_named_and_kept(captures: Path, tmp_path: Path) -> None:
    from click.testing import CliRunner

    points = tmp_path / "points.csv"
    points.write_text(f"p,{NAMES[0]},10,20\np,2024/far.jpg,30,40\nq,b.jpg,5,6\n")
    words = [captures, tmp_path / "p.html", "--tie-points", points, "--tie-scale", 0.5]
    done = CliRunner().invoke(command, list(map(str, words)))
    assert done.exit_code == 0, done.output
    assert "2 clicks in photos that are not in CAPTURES, such as '2024/far.jpg'" in done.stderr
    marks = re.findall(r'"marks": \{(.*?)\}', (tmp_path / "p.html").read_text())
    ours = f'"{NAMES[0]}": [5.0, 10.0]'
    assert marks == [f'{ours}, "2024/far.jpg": [15.0, 20.0]', '"b.jpg": [2.5, 3.0]']


def test_a_page_that_cannot_be_written_is_refused_before_the_photos_are_read(
    captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from click.testing import CliRunner

    monkeypatch.delattr("chronoscene.cli.scenes.mark.read_captures")
    for page, found in ((tmp_path, "Is a directory"), (tmp_path / "no/p.html", "No such file")):
        done = CliRunner().invoke(command, [str(captures), str(page)])
        assert str(done.exception).startswith(f"PAGE {page}: expected a file that can be written, ")
        assert found in str(done.exception)


class Opened:
    """The page in a browser."""

    def __init__(self, browser: Any, page: Path, width: int, height: int) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height})
        self.tab = self.context.new_page()
        self.errors: list[str] = []
        self.tab.on("pageerror", lambda e: self.errors.append(str(e)))
        self.tab.on("console", lambda m: self.errors.append(m.text))
        self.open(page)

    def open(self, page: Path) -> None:
        self.tab.goto(f"file://{page}")
        self.tab.wait_for_function("picture().complete && $('points').children.length")
        # Until the photo fits into the window, a place in it may be elsewhere a moment later.
        self.tab.evaluate("new Promise(d => requestAnimationFrame(() => requestAnimationFrame(d)))")
        self.tab.locator("#view").focus()

    def mark(self, xy: Any) -> None:
        """Click at pixels of the original photo."""
        x, y = self.tab.evaluate("xy => toScreen(xy)", [float(v) for v in xy])
        box = self.tab.locator("#view").bounding_box()
        self.tab.mouse.click(box["x"] + x, box["y"] + y)

    def saved(self, path: Path) -> list[dict[str, str]]:
        with self.tab.expect_download() as download:
            self.tab.keyboard.press("s")
        download.value.save_as(path)
        lines = [r for r in path.read_text().splitlines() if not r.startswith("#")]
        return list(csv.DictReader(lines))


STAGE = """
const made = new Map(), pen = new Proxy({}, { get: () => () => {}, set: () => true });
const element = id => made.get(id) || made.set(id, {
  value: "", clientWidth: 300, clientHeight: 200, getContext: () => pen, select() {}, append() {},
  addEventListener() {}, setAttribute() {}, replaceChildren() {}, click() {},
}).get(id);
globalThis.document = { getElementById: element, querySelectorAll: () => [],
  querySelector: () => null, createElement: () => element("new") };
globalThis.ResizeObserver = class { observe() {} };
globalThis.Image = class {};
globalThis.addEventListener = () => {};
globalThis.devicePixelRatio = 1;
let content;
URL.createObjectURL = blob => { content = blob; };
URL.revokeObjectURL = () => {};
const enter = (id, value) => {
  $(id).value = value;
  $(id).onchange({ target: $(id) });
};
"""


def test_a_point_with_coordinates_is_no_tie_point(page: Path, tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node here")
    *_, script = re.findall("<script>(.*?)</script>", page.read_text(), re.DOTALL)
    then = """
        choose(0); enter("role", "tie");
        console.error($("role").value, $("status").textContent);
        enter("world", "");
        console.error(state.points[point].role);
        enter("world", "500000.5 5320000.25 12");
        enter("role", "check"); save();
        content.text().then(text => console.log(text));"""
    (tmp_path / "page.js").write_text(STAGE + script + then)
    started = [node, str(tmp_path / "page.js")]
    done = subprocess.run(started, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    said = done.stderr.splitlines()
    assert (
        said[0].startswith("check A point with coordinates is control or check")
        and said[1] == "tie"
    )
    (tmp_path / "points.csv").write_text(done.stdout)
    roles = {p.name: p.role for p in read_tie_points(tmp_path / "points.csv").points}
    assert roles == {"</script><b>": "check", "unseen": "control"}


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_points_are_marked_by_mouse_and_keyboard(
    browser: Any, page: Path, tmp_path: Path, width: int, height: int
) -> None:
    opened = Opened(browser, page, width, height)
    tab = opened.tab
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    tab.keyboard.press("a")
    tab.locator("#name").fill("door")
    tab.locator("#name").press("Enter")
    tab.locator("#view").focus()
    opened.mark((200, 150))
    box = tab.locator("#view").bounding_box()
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.mouse.wheel(0, -900)  # zoom: the same pixels are elsewhere on the screen
    tab.wait_for_function("scale > 1.5 * view.clientWidth / 400")
    opened.mark((210, 160))
    tab.keyboard.press("Shift+ArrowLeft")
    tab.keyboard.press("ArrowRight")
    opened.mark((50, 60))
    opened.mark((55, 66))
    tab.keyboard.press("u")
    tab.keyboard.press("ArrowRight")
    opened.mark((5, 6))
    tab.keyboard.press("Delete")
    rows = opened.saved(tmp_path / "points.csv")
    door = {r["image"]: (float(r["x"]), float(r["y"])) for r in rows if r["point"] == "door"}
    assert door.keys() == {NAMES[0], NAMES[1]}
    np.testing.assert_allclose(door[NAMES[0]], (209.75, 160), atol=0.6)
    np.testing.assert_allclose(door[NAMES[1]], (50, 60), atol=1.5)
    points = {p.name: p for p in read_tie_points(tmp_path / "points.csv").points}
    assert points["door"].role == "tie" and len(points["door"].clicks) == 2
    assert points["</script><b>"].world == (500000.5, 5320000.25, 12.125)
    assert points["</script><b>"].role == "check" and not points["unseen"].clicks
    assert opened.errors == []
    opened.context.close()


def test_unsaved_work_is_kept(browser: Any, page: Path) -> None:
    opened = Opened(browser, page, 800, 600)
    opened.mark((20, 30))
    opened.tab.goto("about:blank")
    opened.open(page)
    assert "marks of last time" in opened.tab.locator("#status").inner_text()
    found = opened.tab.evaluate("state.points[0].marks")
    np.testing.assert_allclose(found[NAMES[0]], (20, 30), atol=1)
    opened.tab.keyboard.press("u")
    opened.open(page)
    assert "marks of last time" not in opened.tab.locator("#status").inner_text()
    opened.context.close()


def test_a_page_without_points_starts_with_an_empty_one(
    browser: Any, captures: Path, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    page.write_text(marking_page(read_captures(captures).images, max_size=200))
    opened = Opened(browser, page, 800, 600)
    status = opened.tab.locator("#status")
    assert status.inner_text() == "1 point, 0 marks"
    opened.open(page)
    assert status.inner_text() == "1 point, 0 marks"
    opened.mark((20, 30))
    assert status.inner_text() == "1 point, 1 mark, not saved"
    opened.open(page)
    assert "marks of last time" in status.inner_text()
    opened.tab.keyboard.press("u")
    assert status.inner_text() == "1 point, 0 marks"
    opened.tab.locator("#only").check()
    opened.tab.keyboard.press("ArrowRight")
    assert status.inner_text() == "No other photo has a mark of this point."
    assert "only photos with a mark of the point" in opened.tab.locator("nav").inner_text()
    assert opened.errors == []
    opened.context.close()


def test_a_mark_predicts_the_others(browser: Any, page: Path, truth: Scene) -> None:
    """On an epipolar line by one mark, at the place by two."""
    frames = {f.name: f for f in truth.frames}
    xyz = truth.points.xyz[int(np.argmax(np.diff(truth.points.track_start)))]
    pixels = [project_points(frames[Path(n).name].camera,
              xyz[None] @ frames[Path(n).name].cam_from_world[:3, :3].T
              + frames[Path(n).name].cam_from_world[:3, 3])[0] for n in NAMES]  # fmt: skip
    opened = Opened(browser, page, 800, 600)
    opened.tab.keyboard.press("a")
    opened.tab.evaluate("xy => state.points[point].marks[photos[0].name] = xy", pixels[0].tolist())
    line = opened.tab.evaluate("predict(photos[1]).line.filter(Boolean)")
    gaps = [
        abs((b[0] - a[0]) * (a[1] - pixels[1][1]) - (a[0] - pixels[1][0]) * (b[1] - a[1]))
        / np.hypot(b[0] - a[0], b[1] - a[1])
        for a, b in itertools.pairwise(line)
    ]
    assert min(gaps) < 0.5
    opened.tab.evaluate("xy => state.points[point].marks[photos[1].name] = xy", pixels[1].tolist())
    at = opened.tab.evaluate("predict(photos[2]).at")
    np.testing.assert_allclose(at, pixels[2], atol=0.5)
    opened.context.close()
