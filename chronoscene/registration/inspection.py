"""What is written beside a registered scene: certificate, verdict, and the page for people."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from chronoscene.io.staging import write_text_atomic
from chronoscene.registration.quality.certificate import Certificate, certify
from chronoscene.registration.quality.certificate_json import to_json
from chronoscene.registration.quality.verdict import Verdict, judge
from chronoscene.registration.report.page import write_report
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import TieAlignment, with_tie_tracks
from chronoscene.registration.ties.tie_points import TiePoints

JSON_NAME = "registration.json"
PAGE_NAME = "registration.html"


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """What came of looking at a registration."""

    certificate: Certificate
    verdict: Verdict

    @property
    def summary(self) -> str:
        """For the end of a command: the verdict and what to do, without colours."""
        lines = [f"verdict: {self.verdict.level}. {self.verdict.text}"]
        lines += [f"  to do: {todo}" for todo in self.verdict.todo[:3]]
        return "\n".join(lines) + "\n"


def inspect_registration(
    model: Registered,
    folder: Path,
    *,
    page: bool = False,
    ties: TieAlignment | None = None,
    tie_points: TiePoints | None = None,
    title: str | None = None,
) -> Inspection:
    """Write ``registration.json`` and, if asked for, ``registration.html`` into a folder.

    Args:
        model: The registration, after tie points were heeded.
        folder: Exists.
        page: Whether to write the page.
        ties: What tie points did to it.
        tie_points: The file: its points then count as ties.
        title: Of the page; None for the name of the folder.
    """
    model = model if tie_points is None else with_tie_tracks(model, tie_points)
    certificate = certify(model)
    verdict = judge(certificate)
    data = to_json(certificate, verdict, ties)
    write_text_atomic(folder / JSON_NAME, json.dumps(data, indent=1, allow_nan=False) + "\n")
    if page:
        title = title or f"Registration of {folder.resolve().name}"
        write_report(folder / PAGE_NAME, model, certificate, verdict, ties=ties, title=title)
    return Inspection(certificate, verdict)
