"""The commands of the leaderboard, from finished runs to a site."""

from command_line import invoke
from made_runs import write_scored

from chronoscene.harness.score.scoring import rescore
from chronoscene.metrics.registry import make_scorers


def test_from_a_run_to_a_site(tmp_path):
    write_scored(tmp_path / "runs", scene="square")
    rescore(tmp_path / "runs", make_scorers(["psnr"]))
    done = invoke("submit", tmp_path / "runs", "--to", tmp_path / "entries")
    assert done.exit_code == 0, done.output
    (entry,) = (tmp_path / "entries").glob("*/*.json")
    assert f"wrote {entry}" in done.stderr
    (tmp_path / "entries/bad.json").write_text("{}")
    done = invoke("leaderboard", tmp_path / "entries", "--out", tmp_path / "site")
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines() == [
        "measured entries: 1; verified: 0; claimed: 1; of older code: 0; with pictures: 0",
        "claimed: 1: its scene was not named by --verify",
    ]
    assert f"left out: {tmp_path}/entries/bad.json: expected a measured entry" in done.stderr
    assert (tmp_path / "site/scene/square.html").is_file()


def test_says_why_there_are_no_pictures(tmp_path):
    write_scored(tmp_path / "runs", scene="square")
    (tmp_path / "entries").mkdir()
    done = invoke(
        "leaderboard", tmp_path / "entries", "--out", tmp_path / "site", "--runs", tmp_path / "runs"
    )
    assert done.exit_code == 0, done.output
    assert f"no pictures: no run in {tmp_path / 'runs'} is the first one of" in done.stdout
