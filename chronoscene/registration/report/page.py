"""``registration.html``: the certificate, comparisons and maps on one page.

Styles and pictures are embedded; it loads nothing. Names are escaped by the template engine.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from chronoscene import __version__
from chronoscene.arrays import Array
from chronoscene.io.pages import render_page
from chronoscene.registration.quality.certificate import Certificate, PairFigures
from chronoscene.registration.quality.position import POSITION_THRESHOLDS, Position
from chronoscene.registration.quality.thresholds import THRESHOLDS, Level
from chronoscene.registration.quality.verdict import Verdict
from chronoscene.registration.report.certificate_json import pair_figures, period_figures
from chronoscene.registration.report.pictures import PHOTO_WIDTH, Photos, camera_map
from chronoscene.registration.report.spots import DrawnPair, Spot, drawn_pairs, spots
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import TieAlignment

FLICKERS = 8  # Comparisons on the page, for all pairs of periods together
CLICKS = 6  # Spots suggested for clicking, for each pair of periods
MAX_LINES = 120  # Matches that are drawn between two photos

LEVEL_WORDS = {
    "pass": "Pass",
    "doubtful": "Doubtful",
    "fail": "Fail",
    "not checked": "Not checked",
    None: "Not linked",
}

COLORS = (
    "#2f7ed8", "#d9622b", "#2a9d5c", "#a44bd1", "#b8860b", "#0f9aa7", "#d1477f", "#6b7280",
)  # fmt: skip
"""Colours of the periods, in turn; each is legible on white and on near-black."""


def render_report(
    model: Registered,
    certificate: Certificate,
    verdict: Verdict,
    position: Position,
    *,
    ties: TieAlignment | None = None,
    title: str = "Registration",
) -> str:
    """Render the page.

    Args:
        model: The registration; its photos are read from ``images_root`` where they exist.
        certificate: Of this model.
        verdict: On this certificate.
        position: On the absolute position.
        ties: Result of clicked tie points, if there were any.
        title: Of the page.
    """
    photos = Photos(model)
    return render_page(
        "registration/page",
        title=title,
        version=__version__,
        certificate=certificate,
        verdict=verdict,
        position=position,
        levels=LEVEL_WORDS,
        colors=[COLORS[i % len(COLORS)] for i in range(len(certificate.labels))],
        map=camera_map(model) if model.names else None,
        periods=[(p, list(period_figures(p))) for p in certificate.periods],
        pairs=[
            (_names(certificate, p), verdict.pairs.get((p.a, p.b)), pair_figures(certificate, p))
            for p in certificate.pairs
        ],
        drawn=_drawn(model, certificate, photos),
        photo_width=PHOTO_WIDTH,
        flickers=_flickers(model, certificate, photos),
        clicks=_clicks(model, certificate, verdict, photos),
        ties=ties,
        thresholds=[*THRESHOLDS.values(), *POSITION_THRESHOLDS.values()],
        unregistered=sorted(model.unregistered.items()),
    )


def _names(certificate: Certificate, pair: PairFigures) -> str:
    return f"{certificate.labels[pair.a]} and {certificate.labels[pair.b]}"


def _drawn(model: Registered, certificate: Certificate, photos: Photos) -> list[dict[str, Any]]:
    """The pairs of images with the largest and the smallest held-out error."""
    found = drawn_pairs(model, certificate.evidence)
    chosen = [("Worst pair", found[-1])] if found else []
    if len(found) > 1:
        chosen.append(("Best pair", found[0]))
    drawn = (_draw_pair(model, photos, title, pair) for title, pair in chosen)
    return [d for d in drawn if d is not None]


def _draw_pair(
    model: Registered, photos: Photos, title: str, pair: DrawnPair
) -> dict[str, Any] | None:
    first, second = photos.reduced(pair.a), photos.reduced(pair.b)
    if first is None or second is None:
        return None
    scales = [PHOTO_WIDTH / model.cameras[i].width for i in (pair.a, pair.b)]
    heights = [model.cameras[i].height * s for i, s in zip((pair.a, pair.b), scales, strict=True)]
    step = len(pair.error) // MAX_LINES + 1
    lines = [
        (*_scaled(a, scales[0]), *_scaled(b, scales[1]), _level(e))
        for a, b, e in zip(pair.xy_a[::step], pair.xy_b[::step], pair.error[::step], strict=True)
    ]
    return {
        "title": title,
        "names": (model.names[pair.a], model.names[pair.b]),
        "pictures": (first, second),
        "heights": heights,
        "lines": lines,
        "matches": len(pair.error),
        "median": pair.median,
    }


def _scaled(xy: Array, scale: float) -> tuple[float, float]:
    return round(float(xy[0]) * scale, 1), round(float(xy[1]) * scale, 1)


def _level(error: float) -> Level:
    return "pass" if error < 2 else "doubtful" if error < 5 else "fail"


def _flickers(model: Registered, certificate: Certificate, photos: Photos) -> list[dict[str, Any]]:
    """Comparisons of each pair of periods, at tie points and where there are none."""
    each = max(2, FLICKERS // max(len(certificate.pairs), 1))
    found: list[dict[str, Any]] = []
    seen = certificate.evidence.seen
    for pair in certificate.pairs:
        gaps = spots(model, seen, pair, each // 2, gaps=True)
        chosen = spots(model, seen, pair, each - len(gaps), gaps=False) + gaps
        for spot in chosen:
            pictures = photos.patches(spot)
            if pictures is not None and len(found) < FLICKERS:
                names = model.names[spot.a], model.names[spot.b]
                labels = certificate.labels[pair.a], certificate.labels[pair.b]
                found.append(
                    {"names": names, "labels": labels, "pictures": pictures, "tied": spot.tied}
                )
    return found


def _clicks(
    model: Registered, certificate: Certificate, verdict: Verdict, photos: Photos
) -> list[tuple[str, list[tuple[str, list[tuple[str, str, float, float]]]]]]:
    """Suggest points to click, each with its own name, for pairs that did not pass."""
    found = []
    numbers = itertools.count(1)
    seen = certificate.evidence.seen
    for pair in certificate.pairs:
        if verdict.pairs.get((pair.a, pair.b)) == "pass":
            continue
        listed = spots(model, seen, pair, 3 * CLICKS, gaps=True, twice=True)
        chosen = [s for s in listed if photos.is_textured(s)][:CLICKS]
        if len(chosen) < CLICKS:
            listed = spots(model, seen, pair, 3 * CLICKS, gaps=False, twice=True)
            chosen += [s for s in listed if photos.is_textured(s)][: CLICKS - len(chosen)]
        if chosen:
            clicks = [(f"p{next(numbers)}", _click(model, certificate, pair, s)) for s in chosen]
            found.append((_names(certificate, pair), clicks))
    return found


def _click(
    model: Registered, certificate: Certificate, pair: PairFigures, spot: Spot
) -> list[tuple[str, str, float, float]]:
    """Images and pixels in which one spot should be clicked: label of the period, image, x, y."""
    views: Sequence[tuple[int, tuple[int, Array] | None]] = (
        (pair.a, (spot.a, spot.xy_a)),
        (pair.a, spot.more_a),
        (pair.b, (spot.b, spot.xy_b)),
        (pair.b, spot.more_b),
    )
    return [
        (certificate.labels[p], model.names[v[0]], float(v[1][0]), float(v[1][1]))
        for p, v in views
        if v is not None
    ]
