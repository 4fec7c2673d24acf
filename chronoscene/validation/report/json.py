"""Reports for programs: JSON, and SARIF, which code hosts and editors show beside the files.

Keys of the JSON report are only added; `SCHEMA_VERSION` changes if one changes its meaning.
"""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any
from urllib.parse import quote

from chronoscene import __version__
from chronoscene.formats.chronoscene import SPLIT
from chronoscene.validation.rule import (
    GROUPS,
    Finding,
    Rule,
    SceneReport,
    Severity,
    counts,
    is_valid,
)
from chronoscene.validation.rules import all_rules
from chronoscene.validation.run import RULE_FAILED

SCHEMA_VERSION = 1

SARIF_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"

LEVELS: dict[Severity, str] = {"error": "error", "warning": "warning", "info": "note"}


def write_json(reports: Sequence[SceneReport], *, strict: bool = False) -> str:
    """All findings of some scenes as JSON text."""
    document = {
        "schema_version": SCHEMA_VERSION,
        "chronoscene_version": __version__,
        "valid": is_valid(reports, strict=strict),
        "strict": strict,
        "counts": counts(reports),
        "scenes": [_scene(report) for report in reports],
    }
    return json.dumps(document, indent=1) + "\n"


def _scene(report: SceneReport) -> dict[str, Any]:
    return {
        "name": report.name,
        "path": str(report.path).encode("utf-8", "backslashreplace").decode(),
        "counts": counts([report]),
        "summary": asdict(report.summary),
        "findings": [asdict(finding) for finding in report.findings],
        "skipped": [asdict(skipped) for skipped in report.skipped],
    }


def write_sarif(reports: Sequence[SceneReport], *, strict: bool = False) -> str:
    """All findings of some scenes as SARIF 2.1.0: one run per scene.

    With ``strict``, warnings have the level of errors.

    Source: OASIS, Static Analysis Results Interchange Format version 2.1.0, section 3.
    """
    rules = all_rules()
    document = {
        "$schema": SARIF_SCHEMA,
        "version": "2.1.0",
        "runs": [_sarif_run(report, rules, strict) for report in reports],
    }
    return json.dumps(document, indent=1) + "\n"


def _sarif_run(report: SceneReport, rules: Sequence[Rule], strict: bool) -> dict[str, Any]:
    index = {rule.code: i for i, rule in enumerate(rules)}
    driver = {
        "name": "chronoscene validate",
        "version": __version__,
        "semanticVersion": __version__,
        "rules": [_sarif_rule(rule) for rule in rules],
    }
    failed = [str(f) for f in report.findings if f.code == RULE_FAILED]
    notes = [{"level": "error", "message": {"text": text}} for text in failed]
    return {
        "tool": {"driver": driver},
        "automationDetails": {"id": f"chronoscene/{report.name}/"},
        "originalUriBaseIds": {"SCENE": {"uri": report.path.resolve().as_uri().rstrip("/") + "/"}},
        "invocations": [{"executionSuccessful": not failed, "toolExecutionNotifications": notes}],
        "results": [_sarif_result(f, index, strict) for f in report.findings if f.code in index],
    }


def _sarif_rule(rule: Rule) -> dict[str, Any]:
    return {
        "id": rule.code,
        "name": rule.name,
        "shortDescription": {"text": rule.what},
        "fullDescription": {"text": f"{rule.what} For example: {rule.bad}."},
        "help": {"text": f"What to do: {rule.remedy}."},
        "defaultConfiguration": {"level": LEVELS[rule.severity]},
        "properties": {"tags": [GROUPS[rule.code[:3]]]},
    }


def _sarif_result(finding: Finding, index: dict[str, int], strict: bool) -> dict[str, Any]:
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
    """File, and line and record if the place names them.

    Always with a file: GitHub rejects reports with a location that has none.
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

    A period is in the file that lists its images.
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
