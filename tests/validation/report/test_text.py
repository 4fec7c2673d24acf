"""Text and JSON."""

import json
from pathlib import Path

import click
import pytest

from chronoscene.io.wording import counted, printable, quote, shown
from chronoscene.validation.report.json import SCHEMA_VERSION, write_json
from chronoscene.validation.report.text import write_text
from chronoscene.validation.rule import (
    Finding,
    PeriodSummary,
    SceneReport,
    Skipped,
    Summary,
    counts,
)


def finding(i=0, *, code="CS201", severity="error", found="nothing", remedy="copy it"):
    name = {"CS201": "image-missing", "CS507": "points-of-one-period"}[code]
    return Finding(code, name, severity, f"images/{i}.jpg", "an image", found, remedy, 1)


def report(*findings, name="scene", skipped=()):
    periods = (PeriodSummary(0, 7, 6, 1), PeriodSummary(1, 7, None, None, label="autumn"))
    summary = Summary(14, 1, None, None, 15, periods)
    return SceneReport(name, Path("data") / name, summary, tuple(findings), tuple(skipped))


def text_of(*reports, **options):
    return click.unstyle(write_text(reports, **options))


def test_text_of_a_scene():
    skipped = [Skipped("CS206", "why not"), Skipped("CS604", "why not")]
    remark = finding(3, code="CS507", severity="info", remedy="nothing to do")
    assert text_of(report(finding(), remark, skipped=skipped)).splitlines() == [
        "scene: 14 images, 1 camera, points unknown, 2 periods (0: 6 + 1 test, 1 (autumn): 7)",
        "  error CS201 image-missing: The file of a registered image is missing.",
        "    images/0.jpg: expected an image, found nothing",
        "    to do: copy it",
        "  info CS507 points-of-one-period: Number of points seen in a single period, and in "
        "several.",
        "    images/3.jpg: expected an image, found nothing",
        "  not checked (why not): CS206, CS604",
        "  1 error, 0 warnings, 1 remark",
    ]


def test_equal_findings_are_folded():
    lines = text_of(report(*map(finding, range(12)))).splitlines()
    assert "(12 findings)" in lines[1]
    places = "images/0.jpg, images/1.jpg, images/2.jpg and 9 more"
    assert lines[2] == f"    {places}: expected an image, found nothing"
    assert len(lines) == 5


def test_each_of_several_remedies_says_what_it_is_for():
    lines = text_of(report(finding(0), finding(1, remedy="draw it"), finding(2))).splitlines()
    assert "    to do for images/0.jpg, images/2.jpg: copy it" in lines
    assert "    to do for images/1.jpg: draw it" in lines


def test_many_different_findings_are_cut():
    lines = text_of(report(*(finding(i, found=f"x{i}") for i in range(12)))).splitlines()
    assert sum("expected an image" in line for line in lines) == 5
    assert "    and 7 more (--format json lists all)" in lines


def test_several_scenes_end_in_a_total():
    text = text_of(report(finding()), report(name="other"))
    assert text.endswith("2 scenes, 1 not valid: 1 error, 0 warnings, 0 remarks\n")
    warned = report(finding(severity="warning"))
    assert "2 scenes, 0 not valid" in text_of(warned, warned)
    assert "2 scenes, 2 not valid" in text_of(warned, warned, strict=True)


def test_rules_that_were_not_run_are_folded():
    skipped = tuple(Skipped(f"CS4{i:02d}", "no model") for i in range(11))
    report = SceneReport("a", Path("a"), Summary(0, 0, 0, 0, 0, ()), (), skipped)
    line = write_text([report]).splitlines()[1]
    assert line.startswith("  not checked (no model): CS400, ")
    assert line.endswith("CS407 and 3 more")


def test_json_has_every_finding():
    document = json.loads(write_json([report(*map(finding, range(12)), name="scène")]))
    assert document["schema_version"] == SCHEMA_VERSION
    assert document["valid"] is False
    assert document["counts"] == {"error": 12, "warning": 0, "info": 0}
    (scene,) = document["scenes"]
    assert (scene["name"], scene["path"]) == ("scène", "data/scène")
    assert scene["counts"] == document["counts"]
    assert [f["place"] for f in scene["findings"]] == [f"images/{i}.jpg" for i in range(12)]
    assert scene["findings"][0] == {
        "code": "CS201",
        "name": "image-missing",
        "severity": "error",
        "place": "images/0.jpg",
        "expected": "an image",
        "found": "nothing",
        "remedy": "copy it",
        "count": 1,
        "also": [],
    }
    assert scene["summary"]["periods"][0] == {
        "id": 0,
        "images": 7,
        "train": 6,
        "test": 1,
        "reprojection_px": None,
        "label": None,
    }


@pytest.mark.parametrize(
    ("severity", "strict", "valid"),
    [
        ("error", False, False),
        ("warning", False, True),
        ("warning", True, False),
        ("info", 1, True),
    ],
)
def test_json_says_whether_the_scenes_are_valid(severity, strict, valid):
    document = json.loads(write_json([report(finding(severity=severity))], strict=bool(strict)))
    assert document["valid"] is valid


def test_counts():
    reports = [report(finding(), finding(severity="info")), report(finding())]
    assert counts(reports) == {"error": 2, "warning": 0, "info": 1}


def test_words():
    assert (counted(1, "image"), counted(0, "image")) == ("1 image", "0 images")
    assert shown("abcde") == "'a', 'b', 'c' and 2 more"
    assert shown("ab") == "'a', 'b'"
    assert len(quote("x" * 10_000)) < 150
    assert printable("grün ok") == "grün ok"
    assert printable("a\tb\u202e") == "a\\tb\\u202e"


def test_lines_are_broken_for_a_terminal_only(scene):
    scene.path("images/a000.png").unlink()
    report = scene.validate()
    whole = write_text([report])
    assert max(map(len, whole.splitlines())) > 100
    broken = write_text([report], width=80)
    assert max(len(click.unstyle(line)) for line in broken.splitlines()) <= 80
    assert broken.split() == whole.split()
