"""The HTML report: complete, escaped, self-contained, and no picture from elsewhere."""

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from PIL import Image

from chronoscene.validation.report.html import MAX_PICTURES, MAX_SIDE_BY_SIDE, Pictures, write_html

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Collects texts and pictures, and checks that elements are closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.sources, self.text = [], [], ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)
        self.sources += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def bad(scene):
    """Findings of all severities; two of them name images that are there."""
    scene.path("images/a000.png").unlink()
    for name in ("a001.png", "a002.png"):
        Image.new("RGB", (64, 40), "red").save(scene.path(f"images/{name}"))
    scene.write("sparse/0/test.txt", "a003.png\n")
    return scene


def test_every_finding_is_there(bad):
    report = bad.validate()
    page = Page(write_html([report]))
    for finding in report.findings:
        for text in (finding.code, finding.name, finding.place, finding.found):
            assert text in page.text, text
    assert "not valid" in page.text and "18\nregistered images" in page.text


def test_nothing_is_loaded_from_elsewhere(bad):
    text = write_html([bad.validate()] * 2)
    assert set(Page(text).sources) >= {"#scene1", "#scene2"}
    for source in Page(text).sources:
        assert source.startswith(("#", "data:image/jpeg;base64,"))
    assert "<script" not in text and "http://" not in text and "https://" not in text


def test_names_from_the_scene_are_escaped(scene):
    lines = [*scene.lines("sparse/split.txt"), "<script>alert(1)</script>&.png 0"]
    scene.write("sparse/split.txt", lines)
    text = write_html([scene.validate()])
    assert "<script" not in text
    assert "<script>alert(1)</script>&.png" in Page(text).text


def test_pictures_of_the_first_images(bad):
    sources = [s for s in Page(write_html([bad.validate()])).sources if s.startswith("data:")]
    assert len(sources) == 4  # two side by side are of the finding that both are the same
    pictures = Pictures(bad.root)
    drawn = [pictures.of("images/a001.png") for _ in range(MAX_PICTURES + 1)]
    assert all(len(d) == 1 for d in drawn[:-1]) and not drawn[-1]


def test_pictures_side_by_side(scene):
    also = tuple(f"b00{i}.png" for i in range(5))
    assert len(Pictures(scene.root).of("images/a001.png", also)) == MAX_SIDE_BY_SIDE


def test_no_pictures_of_files_outside(scene, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "secret.png")
    scene.path("images/link.png").symlink_to(tmp_path / "secret.png")
    pictures = Pictures(scene.root)
    assert pictures.of("images/link.png") == ()
    assert pictures.of("images/../../secret.png") == ()
    assert pictures.of(f"images/{tmp_path}/secret.png") == ()
    assert pictures.of("images/absent.png") == ()
    assert pictures.of("sparse/0/images.txt (a000.png)")


def test_errors_of_periods_are_shown(scene):
    page = Page(write_html([scene.validate()]))
    assert re.search(r"median error, px\s+09\s+6\s+3\s+0\.00", page.text)


def test_one_error_is_singular(scene):
    scene.path("images/a003.png").unlink()
    report = scene.validate()
    assert "0 warnings" in (text := Page(write_html([report, report])).text)
    assert text.count("1 error,") == 2 and "1 errors" not in text


def test_strict_makes_a_scene_with_warnings_not_valid(scene):
    scene.write("sparse/0/test.txt", "a003.png\n")
    report = scene.validate()
    assert "not valid" not in Page(write_html([report])).text
    assert "not valid" in Page(write_html([report], strict=True)).text


def test_each_of_several_remedies_stands_with_its_finding(scene):
    more = ["1 SIMPLE_RADIAL 64 48 50 32 24 -0.16", "2 RADIAL 64 48 50 32 24 0.0001 -0.0001"]
    scene.write("sparse/0/cameras.txt", more)
    page = write_html([scene.validate()])
    rows = [row for row in page.split("<li>") if "cameras.txt (camera" in row and "px" in row]
    assert ["chronoscene undistort" in row for row in rows] == [True, False]


PHONE = """<iframe src="page.html" width="360" height="800" style="border: 0"></iframe>
<script>onload = () => {
  const page = frames[0].document, boxes = [page.scrollingElement, ...page.querySelectorAll("div")];
  document.body.dataset.wide = boxes.map(box => box.scrollWidth - box.clientWidth);
}</script>
"""


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine")
def test_the_page_fits_a_phone(bad, tmp_path):
    """Nothing needs scrolling sideways. A frame, since headless windows are wider than phones."""
    bad.write("sparse/periods.json", '[{"id": 0, "label": "%s"}, {"id": 1}]' % ("unbroken" * 20))
    bad.write("sparse/split.txt", [*bad.lines("sparse/split.txt"), f"{'x' * 200}.png 0"])
    report = bad.validate()
    assert report.summary.periods[0].label == "unbroken" * 20
    long = replace(report, name="w" * 150)
    (tmp_path / "page.html").write_text(write_html([report, long]))
    (tmp_path / "phone.html").write_text(PHONE)
    command = [
        "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
        "--allow-file-access-from-files", f"file://{tmp_path / 'phone.html'}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search(r'data-wide="([-0-9,]+)"', done.stdout)
    assert found is not None, done.stderr[-500:]
    wider = [int(pixels) for pixels in found[1].split(",")]
    assert len(wider) > 10 and max(wider) <= 0
