"""Entries are verified with scenes that options read."""

import json
import shutil

import pytest
from command_line import run_command
from PIL import Image

from chronoscene.formats import detect, read_scene
from chronoscene.harness.files.records import ViewScore
from chronoscene.harness.files.source import read_bench_scene
from chronoscene.harness.score.scoring import aggregate, rescore
from chronoscene.harness.score.verification import verify
from chronoscene.metrics.registry import make_scorers
from leaderboard.board import NO_ENTRY, read_board
from leaderboard.entries import read_entry
from leaderboard.submit import submit
from leaderboard.verification import verify_entries


@pytest.fixture
def project(make_scene_folder, noisy, tmp_path):
    """A COLMAP project whose periods are in a table, and an entry of it beside it."""
    folder = make_scene_folder({f"{i}.png": i % 2 for i in range(32)}, name="project")
    shutil.move(folder / "sparse/split.txt", tmp_path / "split.txt")
    lines = (f"{i}.png,{i % 2}\n" for i in range(32))
    (tmp_path / "periods.csv").write_text("file,period\n" + "".join(lines))
    scene = read_scene(folder, period_by=f"table:{tmp_path}/periods.csv")
    noisy(tmp_path / "runs", scene, "3dgs", 0, noise=30)
    rescore(tmp_path / "runs", make_scorers(["psnr"]))
    submit([tmp_path / "runs"], tmp_path / "entries")
    return folder


def test_periods_by_an_option_are_verified(project, tmp_path):
    table = tmp_path / "periods.csv"
    verify = ("--verify", project, "--period-by", f"table:{table}", "--out")
    done = run_command("leaderboard", tmp_path / "entries", *verify, tmp_path / "site")
    assert done.exit_code == 0 and NO_ENTRY not in done.stderr
    assert done.stdout.startswith("measured entries: 1; verified: 1; claimed: 0;")
    table.write_text(table.read_text().replace("0.png,0", "0.png,1"))
    done = run_command("leaderboard", tmp_path / "entries", *verify, tmp_path / "another")
    assert done.exit_code == 0 and f"{project}: {NO_ENTRY}" in done.stderr
    assert done.stdout.startswith("measured entries: 1; verified: 0; claimed: 1;")


@pytest.fixture
def hidden(project, noisy, tmp_path):
    """The project with a test view whose mask ignores every pixel, and a run on it."""
    (project / "masks").mkdir()
    rule = f"table:{tmp_path}/periods.csv"
    view = read_scene(project, period_by=rule).select(split="test")[0].name
    Image.new("L", (64, 48)).save(project / f"masks/{view}.png")
    noisy(tmp_path / "masked", read_scene(project, period_by=rule), "3dgs", 0, noise=30)
    rescore(tmp_path / "masked", make_scorers(["psnr", "ssim"]))
    return view


def test_a_view_whose_mask_ignores_every_pixel_has_no_values(project, hidden, tmp_path):
    (path,) = submit([tmp_path / "masked"], tmp_path / "entries/masked")
    scored = {view.view: [*view.values] for view in read_entry(path).runs[0].views}
    assert len(scored) > 2
    assert scored == {view: [] if view == hidden else ["psnr", "ssim"] for view in scored}
    (found,) = verify_entries(path.parents[1], verify(tmp_path / "masked"))
    assert (found.verdict, found.differs) == ("ok", [])
    rule = ("--period-by", f"table:{tmp_path}/periods.csv")
    site = (path.parents[1], "--verify", project, *rule, "--out", tmp_path / "site")
    done = run_command("leaderboard", *site)
    assert done.stdout.startswith("measured entries: 1; verified: 1; claimed: 0;"), done.output


@pytest.mark.parametrize("forgery", ["values of the hidden view", "no values of another one"])
def test_values_of_other_views_than_those_that_count_are_refused(
    project, hidden, tmp_path, forgery
):
    (path,) = submit([tmp_path / "masked"], tmp_path / "entries/masked")
    document = json.loads(path.read_text())
    (run,) = document["runs"]
    views = {view["view"]: view for view in run["views"]}
    other = next(name for name in views if name != hidden)
    if forgery == "values of the hidden view":
        views[hidden]["values"] = views[other]["values"]
    else:
        views[other]["values"] = {}
    rows = [
        ViewScore(v["view"], v["period"], v["period"], "all", name, value)
        for v in run["views"]
        for name, value in v["values"].items()
    ]
    run["record"]["aggregates"], run["record"]["periods"] = aggregate(rows)
    path.write_text(json.dumps(document))
    board = read_board(path.parents[1], [project], period_by=f"table:{tmp_path}/periods.csv")
    assert not board.standings
    found = f"expected no values of {hidden!r}, whose mask ignores every pixel, found some"
    if forgery != "values of the hidden view":
        found = f"expected values of {other!r}, whose photo has pixels that count, found none"
    assert found in board.notices[0]


@pytest.mark.parametrize(("shrink", "verified"), [(4, 1), (1, 0)])
def test_runs_under_a_protocol_are_verified_at_its_size(
    make_scene_folder, noisy, tmp_path, shrink, verified
):
    names = [f"20{9 + i // 9:02d}-0{i % 9 + 1}-01_{i}.png" for i in range(18)]
    folder, wall = make_scene_folder(dict.fromkeys(names, 0), name="plain"), tmp_path / "wall"
    shutil.copytree(folder / "images", wall / "dense/images")
    shutil.copytree(folder / "sparse/0", wall / "dense/sparse")
    (wall / "annots").mkdir()
    (wall / "annots/train.txt").write_text("\n".join(names))
    found = detect(wall, format="neusc", period_by="year")
    scene = read_bench_scene(found, validation=False, shrink=shrink)
    noisy(tmp_path / "runs", scene, "3dgs", 0, noise=30, protocol="5pointz")
    rescore(tmp_path / "runs", make_scorers(["psnr"]))
    submit([tmp_path / "runs"], tmp_path / "entries")
    board = read_board(tmp_path / "entries", [wall], format="neusc", period_by="year")
    assert [not standing.claimed for standing in board.standings] == [bool(verified)]
    assert board.notices == ([] if verified else [f"{wall}: {NO_ENTRY}"])


def test_options_of_reading_need_a_scene(project, tmp_path):
    site = (tmp_path / "entries", "--out", tmp_path / "site")
    done = run_command("leaderboard", *site, "--period-by", "year")
    assert done.exit_code == 2
    assert "--period-by: expected no such option without --verify" in done.stderr
