"""The site: its links, its text, what stands beside what, and how it works in a browser."""

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import pytest
from made_runs import write_scored

from chronoscene.errors import CheckpointError, SceneError
from chronoscene.harness.files.predictions import read_manifest, write_manifest
from chronoscene.harness.report.published import load_published
from leaderboard.board import NOT_ASKED, read_board
from leaderboard.scenes import FixedScene, views_hash
from leaderboard.site import write_site

NASTY = "May & \"June\" 'x'"


class Page(HTMLParser):
    """Texts of the rows of all tables, and everything that a page leads to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.rows: list[str] = []
        self.inside = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name in ("href", "src")]
        if tag == "tr":
            self.inside = True
            self.rows.append("")

    def handle_endtag(self, tag):
        self.inside = self.inside and tag != "tr"

    def handle_data(self, data):
        if self.inside and data.strip():
            self.rows[-1] += f" {data.strip()}"


def standings(folder, claimed=""):
    """Read the entries of a folder as if they were verified, or claimed for a reason."""
    return [replace(standing, claimed=claimed) for standing in read_board(folder).standings]


@pytest.fixture(scope="module")
def lawncourt():
    """A scene of the paper, as if its hashes were known."""
    views = [(f"{i}/view{k}.png", i) for i in range(2) for k in range(3)]
    scene = FixedScene("ranking", "", "d" * 64, "b" * 64, views_hash(views))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("leaderboard.scenes.fixed_scenes", lambda: {"Lawncourt": scene})
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    make = partial(
        write_scored,
        tmp_path_factory.mktemp("x") / "runs",
        scene="square",
        period_labels={"0": NASTY, "1": "late"},
    )
    make(), make(seed=1)
    better = ((28.0, 29.0, 30.0), (31.0, 32.0, 33.0))
    make("chronogs", psnr=better, seconds=20.0, checkpoint_bytes=500_000)
    make("lab-method", psnr=better, seconds=30.0)  # nobody installed this one
    run = make("4dgs", scene="Lawncourt", scene_hash="d" * 64)
    for folder in (run / "predictions", run.parents[2] / "ground_truth/Lawncourt"):
        manifest = read_manifest(folder).model_copy(update={"scene_hash": "d" * 64})
        write_manifest(folder, manifest)
    return run.parents[2]


@pytest.fixture(scope="module")
def entries(runs, enter, lawncourt):
    enter([runs], runs.parent / "entries")
    return standings(runs.parent / "entries")


@pytest.fixture(scope="module")
def site(entries, runs):
    assert write_site(entries, load_published(), runs.parent / "site", [runs]) == 4
    return runs.parent / "site"


def test_every_link_leads_somewhere_inside(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) == 2 + 13 + 18  # scenes of the paper and square; methods, one unheard of
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"https?:|@import|url\((?!#)|fetch\(|import\(", text)
        for link in Page(page).links:
            assert (page.parent / link).is_file(), (page, link)
            assert (page.parent / link).resolve().is_relative_to(site)


def test_methods_are_sorted_by_one_scene_on_the_first_page(make_run, enter, tmp_path):
    easy = ((30.0, 30.0, 30.0), (30.0, 30.0, 30.0))
    better = ((40.0, 40.0, 40.0), (40.0, 40.0, 40.0))
    runs = [make_run(scene="alley"), make_run(psnr=better), make_run("chronogs", psnr=easy)]
    enter(runs, tmp_path / "e")
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    rows = [row for row in Page(tmp_path / "site/index.html").rows if "(joint" in row]
    assert ["23.00" in rows[0], "40.00" in rows[0], "30.00" in rows[1]] == [True] * 3


def test_claimed_results_stand_below_and_are_not_ranked(make_run, enter, tmp_path):
    better = ((38.0, 39.0, 40.0), (31.0, 32.0, 33.0))
    enter([make_run("4dgs"), make_run("chronogs"), make_run(psnr=better)], tmp_path / "e")
    found = [
        replace(s, claimed="" if s.entry.key[3] != "3dgs" else NOT_ASKED)
        for s in standings(tmp_path / "e")
    ]
    write_site(found, load_published(), tmp_path / "site")
    for page in ("index.html", "scene/square.html"):
        text = (tmp_path / "site" / page).read_text(encoding="utf-8")
        verified, claimed = text.split('<tbody class="claimed">')
        assert "Verified" in verified and "ChronoGS (joint" in verified
        assert "35.50" not in verified and "35.50" in claimed
        assert "<b>35.50" not in claimed and "†" not in claimed.split("</tbody>")[0]
    page = (tmp_path / "site/method/3dgs.html").read_text(encoding="utf-8")
    assert "<td>claimed</td>" in page and "<td>verified</td>" not in page
    assert "3 3DGS" not in (tmp_path / "site/scene/square.html").read_text()  # in the plots


def test_the_board_gives_titles_and_only_methods_that_are_installed_have_commands(
    make_run, enter, tmp_path
):
    make_run(title="ChronoGS"), make_run("chronogs-official", title="x", variant="prefix=sudo")
    make_run("3dgs", 1, preset="mine", config_hash="e" * 64)
    enter([tmp_path / "runs"], tmp_path / "e")
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    page = (tmp_path / "site/method/3dgs.html").read_text(encoding="utf-8")
    assert "<h1>3DGS</h1>" in page and "3DGS (joint, fast)" in page
    assert "ChronoGS" not in page.split("<footer")[0].split("</nav>")[1]
    assert "--preset fast" in page and "--preset mine" not in page
    page = (tmp_path / "site/method/chronogs-official.html").read_text(encoding="utf-8")
    assert "ChronoGS (official) (joint" in page and "sudo<" not in page


def test_texts_of_entries_are_escaped(site):
    text = (site / "scene/square.html").read_text(encoding="utf-8")
    assert html.escape(NASTY).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in text
    found = re.search(r'<script type="application/json" id="pictures">(.*?)</script>', text)
    assert json.loads(found[1])["periods"] == [NASTY, "late"]


def test_best_and_ties_are_marked_and_means_have_intervals(site):
    rows = Page(site / "scene/square.html").rows
    (ours,) = [row for row in rows if row.startswith(" ChronoGS")]
    (others,) = [row for row in rows if row.startswith(" lab-method, not registered")]
    (worse,) = [row for row in rows if row.startswith(" 3DGS")]
    assert f"0: {NASTY}" in rows[0] and "1: late" in rows[0]
    assert "30.50" in ours and " to " in ours
    assert "†" in ours + others and "†" not in worse
    assert worse.endswith(" 0 1")


def test_published_rows_are_apart_and_not_ranked(site):
    text = (site / "scene/lawncourt.html").read_text(encoding="utf-8")
    measured, published = text.split('<tbody class="published">')
    assert "4DGS, tuned (joint" in measured and "22.16" not in measured
    assert "22.16" in published and "<b>22.16" not in published
    assert "†" not in published


def test_methods_say_what_they_are_and_how_far_they_are_reproduced(site):
    page = (site / "method/4dgs.html").read_text(encoding="utf-8")
    assert "1 of its 12 published scenes has verified results here" in page
    assert "+3.97" in page  # 23.00 less 19.03
    assert "chronoscene bench SCENE --method 4dgs --strategy joint" in page
    assert "Apache-2.0" in page
    unknown = (site / "method/lab-method.html").read_text(encoding="utf-8")
    assert "not one of the methods that come with ChronoScene" in unknown


def test_the_names_of_an_entry_import_nothing(make_run, enter, tmp_path, monkeypatch):
    make_run(method="os:system")
    enter([tmp_path / "runs"], tmp_path / "e")
    monkeypatch.setattr("leaderboard.registry.load_spec", lambda name: pytest.fail(name))
    monkeypatch.setattr("leaderboard.registry.installed_methods", dict)
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")


def test_all_numbers_of_the_paper_are_on_a_page(site):
    rows = Page(site / "published.html").rows
    published = load_published()
    count = len(published.rows) + sum(len(table.rows) for table in published.tables)
    heads, memory = len(published.tables) + 2, len(published.memory_gb["real"])
    assert len(rows) == count + heads + memory


def test_scenes_of_one_name_have_rows_of_their_own(make_run, enter, tmp_path):
    enter([make_run()], tmp_path / "e")
    enter(
        [make_run(split_hash="f" * 64, psnr=((11.0, 12.0, 11.5), (13.0, 14.0, 13.5)))],
        tmp_path / "e",
    )
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    for page in ("index.html", "scene/square.html", "method/3dgs.html"):
        text = (tmp_path / "site" / page).read_text(encoding="utf-8")
        assert "23.00" in text and "12.50" in text


def test_scenes_of_one_name_are_not_ranked_together(make_run, enter, tmp_path):
    enter([make_run()], tmp_path / "e")
    enter([make_run("4dgs", split_hash="f" * 64)], tmp_path / "e")
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    rows = Page(tmp_path / "site/index.html").rows
    at = [rows.index(f" Verified: 100 training steps, square [split {c * 6}]") for c in "bf"]
    assert [rows[i + 1].split()[0].strip(",") for i in at] == ["3DGS", "4DGS"]


def test_pages_say_what_is_of_older_code_and_the_role_of_a_scene(make_run, enter, tmp_path):
    (path,) = enter([make_run(seed=0)], tmp_path / "e")
    path.write_text(path.read_text().replace('"outdated": false', '"outdated": true'))
    enter([make_run(seed=1)], tmp_path / "e")  # which keeps the mark
    enter([make_run("lab-method")], tmp_path / "e")
    entries = standings(tmp_path / "e")
    write_site(entries, load_published(), tmp_path / "site", [tmp_path / "runs"])
    for page in ("index.html", "scene/square.html", "method/3dgs.html"):
        text = (tmp_path / "site" / page).read_text(encoding="utf-8")
        assert "3DGS of older code (" in text, page
        assert "lab-method, not registered of older code" not in text
    text = (tmp_path / "site/scene/square.html").read_text(encoding="utf-8")
    assert "This is a scene without a role" in text
    assert '<option value="0">3DGS of older code' in text
    assert "<h1>3DGS</h1>" in (tmp_path / "site/method/3dgs.html").read_text(encoding="utf-8")


def test_ranking_scenes_have_a_table_of_their_own(make_run, enter, tmp_path, monkeypatch):
    enter([make_run()], tmp_path / "e")
    for role, title in (("", "Other scenes"), ("ranking", "Ranking scenes, which")):
        monkeypatch.setattr("leaderboard.site.role_of", lambda digest, role=role: role)
        write_site(standings(tmp_path / "e"), load_published(), tmp_path / f"site{role}")
        text = (tmp_path / f"site{role}/index.html").read_text(encoding="utf-8")
        assert [t for t in ("Other scenes", "Ranking scenes, which") if t in text] == [title]


def test_times_of_devices_have_columns_of_their_own(make_run, enter, tmp_path):
    commit = "1" * 40 + "-dirty"
    enter([make_run(seconds=7.0, commit=commit)], tmp_path / "e")
    enter([make_run("4dgs", device="cuda (Test)", seconds=9.0)], tmp_path / "e")
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    page = tmp_path / "site/scene/square.html"
    head = Page(page).rows[0]
    assert "reported, cpu (Test, 2 threads)" in head and "reported, cuda (Test)" in head
    assert "code: 1111111111-dirty" in page.read_text()


def test_short_trainings_and_first_letters_come_first(make_run, enter, tmp_path):
    runs = [make_run("4dgs", iterations=1000), make_run("3dgs", iterations=500)]
    runs += [make_run(name, iterations=1000) for name in ("scaffold-gs", "realtime4dgs")]
    enter(runs, tmp_path / "e")
    write_site(standings(tmp_path / "e", "untested"), load_published(), tmp_path / "site")
    text = (tmp_path / "site/scene/square.html").read_text(encoding="utf-8")
    shown = "<h2>500 training", "<h2>1,000 training", ">4DGS", ">realtime4DGS", ">Scaffold-GS"
    assert [*shown] == sorted(shown, key=text.index)


def test_commands_make_the_run_again(make_run, enter, tmp_path):
    enter([make_run(variant="sh_degree=2,budget=90s", max_width=800)], tmp_path / "e")
    write_site(standings(tmp_path / "e"), load_published(), tmp_path / "site")
    page = (tmp_path / "site/method/3dgs.html").read_text(encoding="utf-8")
    assert "--seed 0 --set sh_degree=2 --budget 90s --max-width 800<" in page


def test_pictures_come_only_from_the_runs_of_an_entry(entries, make_run, tmp_path):
    make_run("lab-other")
    assert write_site(entries[:1], load_published(), tmp_path / "x", [tmp_path / "runs"]) == 0
    assert not (tmp_path / "x/images").exists()


def test_a_changed_picture_is_refused(entries, runs, tmp_path):
    shutil.copytree(runs, tmp_path / "runs")
    images = sorted((tmp_path / "runs/ground_truth/square/0").glob("*.png"))
    images[0].write_bytes(images[1].read_bytes())
    with pytest.raises(CheckpointError, match="another file"):
        write_site(entries, load_published(), tmp_path / "x", [tmp_path / "runs"])
    assert not (tmp_path / "x").exists()


def test_a_folder_in_use_is_kept(entries, site):
    with pytest.raises(SceneError, match="new or empty folder"):
        write_site(entries, load_published(), site)


def test_a_site_without_measurements(tmp_path):
    write_site([], load_published(), tmp_path / "x")
    assert "Nothing has been measured here yet" in (tmp_path / "x/index.html").read_text("utf-8")


HARNESS = """<!doctype html><body style="margin: 0">
<iframe src="scene/square.html" style="border: 0; width: 360px; height: 800px"></iframe>
<iframe src="scene/square.html" style="border: 0; width: 1280px; height: 800px"></iframe>
<iframe src="index.html" style="border: 0; width: 360px; height: 800px"></iframe>
<iframe src="method/4dgs.html" style="border: 0; width: 360px; height: 800px"></iframe>
<iframe src="published.html" style="border: 0; width: 360px; height: 800px"></iframe>
<script>
addEventListener("load", () => {
  const reports = [];
  for (const frame of document.querySelectorAll("iframe")) {
    const w = frame.contentWindow, d = w.document, get = (id) => d.getElementById(id);
    const report = { errors: w.errors, wide: d.documentElement.scrollWidth, width: w.innerWidth };
    reports.push(report);
    if (!get("compare")) continue;
    const table = d.querySelector("table"), names = () =>
      [...table.tBodies[0].rows].slice(1).map((row) => row.cells[0].textContent.split(" ")[0]);
    const buttons = [...table.querySelectorAll(".sort")];
    const size = buttons.find((b) => b.textContent.includes("size"));
    report.before = names();
    size.focus(); report.focus = d.activeElement === size;
    size.click(); report.up = names(); size.click(); report.down = names();
    report.sorted = size.closest("th").getAttribute("aria-sort");
    const move = (id, steps) => {
      get(id).focus(); report.focus &&= d.activeElement === get(id);
      get(id).stepUp(steps); get(id).dispatchEvent(new w.Event("input"));
    };
    move("cut", 20); report.cut = w.getComputedStyle(get("prediction")).clipPath;
    const images = [get("truth"), get("prediction")];
    report.loaded = images.every((image) => image.naturalWidth === 8);
    const period = get("truth").getAttribute("src");
    move("period", 1); report.which = get("which").textContent;
    report.moved = get("truth").getAttribute("src") !== period;
    get("method").value = "1"; get("method").dispatchEvent(new w.Event("input"));
    report.prediction = get("prediction").getAttribute("src");
  }
  document.body.dataset.report = JSON.stringify(reports);
});
</script>"""


def test_in_a_browser(site, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium here")
    site = shutil.copytree(site, tmp_path / "site")
    catch = (
        "<script>errors = []; addEventListener('error', (e) => errors.push(e.message));</script>"
    )
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        page.write_text(text.replace("<head>", f"<head>{catch}"), encoding="utf-8")
    (site / "harness.html").write_text(HARNESS, encoding="utf-8")
    options = "--headless --no-sandbox --disable-quic --no-first-run --disable-gpu --disable-sync "
    options += "--disable-background-networking --dump-dom --allow-file-access-from-files "
    options += f"--user-data-dir={tmp_path / 'profile'}"
    command = [browser, *options.split(), (site / "harness.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search('data-report="(.*?)"', done.stdout)
    assert found is not None, done.stdout[-2000:] + done.stderr[-500:]
    reports = json.loads(html.unescape(found[1]))
    assert [report["errors"] for report in reports] == [[]] * 5
    assert [report["width"] for report in reports] == [360, 1280, 360, 360, 360]
    assert all(report["wide"] <= report["width"] for report in reports)
    for report in reports[:2]:
        assert report["focus"]
        assert report["before"][-1] == "3DGS"
        assert report["up"][0] == "ChronoGS" and report["down"][-1] == "ChronoGS"
        assert report["sorted"] == "descending"
        assert "70%" in report["cut"]
        assert (report["which"], report["moved"]) == ("late", True)
        assert (site / "scene" / report["prediction"]).name == "0-1-1.webp"
        assert (site / "scene" / report["prediction"]).is_file()
        assert report["loaded"]
