"""Text on a registration from its certificate."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from chronoscene.io.documents import json_error, read_json_document
from chronoscene.registration.output import CERTIFICATE
from chronoscene.registration.report.certificate_json import Figure


def literal(text: object) -> str:
    """Return text that Markdown shows as it is: viser would run scripts in it."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(str(text).split()))


def certificate_summary(folder: Path, shown: Collection[str]) -> str:
    """Return verdicts and held-out errors in Markdown; empty if there is no certificate.

    Args:
        folder: The scene.
        shown: Labels of its periods: `edit` may have left out others of the certificate.

    Raises:
        ChronoSceneError: If it is damaged.
    """
    path = folder / CERTIFICATE
    try:
        return "\n\n".join(_lines(read_json_document(path), shown)) if path.is_file() else ""
    except (KeyError, TypeError, AttributeError) as error:
        found = f"{type(error).__name__} at {error}"
        raise json_error(path, "a certificate of register", found, "register again") from error


def _lines(document: dict[str, Any], shown: Collection[str]) -> Iterator[str]:
    for key, name in (("alignment", "Alignment"), ("absolute_position", "Absolute position")):
        judged = document[key]
        yield f"**{name}: {literal(judged['verdict'])}\\.** {literal(judged['text'])}"
    labels = {period["period"]: period["label"] for period in document["periods"]}
    for pair in document["pairs"]:
        names = [labels[period] for period in pair["periods"]]
        if not set(names) <= set(shown):
            continue
        yield f"**{' and '.join(map(literal, names))}: {literal(pair['verdict'])}**"
        for figure in (Figure(**values) for values in pair["figures"]):
            if figure.name.startswith("held-out reprojection error"):
                yield literal(f"{figure.name}: {figure.text}")
