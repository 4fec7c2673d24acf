"""Entries are read as they were written; what cannot be true is refused in one line."""

import json
from pathlib import Path

import pytest

import leaderboard
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import ViewScore
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import aggregate
from leaderboard.board import read_board
from leaderboard.entries import read_entry


@pytest.fixture
def path(make_run, enter, tmp_path):
    (written,) = enter([make_run(), make_run(seed=1)], tmp_path / "entries")
    return written


def test_an_entry_gives_back_its_runs(path):
    runs = read_entry(path).runs
    assert [run.record.seed for run in runs] == [0, 1]
    assert runs[0].record.aggregates["macro"] == {"psnr": 23.0}
    assert [row.value for row in runs[0].rows] == [20, 21, 22, 24, 25, 26]


def first(document):
    return document["runs"][0]["record"]


def view(document):
    return document["runs"][0]["views"][0]


def set_all(document, **values):
    for run in document["runs"]:
        run["record"].update(values)


HOSTILE = {
    "script in a name": (
        lambda d: set_all(d, method="<script>alert(1)</script>"),
        "method is no plain",
    ),
    "script in a title": (
        lambda d: set_all(d, title="<img src=x onerror=alert(1)>"),
        "title is no plain",
    ),
    "script in a key": (lambda d: first(d)["skipped"].update({"<b>": "x"}), "markup"),
    "quotes in a name": (lambda d: set_all(d, scene='x" onload="y'), "scene is no plain name"),
    "path in a scene": (lambda d: set_all(d, scene="../../etc"), "scene is no plain name"),
    "path in a view": (lambda d: view(d).update(view="../../x.png"), "leads out of its folder"),
    "absolute view": (lambda d: view(d).update(view="/etc/passwd"), "leads out of its folder"),
    "control character": (lambda d: set_all(d, device="cpu\x1b[2J"), "control characters"),
    "long text": (lambda d: set_all(d, device="x" * 201), "too long"),
    "huge integer": (lambda d: first(d).update(primitives=10**30), "a number that cannot be: 1000"),
    "huge number": (lambda d: first(d).update(seconds=1e300), r"a number that cannot be: 1e\+300"),
    "huge metric": (lambda d: view(d)["values"].update(psnr=1e4), "psnr that cannot be: 10000"),
    "negative cost": (lambda d: first(d).update(seconds=-1.0), "seconds is negative"),
    "NaN": (lambda d: view(d)["values"].update(psnr=float("nan")), "psnr that cannot be: nan"),
    "infinity": (lambda d: first(d).update(seconds=float("inf")), "a number that cannot be: inf"),
    "infinity as text": (
        lambda d: view(d)["values"].update(psnr="Infinity"),
        "psnr that cannot be: inf",
    ),
    "hash of an image": (lambda d: view(d).update(sha256="0" * 63), "should match pattern"),
    "hash of the scene": (lambda d: set_all(d, scene_hash="x"), "scene_hash is no SHA-256"),
    "better mean": (lambda d: first(d)["aggregates"]["macro"].update(psnr=40.0), "not those of"),
    "better period": (lambda d: first(d)["periods"]["1"].update(psnr=40.0), "not those of"),
    "better view": (lambda d: view(d)["values"].update(psnr=40.0), "not those of"),
    "more metrics": (lambda d: first(d)["aggregates"]["macro"].update(ssim=1.0), "not those of"),
    "unknown metric": (
        lambda d: [v["values"].update(best=1.0) for r in d["runs"] for v in r["views"]],
        "unknown metrics: 'best'",
    ),
    "metric of one view": (lambda d: view(d)["values"].update(ssim=1.0), "other metrics than the"),
    "unknown field": (lambda d: d.update(rank=1), r"Extra inputs are not permitted \(rank\)"),
    "unknown field of a run": (lambda d: first(d).update(rank=1), r"not permitted \(.*rank\)"),
    "view twice": (lambda d: d["runs"][0]["views"].append(dict(view(d))), "a view twice"),
    "no views": (
        lambda d: (
            d["runs"][0].update(views=[]),
            first(d).update(periods={}, aggregates={"macro": {}, "micro": {}, "worst": {}}),
        ),
        "no period",
    ),
    "period without label": (lambda d: first(d).update(period_labels={}), "without a label"),
    "regions": (
        lambda d: first(d).update(regions={"changed": {}}),
        "regions and stages are no part",
    ),
    "validation": (
        lambda d: first(d).update(variant="sh_degree=2,validation=true"),
        "validation views: run bench without --validation",
    ),
    "half of the photos": (
        lambda d: first(d).update(fitted="left half"),
        "halves of photos: run bench without --fit-half",
    ),
    "seed twice": (lambda d: d["runs"].append(d["runs"][0]), "a seed twice"),
    "two methods": (lambda d: first(d).update(method="other"), "runs that differ in method"),
    "no runs": (lambda d: d.update(runs=[]), "at least 1 item"),
    "other version": (lambda d: d.update(format_version=2), "format_version"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_entries_are_refused(path, case):
    change, reason = HOSTILE[case]
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match=reason) as refused:
        read_entry(path)
    message = str(refused.value)
    assert message.startswith(f"{path}: expected a measured entry")
    assert "\n" not in message and "\x1b" not in message


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"runs": 1e999}'])
def test_what_is_no_entry_is_left_out_with_a_notice(path, text):
    (path.parent / "x.json").write_text(text)
    board = read_board(path.parent)
    assert len(board.standings) == 1
    (notice,) = board.notices
    assert notice.startswith(f"left out: {path.parent / 'x.json'}: expected a measured entry")


def test_large_files_are_not_read(path, monkeypatch):
    monkeypatch.setattr("leaderboard.entries.MAX_BYTES", 100)
    with pytest.raises(ConfigError, match="more than 100 bytes"):
        read_entry(path)


def test_the_first_of_two_files_of_one_entry_counts(path):
    path.with_name("z.json").write_text(path.read_text())
    board = read_board(path.parent)
    assert len(board.standings) == 1
    assert "z.json: expected a measured entry" in board.notices[0]
    assert f"the same runs as {path}" in board.notices[0]


def hide_hardest(run):
    """Take the values of the view that the run renders worst, with the means that follow."""
    min(run["views"], key=lambda view: view["values"]["psnr"])["values"] = {}
    rows = [
        ViewScore(v["view"], v["period"], v["period"], ALL, metric, value)
        for v in run["views"]
        for metric, value in v["values"].items()
    ]
    run["record"]["aggregates"], run["record"]["periods"] = aggregate(rows)


def test_hard_views_cannot_be_left_without_values(path):
    document = json.loads(path.read_text())
    hide_hardest(document["runs"][0])
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="seeds with values of different views"):
        read_entry(path)
    scenes = Path(leaderboard.__file__).parent / "entries" / "measured"
    document = json.loads(next((scenes / "ranking-street").glob("*.json")).read_text())
    for run in document["runs"]:
        hide_hardest(run)
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="other views or periods than the test views of"):
        read_entry(path)
