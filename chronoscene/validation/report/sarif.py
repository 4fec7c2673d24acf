"""Report as SARIF 2.1.0, which code hosts and editors show beside the files.

Source: OASIS, Static Analysis Results Interchange Format version 2.1.0, section 3.
"""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from chronoscene import __version__
from chronoscene.formats.chronoscene import SPLIT
from chronoscene.validation.finding import Finding, Severity
from chronoscene.validation.report.report import SceneReport
from chronoscene.validation.rule import GROUPS, Rule
from chronoscene.validation.rules import all_rules
from chronoscene.validation.run import RULE_FAILED

SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"

LEVELS: dict[Severity, str] = {"error": "error", "warning": "warning", "info": "note"}


def write_sarif(reports: Sequence[SceneReport], *, strict: bool = False) -> str:
    """All findings of some scenes as SARIF text: one run for each scene.

    With ``strict``, warnings have the level of errors.
    """
    rules = all_rules()
    document = {
        "$schema": SCHEMA,
        "version": "2.1.0",
        "runs": [_run(report, rules, strict) for report in reports],
    }
    return json.dumps(document, indent=1) + "\n"


def _run(report: SceneReport, rules: Sequence[Rule], strict: bool) -> dict[str, Any]:
    index = {rule.code: i for i, rule in enumerate(rules)}
    driver = {
        "name": "chronoscene validate",
        "version": __version__,
        "semanticVersion": __version__,
        "rules": [_rule(rule) for rule in rules],
    }
    failed = [f for f in report.findings if f.code == RULE_FAILED]
    return {
        "tool": {"driver": driver},
        "automationDetails": {"id": f"chronoscene/{report.name}/"},
        "originalUriBaseIds": {"SCENE": {"uri": _folder_uri(report.path)}},
        "invocations": [
            {
                "executionSuccessful": not failed,
                "toolExecutionNotifications": [
                    {"level": "error", "message": {"text": str(f)}} for f in failed
                ],
            }
        ],
        "results": [_result(f, index, strict) for f in report.findings if f.code in index],
    }


def _rule(rule: Rule) -> dict[str, Any]:
    return {
        "id": rule.code,
        "name": rule.name,
        "shortDescription": {"text": rule.what},
        "fullDescription": {"text": f"{rule.what} For example: {rule.bad}."},
        "help": {"text": f"What to do: {rule.remedy}."},
        "defaultConfiguration": {"level": LEVELS[rule.severity]},
        "properties": {"tags": [GROUPS[rule.code[:3]]]},
    }


def _result(finding: Finding, index: dict[str, int], strict: bool) -> dict[str, Any]:
    level = LEVELS[finding.severity]
    return {
        "ruleId": finding.code,
        "ruleIndex": index[finding.code],
        "level": "error" if strict and level == "warning" else level,
        "message": {"text": f"{finding}; {finding.remedy}"},
        "locations": [_location(finding.place)],
        "properties": {"count": finding.count},
    }


def _location(place: str) -> dict[str, Any]:
    """File, and line and record where the place names them.

    Always with a file: GitHub refuses a report with a location that has none.
    """
    file, line, what = split_place(place)
    physical: dict[str, Any] = {"artifactLocation": {"uri": quote(file), "uriBaseId": "SCENE"}}
    if line is not None:
        physical["region"] = {"startLine": line}
    location: dict[str, Any] = {"physicalLocation": physical}
    if what is not None:
        location["logicalLocations"] = [{"fullyQualifiedName": what}]
    return location


def split_place(place: str) -> tuple[str, int | None, str | None]:
    """File, line and record of ``file``, ``file:line`` or ``file (record)``.

    A period is in the file that says which images it has.
    """
    if place.startswith("images/"):
        return place, None, None  # names of photos may hold anything
    if re.fullmatch(r"period -?[0-9]+|periods -?[0-9]+(, -?[0-9]+)+", place):
        return SPLIT, None, place
    parts = re.fullmatch(
        r"(?P<file>.*?)(?::(?P<line>[1-9][0-9]{0,8}))?(?: \((?P<what>.*)\))?", place, re.DOTALL
    )
    assert parts is not None  # the first group takes any text
    line = int(parts["line"]) if parts["line"] else None
    return posixpath.normpath(parts["file"]), line, parts["what"]


def _folder_uri(path: Path) -> str:
    return path.resolve().as_uri().rstrip("/") + "/"
