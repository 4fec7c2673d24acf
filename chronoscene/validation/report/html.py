"""Report as a self-contained HTML page with styles and small pictures.

Everything from a scene is escaped by the template engine. The first images that findings name are
shown, and only files that really are below ``images/``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby, islice
from pathlib import Path
from typing import Any

from PIL import Image

from chronoscene import __version__
from chronoscene.io.pages import data_uri, render_page
from chronoscene.validation import rule
from chronoscene.validation.folder.names import is_safe
from chronoscene.validation.rule import SEVERITIES, Finding, SceneReport, Severity, is_valid

MAX_PICTURES = 24  # Pictures of one scene
MAX_SIDE_BY_SIDE = 3  # Pictures of one finding
PICTURE_SIDE = 160  # Pixels
MAX_FILE_BYTES = 50_000_000  # Larger image files are not opened for a picture
MAX_ROWS = 100  # Findings of one rule that are listed

TITLES: dict[Severity, str] = {"error": "Errors", "warning": "Warnings", "info": "Remarks"}


def write_html(reports: Sequence[SceneReport], *, strict: bool = False) -> str:
    """All findings of some scenes as an HTML page."""
    return render_page(
        "validation/page",
        scenes=[(report, _sections(report), _skipped(report)) for report in reports],
        total=rule.counts(reports),
        valid=is_valid(reports, strict=strict),
        is_valid=lambda report: is_valid([report], strict=strict),
        severities=SEVERITIES,
        titles=TITLES,
        version=__version__,
    )


def _sections(report: SceneReport) -> list[tuple[Severity, list[dict[str, Any]]]]:
    """Findings by rule and severity, without severities that have no findings."""
    pictures = Pictures(report.path)
    sections = []
    for severity in SEVERITIES:
        mine = [f for f in report.findings if f.severity == severity]
        blocks = [_block(list(group), pictures) for _, group in groupby(mine, lambda f: f.code)]
        if blocks:
            sections.append((severity, blocks))
    return sections


def _block(findings: list[Finding], pictures: Pictures) -> dict[str, Any]:
    """All findings of one rule in one scene."""
    first = findings[0]
    return {
        "first": first,
        "what": rule.explain(first),
        "rows": [(f, pictures.of(f.place, f.also)) for f in findings[:MAX_ROWS]],
        "total": len(findings),
        "remedies": list(dict.fromkeys(f.remedy for f in findings if f.remedy != rule.NOTHING)),
    }


def _skipped(report: SceneReport) -> list[tuple[str, str]]:
    """Reasons, and the rules that were skipped for them."""
    reasons = dict.fromkeys(s.reason for s in report.skipped)
    return [(r, ", ".join(s.code for s in report.skipped if s.reason == r)) for r in reasons]


class Pictures:
    """Small pictures of the first few images that are requested."""

    def __init__(self, root: Path) -> None:
        self._images = root / "images"
        self._left = MAX_PICTURES

    def of(self, place: str, also: Sequence[str] = ()) -> tuple[str, ...]:
        """Data URIs of the image that a place names and of other images, if they can be read."""
        found: list[str] = []
        for name in islice((*_names(place), *also), MAX_SIDE_BY_SIDE):
            if self._left > 0 and (picture := self._draw(name)) is not None:
                self._left -= 1
                found.append(picture)
        return tuple(found)

    def _draw(self, name: str) -> str | None:
        try:
            path = (self._images / name).resolve()
            inside = is_safe(name) and path.is_relative_to(self._images.resolve())
            if not inside or not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
                return None
            with Image.open(path) as image:
                image.draft("RGB", (2 * PICTURE_SIDE, 2 * PICTURE_SIDE))
                image.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
                return data_uri(image, quality=70)
        except Exception:  # damaged files make Pillow raise almost anything
            return None


def _names(place: str) -> Iterator[str]:
    """The part of a place that may be the name of an image."""
    if place.startswith("images/"):
        yield place.removeprefix("images/")
    elif place.endswith(")") and " (" in place:
        yield place[place.index(" (") + 2 : -1]
