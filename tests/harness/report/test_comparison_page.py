"""The page of all runs: what is on it, and what it does in a browser."""

import base64
import html
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from made_runs import scored
from markupsafe import escape
from PIL import Image

from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter
from chronoscene.harness.files.records import CURVE_FILE, PREDICTIONS, write_run
from chronoscene.harness.report.comparison_page import MAX_WIDTH, comparison_page
from chronoscene.harness.report.single_views import view_scores, worst_views
from chronoscene.harness.report.summary import read_runs

NASTY = "<script>alert(1)</script> & 'it'"
COLORS = {"truth": (200, 30, 30), "a": (30, 200, 30), "b": (30, 30, 200)}
PICTURE = re.compile(r'src="data:image/webp;base64,([^"]+)"')


@pytest.fixture
def make_page(tmp_path):
    """Factory of the page of two methods on three views of two periods; and its folder."""

    def make(*, size=(60, 40), labels=("may", "1"), **options):
        runs = tmp_path / "runs"
        views = [f"{period}/view{k}.png" for period, k in ((0, 0), (0, 1), (1, 0))]
        folders = {"truth": ground_truth_folder(runs, "plaza")}
        for method, psnr in (("a", [[20.0, 21.0], [22.0]]), ("b", [[24.0, 23.0], [30.0]])):
            folder = runs / "plaza" / f"{method}-joint-fast" / "seed0"
            folders[method] = folder / PREDICTIONS
            run = scored(method, psnr=psnr, period_labels=dict(zip("01", labels, strict=True)))
            folder.mkdir(parents=True, exist_ok=True)
            header = "seconds,iteration,primitives,psnr,parameters,model"
            (folder / CURVE_FILE).write_text(f"{header}\n1,5,9,20,90,all\n2,10,9,24,90,all\n")
            write_run(folder, run.model_copy(update={"title": f"{run.title} {NASTY}"}), run.rows)
        for name, folder in folders.items():
            writer = ImageWriter(folder)
            for view in views:
                pixels = np.full((size[1], size[0], 3), COLORS[name], np.uint8)
                period = int(view[0])
                writer.add(view, pixels, camera_period=period, rendered_period=period)
            writer.close(kind="predictions", scene="plaza", scene_hash="s", details={})
        records, failures = read_runs([runs])
        worst = [*worst_views(view_scores(records, "psnr"), records, "psnr")]
        return comparison_page(runs, records, failures, worst, **options)

    return make


def pictures(page):
    return [Image.open(io.BytesIO(base64.b64decode(text))) for text in PICTURE.findall(page)]


def test_every_view_has_its_photo_and_predictions_in_order(make_page):
    page = make_page()
    found = [picture.getpixel((30, 20)) for picture in pictures(page)]
    np.testing.assert_allclose(found, [*COLORS.values()] * 3, atol=6)
    assert page.count('class="slider"') == 3 and "left out" not in page
    text = " ".join(page.split())
    for known in ("PSNR of the probe views", "may: 0/view0.png", "macro means", "Worst views"):
        assert known in text
    expected = -10 * np.log10(np.mean(np.square([170, 170, 0])) / 255**2)
    assert page.count(f"<b>{expected:.2f} dB</b>") == 6
    assert page.count(" s</title>") == 4


def test_pictures_are_bounded_and_the_page_says_what_is_left_out(make_page):
    size = sum(len(found[0]) - len('src=""') for found in PICTURE.finditer(make_page()))
    page = make_page(max_bytes=round(0.8 * size))
    assert page.count('class="slider"') == 2
    # One of each period, and not the first two.
    assert "may: 0/view1.png" in page and "period 1: 1/view0.png" in page
    assert "1 of 3 test views are left out" in " ".join(page.split())
    assert make_page(max_bytes=100).count('class="slider"') == 0
    assert [picture.width for picture in pictures(make_page(size=(2000, 40)))] == [MAX_WIDTH] * 9


def test_names_are_only_text_and_nothing_is_loaded(make_page):
    page = make_page(labels=(NASTY, "1"))
    assert NASTY not in page and str(escape(NASTY)) in page
    assert page.count("<script>") == page.count("</script>") == 1
    assert not re.search(r"https?:|@import|url\((?!#)|fetch\(", page)


PROBE = """
<script>
const errors = [];
window.addEventListener("error", (event) => errors.push(event.message));
addEventListener("load", () => {
  for (const part of document.querySelectorAll("details")) part.open = true;
  const slider = document.querySelector(".slider"), stack = slider.querySelector(".stack");
  const range = slider.querySelector("input[type=range]");
  const shown = () => [...stack.querySelectorAll("img")].map((i) => Number(i.offsetWidth > 0));
  const before = shown();
  slider.querySelectorAll("input[type=radio]")[1].click();
  range.value = 20;
  range.dispatchEvent(new Event("input"));
  const cut = getComputedStyle(stack.querySelectorAll("img")[2]).clipPath;
  const box = stack.getBoundingClientRect();
  stack.dispatchEvent(new PointerEvent("pointerdown",
    { buttons: 1, clientX: box.left + box.width * 0.75, clientY: box.top + 5 }));
  const root = document.documentElement;
  const found = [root.scrollWidth - root.clientWidth, before, shown(), cut, range.value, errors,
    getComputedStyle(document.body).backgroundColor];
  parent.document.documentElement.dataset.found = JSON.stringify(found);
});
</script>
"""


OVERLAPS = """
[...document.querySelectorAll(".plot text")].map(e => e.getBoundingClientRect())
  .flatMap((a, i, all) => all.slice(i + 1).filter(b => a.left < b.right && b.left < a.right
    && a.top < b.bottom && b.top < a.bottom))
"""


def test_labels_of_plots_do_not_overlap_on_a_phone(browser, make_page, tmp_path):
    (tmp_path / "page.html").write_text(make_page())
    tab = browser.new_page(viewport={"width": 390, "height": 844})
    tab.goto(f"file://{tmp_path / 'page.html'}")
    assert tab.locator(".plot text").count() > 8
    assert tab.evaluate(OVERLAPS) == []
    tab.close()


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine")
@pytest.mark.parametrize(
    ("scheme", "ground"),
    [pytest.param(1, "rgb(246, 247, 248)", marks=pytest.mark.slow), (0, "rgb(20, 23, 26)")],
)
def test_the_page_on_a_phone(make_page, tmp_path, scheme, ground):
    """Sliders work, nothing is wider than the window, light and dark."""
    page = make_page(labels=("unbroken" * 20, "1"))
    (tmp_path / "page.html").write_text(page.replace("<h1>", f"{PROBE}<h1>", 1))
    # In a frame, since headless windows are wider than phones.
    frame = '<iframe src="page.html" style="width: 360px; height: 800px"></iframe>'
    (tmp_path / "phone.html").write_text(f"<!doctype html>{frame}")
    command = [
        "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
        f"--blink-settings=preferredColorScheme={scheme}",
        "--allow-file-access-from-files", f"file://{tmp_path / 'phone.html'}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search(r'data-found="([^"]+)"', done.stdout)
    assert found is not None, done.stderr[-500:]
    wide, before, after, cut, at, errors, color = json.loads(html.unescape(found[1]))
    assert wide <= 0 and errors == []
    assert (before, after) == ([1, 1, 0], [1, 0, 1])
    assert cut == "inset(0px 0px 0px 20%)" and at == "75"
    assert color == ground
