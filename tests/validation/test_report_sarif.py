"""SARIF: what the schema requires, and where findings point to."""

import json
from urllib.parse import unquote

import pytest
from PIL import Image

from chronoscene.validation.report_sarif import split_place, write_sarif
from chronoscene.validation.rule import all_rules

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
        for location in result["locations"]:
            assert set(location) <= {"physicalLocation", "logicalLocations"} and location
            if physical := location.get("physicalLocation"):
                uri = physical["artifactLocation"]["uri"]
                assert not uri.startswith("/") and ".." not in unquote(uri).split("/")
                assert physical.get("region", {"startLine": 1})["startLine"] >= 1


def test_line_of_a_finding(document):
    (result,) = (r for r in document["runs"][0]["results"] if r["ruleId"] == "CS309")
    physical = result["locations"][0]["physicalLocation"]
    assert physical["artifactLocation"] == {"uri": "sparse/split.txt", "uriBaseId": "SCENE"}
    assert physical["region"] == {"startLine": 15}


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
        ("period 1", (None, None, None)),
        ("rule CS201", (None, None, None)),
    ],
)
def test_places(place, expected):
    assert split_place(place) == expected


def test_names_are_escaped(scene):
    scene.save("a000.png", Image.new("RGB", (64, 40)), as_name="ä#?.png")
    text = write_sarif([scene.validate()])
    uris = {
        location["physicalLocation"]["artifactLocation"]["uri"]
        for result in json.loads(text)["runs"][0]["results"]
        for location in result["locations"]
        if "physicalLocation" in location
    }
    assert "images/%C3%A4%23%3F.png" in uris
