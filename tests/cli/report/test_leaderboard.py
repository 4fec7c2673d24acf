"""The commands of the leaderboard, from finished runs to a site."""

from click.testing import CliRunner
from made_runs import write_scored

from chronoscene.cli import cli


def invoke(*args):
    return CliRunner().invoke(cli, [str(arg) for arg in args])


def test_from_a_run_to_a_site(tmp_path):
    write_scored(tmp_path / "runs")
    done = invoke("submit", tmp_path / "runs", "--to", tmp_path / "entries")
    assert done.exit_code == 0, done.output
    (entry,) = (tmp_path / "entries").iterdir()
    assert f"wrote {entry}" in done.stderr
    done = invoke("leaderboard", tmp_path / "entries", "--out", tmp_path / "site")
    assert done.exit_code == 0, done.output
    assert done.stdout == "1 measured entries: 0 of older code, 0 with pictures\n"
    assert (tmp_path / "site/scene/plaza.html").is_file()
