"""Entries are verified with scenes that options read."""

import shutil

import pytest
from command_line import run_command

from chronoscene.formats import read_scene
from chronoscene.harness.score.scoring import rescore
from chronoscene.metrics.registry import make_scorers
from leaderboard.board import NO_ENTRY
from leaderboard.submit import submit


@pytest.fixture
def project(make_scene_folder, noisy, tmp_path):
    """A COLMAP project whose periods are in a table, and an entry of it beside it."""
    folder = make_scene_folder({f"{i}.png": i % 2 for i in range(8)}, name="project")
    shutil.move(folder / "sparse/split.txt", tmp_path / "split.txt")
    lines = (f"{i}.png,{i % 2}\n" for i in range(8))
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
    assert done.stdout.startswith("1 measured entries: 1 verified, 0 claimed")
    table.write_text(table.read_text().replace("0.png,0", "0.png,1"))
    done = run_command("leaderboard", tmp_path / "entries", *verify, tmp_path / "another")
    assert done.exit_code == 0 and f"{project}: {NO_ENTRY}" in done.stderr
    assert done.stdout.startswith("1 measured entries: 0 verified, 1 claimed")


def test_options_of_reading_need_a_scene(project, tmp_path):
    site = (tmp_path / "entries", "--out", tmp_path / "site")
    done = run_command("leaderboard", *site, "--period-by", "year")
    assert done.exit_code == 2 and "--period-by: expected none without --verify" in done.stderr
