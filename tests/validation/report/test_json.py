"""SARIF: what the schema requires, and where findings point to."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

import pytest
from PIL import Image

from chronoscene.validation.report.json import split_place, write_sarif
from chronoscene.validation.rules import all_rules
from chronoscene.validation.run import RULE_FAILED, validate_scene

LEVELS = {"none", "note", "warning", "error"}


@pytest.fixture
def document(scene):
    """Of a scene with findings of all severities, in files, lines, records and periods."""
    scene.path("images/a000.png").unlink()
    scene.write("sparse/split.txt", [*scene.lines("sparse/split.txt"), "nobody.png 1", "x"])
    scene.write("sparse/0/test.txt", "a003.png\n")
    return json.loads(write_sarif([scene.validate()]))


def check_message(message):
    assert set(message) == {"text"} and message["text"].strip()


def test_what_the_schema_requires(document):
    assert document["version"] == "2.1.0"
    assert document["$schema"].endswith("sarif-2.1.0.json")
    (run,) = document["runs"]
    driver = run["tool"]["driver"]
    assert driver["name"] and driver["version"]
    ids = [rule["id"] for rule in driver["rules"]]
    assert ids == [rule.code for rule in all_rules()] and len(set(ids)) == len(ids)
    for rule in driver["rules"]:
        for key in ("shortDescription", "fullDescription", "help"):
            check_message(rule[key])
        assert rule["defaultConfiguration"]["level"] in LEVELS
    for invocation in run["invocations"]:
        assert isinstance(invocation["executionSuccessful"], bool)
    assert run["originalUriBaseIds"]["SCENE"]["uri"].startswith("file:///")
    assert run["originalUriBaseIds"]["SCENE"]["uri"].endswith("/scene/")


def test_results(document):
    (run,) = document["runs"]
    assert {r["ruleId"] for r in run["results"]} >= {"CS201", "CS303", "CS309", "CS404", "CS507"}
    for result in run["results"]:
        assert run["tool"]["driver"]["rules"][result["ruleIndex"]]["id"] == result["ruleId"]
        assert result["level"] in LEVELS
        check_message(result["message"])
        (location,) = result["locations"]
        assert set(location) <= {"physicalLocation", "logicalLocations"}
        physical = location["physicalLocation"]  # code hosts refuse reports without it
        uri = physical["artifactLocation"]["uri"]
        assert not uri.startswith("/") and ".." not in unquote(uri).split("/")
        assert physical["artifactLocation"]["uriBaseId"] in run["originalUriBaseIds"]
        assert physical.get("region", {"startLine": 1})["startLine"] >= 1


def test_line_of_a_finding(document):
    (result,) = (r for r in document["runs"][0]["results"] if r["ruleId"] == "CS309")
    physical = result["locations"][0]["physicalLocation"]
    assert physical["artifactLocation"] == {"uri": "sparse/split.txt", "uriBaseId": "SCENE"}
    assert physical["region"] == {"startLine": 19}


def test_strict_makes_errors_of_warnings(scene):
    scene.write("sparse/0/test.txt", "a003.png\n")
    levels = [
        json.loads(write_sarif([scene.validate()], strict=strict))["runs"][0]["results"][0]["level"]
        for strict in (False, True)
    ]
    assert levels == ["warning", "error"]


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("sparse/split.txt", ("sparse/split.txt", None, None)),
        ("sparse/split.txt:12", ("sparse/split.txt", 12, None)),
        ("sparse/0/images.bin (a (1).jpg)", ("sparse/0/images.bin", None, "a (1).jpg")),
        ("images/a (1):2.jpg", ("images/a (1):2.jpg", None, None)),
        ("images", ("images", None, None)),
        ("period 12", ("sparse/split.txt", None, "period 12")),
        ("periods 2, 3", ("sparse/split.txt", None, "periods 2, 3")),
        ("colmap/sparse/0/images.txt (b.jpg)", ("colmap/sparse/0/images.txt", None, "b.jpg")),
        ("./frames.bin", ("frames.bin", None, None)),
        (".", (".", None, None)),
    ],
)
def test_places(place, expected):
    assert split_place(place) == expected


def pointed_at(run):
    """Files that the results of a run are in."""
    base = run["originalUriBaseIds"]["SCENE"]["uri"]
    for result in run["results"]:
        uri = result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"]
        assert re.fullmatch(r"([A-Za-z0-9._~/-]|%[0-9A-F]{2})+", uri)
        yield Path(unquote(urlsplit(urljoin(base, uri)).path))


def test_names_are_escaped(scene):
    names = ["a b.png", "Größe.png", "城.png", "50%41.png", "#?&+;.png", "a:2 (3).png", "x/y z.png"]
    scene.path("images/x").mkdir()
    for name in names:
        Image.new("RGB", (64, 40)).save(scene.path(f"images/{name}"))
    (run,) = json.loads(write_sarif([scene.validate()]))["runs"]
    assert set(pointed_at(run)) >= {scene.path(f"images/{name}") for name in names}


def test_a_known_name_as_the_standard_writes_it(scene):
    scene.save("a000.png", Image.new("RGB", (64, 40)), as_name="ä b#?.png")
    assert '"uri": "images/%C3%A4%20b%23%3F.png"' in write_sarif([scene.validate()])


def test_the_scene_may_be_anywhere(scene, tmp_path):
    scene.path("images/a000.png").unlink()
    place = tmp_path / "100% Straße #1" / "my scene"
    place.parent.mkdir()
    shutil.copytree(scene.root, place)
    (run,) = json.loads(write_sarif([validate_scene(place)]))["runs"]
    assert "/100%25%20Stra%C3%9Fe%20%231/my%20scene/" in run["originalUriBaseIds"]["SCENE"]["uri"]
    assert place / "images/a000.png" in pointed_at(run)


def test_a_model_in_another_place(scene):
    shutil.copytree(scene.path("sparse/0"), scene.path("colmap/sparse/0"))
    shutil.rmtree(scene.path("sparse/0"))
    (run,) = json.loads(write_sarif([scene.validate()]))["runs"]
    assert scene.path("colmap/sparse/0/points3D.txt") in pointed_at(run)


def test_a_rule_that_failed_is_told_apart(scene):
    report = scene.validate()
    failure = replace(report.findings[0], code=RULE_FAILED, place="rule CS201")
    report = replace(report, findings=(*report.findings, failure))
    (run,) = json.loads(write_sarif([report]))["runs"]
    (invocation,) = run["invocations"]
    assert invocation["executionSuccessful"] is False
    (notification,) = invocation["toolExecutionNotifications"]
    assert notification["level"] == "error" and "rule CS201" in notification["message"]["text"]
    assert len(run["results"]) == len(report.findings) - 1


def test_each_scene_is_a_run_with_a_name_of_its_own(scene):
    report = scene.validate()
    empty = replace(report, name="other", findings=())
    runs = json.loads(write_sarif([report, empty]))["runs"]
    assert [run["automationDetails"]["id"] for run in runs] == [
        "chronoscene/scene/",
        "chronoscene/other/",
    ]
    assert runs[1]["results"] == [] and runs[1]["invocations"][0]["executionSuccessful"] is True
