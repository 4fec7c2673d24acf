"""A certificate as ``registration.json``, and as rows of a table.

Every figure stands with its unit and with what it was taken over; one that could not be computed is
``null``, with the reason beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from chronoscene import __version__
from chronoscene.registration.quality.certificate import (
    Certificate,
    HeldOut,
    PairFigures,
    PeriodFigures,
)
from chronoscene.registration.quality.gps_fit import PeriodGpsFit
from chronoscene.registration.quality.localisation import Localisation
from chronoscene.registration.quality.misalignment import Interval, Misalignment, rotation_angle
from chronoscene.registration.quality.position import POSITION_THRESHOLDS, Position, Rmse
from chronoscene.registration.quality.surface_distance import SurfaceDistance
from chronoscene.registration.quality.thresholds import THRESHOLDS
from chronoscene.registration.quality.verdict import Verdict
from chronoscene.registration.ties.tie_alignment import TieAlignment

FORMAT = "chronoscene-registration-2"


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of a certificate."""

    name: str
    value: float | None
    unit: str
    over: str
    """Kind of the items that it is computed from, with their number where it is known."""
    absent: str | None = field(default=None, kw_only=True)
    """Reason why there is no value."""
    interval: tuple[float, float] | None = field(default=None, kw_only=True)
    """95%."""

    @property
    def text(self) -> str:
        """Value with unit and interval, for people."""
        if self.value is None:
            return f"absent: {self.absent}"
        digits = 3 if self.unit else 6  # A scale is 1 but for parts in a thousand
        number = f"{self.value:,.0f}" if abs(self.value) >= 1000 else f"{self.value:.{digits}g}"
        unit = f" {self.unit}" if self.unit else ""
        if self.interval is None:
            return number + unit
        low, high = (f"{end:.{digits - 1}g}" for end in self.interval)
        return f"{number}{unit} ({low} to {high})"


def period_figures(period: PeriodFigures) -> Iterator[Figure]:
    """Figures of one period."""
    photos = f"{period.photos} photos"
    yield Figure("registered images", period.registered, "", photos)
    if period.error is None:
        yield Figure("reprojection error", None, "px", "", absent="no observations")
    else:
        over = f"{period.observations:,} observations"
        yield Figure("reprojection error, median", period.error, "px", over)
    if period.in_three is not None:
        share, over = 100 * period.in_three, "points that its images see"
        yield Figure("points that three images or more see", share, "%", over)
    yield Figure("images in parts that most matches contradict", len(period.loose), "", photos)
    yield Figure("images in parts that GPS places elsewhere", len(period.elsewhere), "", photos)
    gps = period.gps
    if not isinstance(gps, PeriodGpsFit):
        yield Figure("GPS residual", None, "m", "", absent=gps)
        return
    over = f"{gps.positions} positions"
    yield Figure("GPS residual after a similarity, median", gps.median, "m", over)
    name = "GPS residual after a similarity, largest median of neighbouring cameras"
    yield Figure(name, gps.local, "m", over)
    yield Figure("GPS residual after a similarity, largest", gps.largest, "m", over)
    yield Figure("GPS outliers", gps.outliers, "", over)
    offset, error = np.linalg.norm(gps.offset[:2]), np.linalg.norm(gps.offset_error[:2])
    both = (max(0.0, float(offset - 2 * error)), float(offset + 2 * error))
    yield Figure("GPS against cameras, horizontal", float(offset), "m", over, interval=both)
    yield Figure("GPS against cameras, vertical", float(gps.offset[2]), "m", over)
    short = "the path is too short for the noise of the GPS"
    for name, unit, value, spread in (
        ("scale against own GPS", "", gps.scale, gps.scale_error),
        ("turn against own GPS", "degrees", gps.turn, gps.turn_error),
    ):
        if value is None or spread is None:
            yield Figure(name, None, unit, over, absent=short)
        else:
            span = (value - 1.96 * spread, value + 1.96 * spread)
            yield Figure(name, value, unit, over, interval=span)


