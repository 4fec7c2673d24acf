"""Reports for programs, in JSON.

Keys are only added; `SCHEMA_VERSION` changes if one changes its meaning.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from chronoscene import __version__
from chronoscene.validation.rule import SceneReport, counts, is_valid

SCHEMA_VERSION = 1


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
