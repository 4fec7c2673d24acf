"""``chronoscene stats`` from the outside."""

import csv
import hashlib
import io
import json
import os
import re
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from command_line import run_command
from fresh_process import run_python

from benchmarks.data.skeletons.dataset import write_skeleton
from chronoscene.cli import cli
from chronoscene.cli.scenes.stats import against_paper
from chronoscene.errors import ConfigError
from chronoscene.io.tables import FORMATS
from chronoscene.statistics.counts import PAPER_COUNTS, PeriodCount, SceneCount


@pytest.fixture
def one_process(monkeypatch):
    """Scenes are read here: starting processes takes longer than tiny scenes do."""
    monkeypatch.setattr(
        "chronoscene.cli.scenes.stats.map_parallel", lambda f, items, lost: map(f, items)
    )


def run(*args: object):
    return CliRunner().invoke(cli, ["stats", *map(str, args)])


def test_a_scene(make_scene_folder):
    result = run(make_scene_folder(), "--layout", "paper")
    assert result.exit_code == 0, result.output
    (row,) = [line for line in result.stdout.splitlines() if line.lstrip().startswith("scene ")]
    images_0, points_0, images_1, points_1, images, points = map(int, row.split()[1:])
    assert (images_0, images_1, images, points) == (2, 2, 4, 30)
    assert points_0 + points_1 == 30


def test_without_a_folder_the_current_one_or_data(make_scene_folder, tmp_path, monkeypatch):
    make_scene_folder(name="data/place")
    results = []
    for here in (tmp_path, tmp_path / "data", tmp_path / "data" / "place"):
        monkeypatch.chdir(here)
        results.append(run("--layout", "paper", "--format", "csv"))
    assert {result.exit_code for result in results} == {0}
    assert len({result.stdout for result in results}) == 1 and "place" in results[0].stdout


def test_a_folder_of_scenes_and_several_folders(make_scene_folder, tmp_path, one_process):
    make_scene_folder(name="set/b")
    make_scene_folder({"1.png": 0, "2.png": 1, "3.png": 2}, name="set/a")
    single = make_scene_folder(name="single")
    result = run(tmp_path / "set", single, "--layout", "paper", "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [row["scene"] for row in rows] == ["a", "b", "single", "Total"]
    assert [row["period_2_images"] for row in rows] == ["1", "", "", "1"]
    assert [row["total_images"] for row in rows] == ["3", "4", "4", "11"]


@pytest.mark.parametrize("layout", ["full", "paper"])
@pytest.mark.parametrize("output_format", FORMATS)
def test_out_holds_what_would_be_printed(make_scene_folder, tmp_path, output_format, layout):
    folder = make_scene_folder()
    options = ("--format", output_format, "--layout", layout)
    printed = run(folder, *options)
    out = tmp_path / "counts"
    written = run(folder, *options, "--out", out)
    assert (written.exit_code, written.stdout) == (0, "")
    assert written.stderr == f"measure scenes\nwrote {out}\n"
    assert out.read_text(encoding="utf-8") == printed.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["counts", "scene"]


def test_seen_counts_more(make_scene_folder):
    folder = make_scene_folder()

    def points(*args: object) -> list[int]:
        data = json.loads(run(folder, "--format", "json", *args).stdout)
        return [p["points"] for p in data["scenes"][0]["periods"]]

    assert sum(points()) == 30
    assert sum(points("--count", "seen")) > 30


def test_the_scene_folder_stays_as_it_is(make_scene_folder):
    folder = make_scene_folder()

    def state():
        return {
            p: (p.stat().st_mtime_ns, p.is_file() and hashlib.sha256(p.read_bytes()).hexdigest())
            for p in folder.rglob("*")
        }

    before = state()
    run(folder)
    assert state() == before


def test_points_that_no_image_sees_are_mentioned(make_scene_folder):
    folder = make_scene_folder(form="text")
    with (folder / "sparse/0/points3D.txt").open("a") as file:
        file.write("99 1 2 3 4 5 6 0.5\n")
    result = run(folder)
    assert "scene: 1 point is seen by no image" in result.stderr
    assert "no image" not in result.stdout


def shell(*args: object) -> Result:
    return run_command("stats", *args)


def test_errors_are_one_line_with_status_2(make_scene_folder, tmp_path):
    done = shell(tmp_path)
    assert done.exit_code == 2
    assert "expected a scene of a known format (" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    folder = make_scene_folder()
    (folder / "sparse/split.txt").write_text("a/0001.png\n")
    done = shell(folder)
    assert done.exit_code == 2
    assert 'split.txt:1: expected "<image name> <period id>"' in done.stderr
    assert "Traceback" not in done.stderr and done.stdout == ""


def test_out_in_a_missing_folder_is_an_error(make_scene_folder, tmp_path):
    result = run(make_scene_folder(), "--out", tmp_path / "no" / "file.txt")
    assert "expected a file that can be written" in str(result.exception)


def test_help_states_the_rule():
    text = " ".join(run("--help").output.split())
    assert "the paper does not say how its table splits it" in text
    assert "the earliest of several" in text


def test_torch_is_not_needed(make_scene_folder):
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('torch', 'numba', 'pandas')))\n"
        "from chronoscene.cli import main; main()"
    )
    assert "Observations" in run_python(code, "stats", make_scene_folder())