def pair_figures(certificate: Certificate, pair: PairFigures) -> Iterator[Figure]:
    """Figures of two periods."""
    names = certificate.labels[pair.a], certificate.labels[pair.b]
    unit = "m" if certificate.unit == "metre" else "units"
    ties = pair.ties
    yield Figure("tie points of the model", ties.points, "", "points seen in both periods")
    yield Figure("overlap with tie points", 100 * ties.occupied, "%", f"{ties.cells} cells")
    yield Figure("hull of the tie points, of the overlap", 100 * ties.hull, "%", "ground plan")
    yield Figure(f"images of {names[0]} that see ties", 100 * ties.tied_a, "%", "its images")
    yield Figure(f"images of {names[1]} that see ties", 100 * ties.tied_b, "%", "its images")
    if pair.focal_gap is not None:
        yield Figure("difference of the focal lengths", pair.focal_gap, "%", "photos of one size")
    yield from _held_out_figures(pair.held_out, unit)
    for name, found in (
        ("by held-out tracks", pair.misalignment),
        ("by held-out tracks and ties", pair.by_all),
    ):
        yield from _misalignment_figures(certificate, name, found, unit)
    combined = "agreeing tracks, core points"
    for name, both, over in (
        ("by surfaces", pair.by_surfaces, "core points"),
        ("by held-out tracks and surfaces", pair.independent, combined),
        ("by held-out tracks, ties and surfaces", pair.by_ties_and_surfaces, combined),
    ):
        if both is not None:
            yield _interval(f"rotation {name}", both[0], "degrees", over)
            yield _interval(f"displacement {name}", both[1], unit, over)
    for name, other, local in (
        (names[1], names[0], pair.localised_b),
        (names[0], names[1], pair.localised_a),
    ):
        what = f"images of {name} localised from {other}"
        if not isinstance(local, Localisation):
            yield Figure(what, None, "", "", absent=local)
            continue
        over = f"{local.images} of {local.tried} images"
        yield Figure(f"{what}: rotation, median", local.rotation, "degrees", over)
        yield Figure(f"{what}: centre, median", local.centre, unit, over)
    yield from _surface_figures(pair.surfaces, unit)


def _held_out_figures(held: HeldOut | str, unit: str) -> Iterator[Figure]:
    if not isinstance(held, HeldOut):
        yield Figure("held-out reprojection error", None, "px", "", absent=held)
        return
    over = f"{held.observations:,} observations of {held.tracks:,} tracks"
    yield Figure("held-out reprojection error, median", held.median, "px", over)
    yield Figure("held-out reprojection error, 90%", held.p90, "px", over)
    yield Figure("held-out reprojection error, median", held.distance, unit, over)
    yield Figure("held-out observations that agree", 100 * held.agreeing, "%", over)
    others = 100 * (1 - held.agreeing)
    for name, share in (
        ("held-out observations that disagree in one direction", held.disagreement.step),
        ("held-out observations that disagree and gather in images", held.disagreement.images),
    ):
        yield Figure(name, others * share, "%", over)
    tracks = f"{held.gap_tracks:,} tracks"
    missing = None if held.gap is not None else "no track is placed by both periods"
    yield Figure("gap between both periods' points", held.gap, unit, tracks, absent=missing)
    matches = f"{held.matches:,} matches"
    missing = None if held.epipolar is not None else "no matches of images of both periods"
    yield Figure("held-out epipolar error, median", held.epipolar, "px", matches, absent=missing)


def _misalignment_figures(
    certificate: Certificate, name: str, found: Misalignment | str, unit: str
) -> Iterator[Figure]:
    if not isinstance(found, Misalignment):
        yield Figure(f"misalignment {name}", None, "", "", absent=found)
        return
    over = f"{found.tracks:,} agreeing tracks"
    percent = 100 / certificate.extent
    yield _interval(f"rotation {name}", found.rotation, "degrees", over)
    yield _interval(f"displacement {name}", found.shift, unit, over)
    yield _interval(f"displacement {name}", found.shift, "% of extent", over, factor=percent)
    yield Figure(f"scale ratio {name}", found.similarity.scale, "", over)