def test_several_scenes_are_read_in_several_processes(make_scene_folder, tmp_path):
    folders = [make_scene_folder(name=f"set/{i}", points=20 + i) for i in range(3)]
    done = shell(tmp_path / "set", "--format", "json")
    assert done.exit_code == 0, done.stderr
    scenes = json.loads(done.stdout)["scenes"]
    assert [(s["name"], s["points"]) for s in scenes] == [("0", 20), ("1", 21), ("2", 22)]
    (folders[1] / "sparse/split.txt").write_text("a/0001.png\n")


@pytest.mark.parametrize("layout", ["full", "paper"])
def test_a_scene_that_cannot_be_read_does_not_cost_the_others(
    make_scene_folder, tmp_path, layout, one_process
):
    folders = [make_scene_folder(name=f"set/{i}") for i in range(3)]
    (folders[1] / "sparse/split.txt").write_text("a/0001.png\n")
    out = tmp_path / "out"
    options = ("--layout", layout, "--figures", out)
    done = shell(tmp_path / "set", *options, "--format", "json")
    assert done.exit_code == 1
    place = folders[1] / "sparse/split.txt"
    begin, *wrote, line = done.stderr.splitlines()
    assert begin == "measure scenes: 0 of 3"
    names = ("counts", "0_points", "2_points")
    assert wrote == [f"wrote {out / name}.png" for name in names]
    assert line.startswith(f"error: {place}:1: expected")
    data = json.loads(done.stdout)
    assert [s["name"] for s in data["scenes"]] == ["0", "2"]
    assert [u["path"] for u in data["unreadable"]] == [str(folders[1])]
    assert line == f"error: {data['unreadable'][0]['error']}"
    assert {p.name for p in out.iterdir()} == {"counts.png", "0_points.png", "2_points.png"}
    for folder in folders:
        (folder / "sparse/split.txt").write_text("a/0001.png\n")
    done = shell(tmp_path / "set", *options)
    assert (done.exit_code, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 4


def test_a_folder_that_is_no_scene_does_not_cost_the_others(
    make_scene_folder, tmp_path, one_process
):
    folder, other = make_scene_folder(), tmp_path / "absent"
    result = run(other, folder, "--format", "json")
    assert result.exit_code == 1
    data = json.loads(result.stdout)
    assert [s["name"] for s in data["scenes"]] == ["scene"]
    assert [u["path"] for u in data["unreadable"]] == [str(other)]
    assert "expected a scene folder, found nothing" in result.stderr


def test_cameras_are_drawn_in_figures_only(make_scene_folder):
    result = run(make_scene_folder(), "--cameras")
    assert result.exit_code == 2 and "--cameras needs --figures" in result.stderr


def test_a_form_of_figures_that_nobody_asked_for_is_refused(make_scene_folder):
    error = run(make_scene_folder(), "--figure-format", "pdf").exception
    assert isinstance(error, ConfigError)
    said = "--figure-format: expected no such option without --figures, found one; leave it out"
    assert str(error) == said


def test_a_scene_that_is_not_known_as_one_is_not_left_out_in_silence(
    make_scene_folder, tmp_path, one_process
):
    for name in "abc":
        make_scene_folder({"1.png": 0, "2.png": 1}, name=f"set/{name}")
    (tmp_path / "set/b/sparse/split.txt").unlink()
    (tmp_path / "set/notes").mkdir()
    result = run(tmp_path / "set", "--format", "json")
    assert result.exit_code == 1
    data = json.loads(result.stdout)
    assert [s["name"] for s in data["scenes"]] == ["a", "c"]
    assert [u["path"] for u in data["unreadable"]] == [str(tmp_path / "set/b")]
    assert "split.txt" in result.stderr and len(result.stderr.splitlines()) == 2


def test_out_is_looked_at_before_the_work(make_scene_folder, tmp_path, monkeypatch):
    folder = make_scene_folder()
    monkeypatch.setattr(
        "chronoscene.cli.scenes.stats.read_scene", lambda *_, **__: pytest.fail("work")
    )
    for out in (tmp_path, tmp_path / "no" / "file.txt", folder / "table.txt"):
        assert isinstance(run(folder, "--out", out).exception, ConfigError)


def test_counts_are_compared_with_those_of_the_paper(tmp_path, one_process):
    paper = PAPER_COUNTS["Lawncourt"]
    write_skeleton(tmp_path / "lawncourt", [(a, b // 100) for a, b in paper])
    write_skeleton(tmp_path / "other", [(3, 10)])
    result = run(tmp_path / "other", tmp_path / "lawncourt", "--layout", "paper")
    _, line = result.stderr.splitlines()
    assert line.startswith("lawncourt: the paper has 234 + 193 + 277 images and 85,655 + 57,884")
    data = json.loads(run(tmp_path / "lawncourt", "--format", "json").stdout)
    found = data["scenes"][0]["paper"]
    assert (found["same"], found["points"], found["images"]) == (False, 261_134, 704)


def test_what_is_said_about_the_paper():
    def counted(name: str, rows) -> SceneCount:
        periods = tuple(PeriodCount(i, str(i), None, a, a, 0, b) for i, (a, b) in enumerate(rows))
        sums = [sum(column) for column in zip(*rows, strict=True)]
        return SceneCount(name, name, "x", "r", "h", "assigned", periods, sums[0], sums[1], 0)

    same = [counted(name, PAPER_COUNTS[name]) for name in ("Aerial1", "Canteen")]
    (line,) = against_paper(same)
    assert line == "images and points of all periods are those of the paper: Aerial1, Canteen"
    (a, b), *rest = PAPER_COUNTS["TriPlot"]
    shifted = [(a, b - 7), (rest[0][0], rest[0][1] + 7), rest[1]]
    (line,) = against_paper([counted("TriPlot", shifted)])
    assert "points in all are those of the paper" in line and "150,896 + 50,081" in line
    assert not list(against_paper([counted("Elsewhere", rest)]))


def test_scenes_of_the_paper_are_in_its_order(make_scene_folder, tmp_path, one_process):
    for name in ("Aerial1", "Lawncourt", "Zoo", "Canteen", "Abbey"):
        make_scene_folder(name=f"set/{name}")
    data = json.loads(run(tmp_path / "set", "--format", "json").stdout)
    names = [s["name"] for s in data["scenes"]]
    assert names == ["Lawncourt", "Canteen", "Aerial1", "Abbey", "Zoo"]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are not bytes here")
def test_names_that_are_not_text(make_scene_folder, tmp_path):
    folder = make_scene_folder().rename(os.fsdecode(bytes(tmp_path) + b"/bad\xff$x$"))
    for output_format in FORMATS:
        result = run(folder, "--format", output_format, "--out", tmp_path / "table")
        assert result.exit_code == 0, result.exception
        assert "bad" in (tmp_path / "table").read_text(encoding="utf-8")
    out = tmp_path / "out"
    result = run(folder, "--figures", out, "--pages", out, "--figure-format", "svg")
    assert result.exit_code == 0, result.exception
    assert len(list(out.iterdir())) == 3


def test_figures_and_pages_of_every_scene(make_scene_folder, tmp_path, one_process):
    folders = [make_scene_folder(name=name) for name in ("one/place", "two/place", "hill")]
    out = tmp_path / "out" / "deep"
    options = ["--figures", out, "--figure-format", "svg", "--cameras", "--pages", out / "pages"]
    result = run(*folders, *options)
    assert result.exit_code == 0, result.output
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()) == [
        "counts.svg",
        "hill_points.svg",
        "pages/hill.html",
        "pages/place.html",
        "pages/place_2.html",
        "place_2_points.svg",
        "place_points.svg",
    ]
    assert result.stdout.count("place") == 2


@pytest.mark.parametrize("option", ["--figures", "--pages"])
def test_nothing_is_drawn_into_a_scene(make_scene_folder, option):
    folder = make_scene_folder()
    result = run(folder, option, folder / "figures")
    assert "nothing is written into a dataset" in str(result.exception)
    assert not (folder / "figures").exists()


def test_a_place_for_figures_that_is_a_file(make_scene_folder, tmp_path):
    (tmp_path / "file").touch()
    result = run(make_scene_folder(), "--figures", tmp_path / "file")
    assert "expected a folder that can be made" in str(result.exception)


def test_options_in_the_documentation_exist():
    text = (Path(__file__).parents[3] / "docs/guides/statistics.md").read_text(encoding="utf-8")
    lines = re.findall(r"^chronoscene (\w+) (.*?)(?:#.*)?$", text, re.M)
    assert {command for command, _ in lines} == {"stats"}
    for command, arguments in lines:
        known = CliRunner().invoke(cli, [command, "--help"]).output
        assert all(option in known for option in re.findall(r"--[a-z-]+", arguments))