def _surface_figures(surfaces: SurfaceDistance | str, unit: str) -> Iterator[Figure]:
    if not isinstance(surfaces, SurfaceDistance):
        yield Figure("distance between surfaces", None, unit, "", absent=surfaces)
        return
    over = f"{surfaces.stable:,} of {surfaces.cores:,} core points on stable structure"
    yield Figure("point-to-plane distance, median", surfaces.median, unit, over)
    yield Figure("level of detection, median", surfaces.level, unit, over)
    yield Figure("beyond the level of detection", 100 * surfaces.beyond, "%", over)
    yield _interval("shift between the surfaces", surfaces.shift, unit, over)


def _interval(name: str, size: Interval, unit: str, over: str, *, factor: float = 1.0) -> Figure:
    span = (size.low * factor, size.high * factor)
    return Figure(name, size.value * factor, unit, over, interval=span)


def to_json(
    certificate: Certificate, verdict: Verdict, position: Position, ties: TieAlignment | None = None
) -> dict[str, Any]:
    """Content of ``registration.json``: plain data, finite numbers or null."""
    return _plain(
        {
            "format": FORMAT,
            "chronoscene": __version__,
            "alignment": _judgement(verdict),
            "absolute_position": _judgement(position)
            | {
                "check_points": _rmse(position.check),
                "control_points": _rmse(position.control),
                "control_points_left_out": _rmse(position.left_out),
                "cameras_against_gps": _rmse(position.gps),
                "ground_pixel": position.ground_pixel,
                "scale_error": position.scale_error,
                "metadata": [asdict(c) for c in position.metadata],
            },
            "route": certificate.route,
            "features": certificate.features,
            "unit": certificate.unit,
            "extent": certificate.extent,
            "focal_px": certificate.focal,
            "periods": [
                {
                    "period": p.period,
                    "label": p.label,
                    "registered": p.registered,
                    "photos": p.photos,
                    "reasons": dict(p.reasons),
                    "figures": [asdict(f) for f in period_figures(p)],
                }
                for p in certificate.periods
            ],
            "pairs": [
                {
                    "periods": [p.a, p.b],
                    "verdict": verdict.pairs.get((p.a, p.b)),
                    "figures": [asdict(f) for f in pair_figures(certificate, p)],
                    "similarity": _similarity(p),
                }
                for p in certificate.pairs
            ],
            "tie_points": None
            if ties is None
            else {
                "replaced": ties.replaced,
                "controlled": ties.controlled,
                "outliers": ties.outliers,
                "remarks": ties.remarks,
                "points": [asdict(r) for r in ties.residuals],
            },
            "resection": None if certificate.resection is None else asdict(certificate.resection),
            "thresholds": [{"key": key} | asdict(t) for key, t in THRESHOLDS.items()],
            "position_thresholds": [
                {"key": key} | asdict(t) for key, t in POSITION_THRESHOLDS.items()
            ],
        }
    )


def _judgement(found: Verdict | Position) -> dict[str, Any]:
    return {
        "verdict": found.level,
        "text": found.text,
        "todo": found.todo,
        "findings": [asdict(f) for f in found.objections],
    }


def _rmse(found: Rmse | None) -> dict[str, Any] | None:
    return None if found is None else asdict(found)


def _similarity(pair: PairFigures) -> dict[str, Any] | None:
    """Similarity that would align the first period with the second."""
    found = pair.by_all if isinstance(pair.by_all, Misalignment) else pair.misalignment
    if not isinstance(found, Misalignment):
        return None
    return {
        "scale": found.similarity.scale,
        "rotation_degrees": float(rotation_angle(found.similarity.rotation)),
        "matrix": found.similarity.to_matrix().tolist(),
    }


def _plain(value: Any) -> Any:
    """Convert numpy values and tuples, and numbers that JSON lacks to null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
