"""Pass, doubtful or fail: thresholds, each with its reason, and what to do.

A pass promises that the periods lie within 0.1 degrees and 0.2% of the scene's extent of each
other. It needs positive evidence: what could not be measured never counts in favour. A
registration fails only where a measurement contradicts it; everything between is doubtful.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from chronoscene.arrays import Array
from chronoscene.registration.quality.certificate import Certificate, PairFigures, PeriodFigures
from chronoscene.registration.quality.gps_fit import GpsFit
from chronoscene.registration.quality.localisation import Localisation
from chronoscene.registration.quality.misalignment import MIN_TRACKS, Misalignment
from chronoscene.registration.quality.surface_distance import SurfaceDistance

Level = Literal["pass", "doubtful", "fail"]

LEVELS: tuple[Level, ...] = ("pass", "doubtful", "fail")


@dataclass(frozen=True, slots=True)
class Threshold:
    """One check: the limits beyond which a figure is doubtful, and beyond which it fails."""

    key: str
    what: str
    unit: str
    doubtful: float
    fail: float | None
    """None where the figure alone proves no error."""
    larger_is_better: bool
    why: str
    todo: str

    def level(self, value: float) -> Level:
        """Level of a measured figure."""
        sign = -1.0 if self.larger_is_better else 1.0
        if self.fail is not None and sign * value > sign * self.fail:
            return "fail"
        return "doubtful" if sign * value > sign * self.doubtful else "pass"


_CLICK = (
    "click tie points on the spots that the page (--report) suggests, and run again with "
    "--tie-points"
)
_LOOK = f"look at the comparisons on the page (--report); if they jump, {_CLICK}"
_CONTROL = "give ground control: --tie-points with world coordinates"

THRESHOLDS: dict[str, Threshold] = {
    t.key: t
    for t in (
        Threshold(
            "registered", "share of the photos of a period that are registered", "",
            0.6, 0.1, True,
            "measurements say little about a period most of whose photos are missing",
            "registration_log.json says why photos are missing; add photos with viewpoints "
            "between those of the dates",
        ),
        Threshold(
            "images", "registered images of a period", "images", 5, 3, True,
            "fewer images cannot place points by themselves, so nothing can be checked",
            "add photos of this period",
        ),
        Threshold(
            "rotation", "remaining rotation between two periods", "degrees", 0.1, 0.1, False,
            "0.1 degrees is 1.7 pixels at a focal length of 1000: twice the error of matching",
            _CLICK,
        ),
        Threshold(
            "shift", "remaining displacement between two periods", "% of extent", 0.2, 0.2, False,
            "0.2% is 20 cm in 100 m: smaller changes cannot be told from misalignment",
            _CLICK,
        ),
        Threshold(
            "held_out", "held-out tracks between two periods", "tracks", 12, None, True,
            "a similarity has seven unknowns and fits almost any smaller number of tracks",
            _CLICK,
        ),
        Threshold(
            "agreeing", "share of held-out observations that agree", "", 0.75, 0.15, True,
            "correct registrations reach 0.85 and more; with fewer, part of the matches or of the "
            "poses is wrong, or matching is misled by repeated structure",
            "look at the worst pair on the page (--report); remove its photos if they do not fit",
        ),
        Threshold(
            "excess", "held-out residual beyond the noise of matching, as an angle", "degrees",
            0.1, 0.4, False,
            "errors that no similarity explains come from drift that deforms a period (doming), or "
            "from a wrong camera",
            "calibrate each date (--calibration per-period), or add oblique photos; otherwise "
            + _CONTROL,
        ),
        Threshold(
            "occupied", "share of the overlap of two periods that has tie points", "", 0.15, None,
            True,
            "matches in one spot can come from repeated structure, and say little about the rest",
            _CLICK,
        ),
        Threshold(
            "tied", "share of the images of a period that see tie points", "", 0.5, None, True,
            "images without any are held by their own period alone",
            _CLICK,
        ),
        Threshold(
            "localised", "pose error of images localised from the other period, beyond its noise",
            "times 0.1 degrees or 0.2%", 0.6, 10.0, False,
            "the points of each period must place the images of the other correctly",
            _LOOK,
        ),
        Threshold(
            "clouds", "shift between the surfaces of two periods, if its interval excludes 0",
            "% of extent", 0.15, None, False,
            "surfaces are compared without matches, so repeated structure shows here; but a beach "
            "or a quarry may really have moved",
            _LOOK,
        ),
        Threshold(
            "surfaces", "share of the surfaces beyond their level of detection", "",
            0.3, None, False,
            "correct registrations stay below 0.25 even where two thirds of the scene is new; "
            "above, surfaces contradict the matches, as with repeated structure",
            _LOOK,
        ),
        Threshold(
            "gps_offset", "horizontal offset between the GPS of two periods, beyond its spread",
            "m", 5.0, 15.0, False,
            "the bias of a receiver varies by up to about 3.5 m from day to day; heights vary "
            "more, so they are not judged",
            f"if the GPS is reliable, {_CLICK}",
        ),
        Threshold(
            "gps_residual", "residual of a period's cameras to its own GPS, median", "m",
            12.0, None, False,
            "receivers err by 3 to 8 m; more means that part of the poses is wrong, or that the "
            "view of the sky was obstructed",
            "look at the map on the page (--report); register the period alone to see which photos "
            "deform it",
        ),
        Threshold(
            "gps_scale", "scale of a period against its own GPS, beyond its spread", "%",
            2.0, 10.0, False,
            "GPS errs in position, hardly in scale",
            _CONTROL,
        ),
        Threshold(
            "gps_turn", "heading of a period against its own GPS, beyond its spread", "degrees",
            2.0, 10.0, False,
            "GPS errs in position, hardly in direction",
            _CONTROL,
        ),
    )
}  # fmt: skip


FITTED = 1.3
"""Upper limit of the ratio of the noise of an observation to its residual after fitting."""

MIN_TIES = 3  # Tie points, clicked ones for example, that two periods need to be linked

LACKING = ("held_out", "rotation", "shift", "occupied", "tied")
"""Checks that are doubtful for lack of evidence, which a chain of other periods can supply."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A figure beyond its limit, or one that is needed and missing."""

    level: Level
    check: str
    """Key in `THRESHOLDS`, ``link`` or ``chain``."""
    place: str
    """Period or pair of periods, in words."""
    found: str
    why: str
    todo: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement on a certificate."""

    level: Level
    text: str
    """One or two sentences."""
    findings: tuple[Finding, ...]
    """The most severe first."""
    pairs: dict[tuple[int, int], Level | None]
    """Of each pair of periods; None where nothing links the two directly."""

    @property
    def todo(self) -> tuple[str, ...]:
        """What to do, without repetition, the most important first."""
        return tuple(dict.fromkeys(f.todo for f in self.findings))


def judge(certificate: Certificate) -> Verdict:
    """Judge a registration by its certificate."""
    findings = [f for p in certificate.periods for f in _of_period(p)]
    findings += _between_gps(certificate)
    pairs: dict[tuple[int, int], Level | None] = {}
    for pair in certificate.pairs:
        mine = list(_of_pair(certificate, pair))
        measured = isinstance(pair.by_all, Misalignment) or not isinstance(pair.held_out, str)
        linked = measured or pair.ties.points >= MIN_TIES
        pairs[pair.a, pair.b] = _worst(f.level for f in mine) if linked else None
        findings += mine if linked else []
    good = _bounds(certificate, [k for k, level in pairs.items() if level == "pass"])
    if all(good[k] <= 1 or level == "pass" for k, level in pairs.items()):
        findings = [f for f in findings if not _is_lack(f)]
    findings += _links(certificate, pairs, good)
    level = _worst(f.level for f in findings)
    findings.sort(key=lambda f: -LEVELS.index(f.level))
    return Verdict(level, _words(certificate, level, findings), tuple(findings), pairs)


def _is_lack(finding: Finding) -> bool:
    """Whether a finding does not count if chains of good pairs link all periods."""
    return finding.level == "doubtful" and finding.check in LACKING


def _worst(levels: Iterator[Level]) -> Level:
    return max(levels, key=LEVELS.index, default="pass")


def _check(key: str, value: float, place: str, note: str = "") -> Iterator[Finding]:
    """A finding, unless the figure passes."""
    threshold = THRESHOLDS[key]
    level = threshold.level(value)
    if level == "pass":
        return
    limit = threshold.doubtful if level == "doubtful" or threshold.fail is None else threshold.fail
    side = "at least" if threshold.larger_is_better else "at most"
    unit = f" {threshold.unit}" if threshold.unit else ""
    found = f"{threshold.what}: {value:.3g}{unit}, expected {side} {limit:g}{note}"
    yield Finding(level, key, place, found, threshold.why, threshold.todo)


def _of_period(p: PeriodFigures) -> Iterator[Finding]:
    place = f"period {p.label}"
    yield from _check("registered", p.registered / max(p.photos, 1), place)
    yield from _check("images", p.registered, place)
    if isinstance(p.gps, GpsFit):
        gps = p.gps
        yield from _check("gps_residual", gps.median, place)
        if gps.scale is not None and gps.scale_error is not None:
            beyond = abs(gps.scale - 1) - 3 * gps.scale_error
            yield from _check("gps_scale", 100 * beyond, place)
        if gps.turn is not None and gps.turn_error is not None:
            yield from _check("gps_turn", abs(gps.turn) - 3 * gps.turn_error, place)


def _between_gps(certificate: Certificate) -> Iterator[Finding]:
    """Offsets between every two periods: which of them is wrong is not known."""
    fits = [(p, p.gps) for p in certificate.periods if isinstance(p.gps, GpsFit)]
    for i, (p, one) in enumerate(fits):
        for q, other in fits[i + 1 :]:
            gap = (one.offset - other.offset)[:2]
            distance = float(np.linalg.norm(gap))
            spread = np.hypot(one.offset_error[:2], other.offset_error[:2]).max()
            beyond = distance - 3 * float(spread)
            place = f"periods {p.label} and {q.label}"
            yield from _check("gps_offset", beyond, place, f" ({distance:.1f} m in all)")


def _of_pair(certificate: Certificate, pair: PairFigures) -> Iterator[Finding]:
    names = certificate.labels
    place = f"periods {names[pair.a]} and {names[pair.b]}"
    yield from _alignment(certificate, pair, place)
    if not isinstance(pair.held_out, str) and pair.held_out.tracks >= MIN_TRACKS:
        yield from _check("agreeing", pair.held_out.agreeing, place)
        yield from _check("excess", _excess(certificate, pair), place)
    yield from _check("occupied", pair.ties.occupied, place)
    yield from _check("tied", min(pair.ties.tied_a, pair.ties.tied_b), place)
    for found in (pair.localised_b, pair.localised_a):
        if isinstance(found, Localisation) and found.images >= 3:
            yield from _check("localised", _localised(found, certificate.extent), place)
    if isinstance(pair.surfaces, SurfaceDistance):
        shift = pair.surfaces.shift
        if shift.low > 0:
            yield from _check("clouds", 100 * shift.value / certificate.extent, place)
        yield from _check("surfaces", pair.surfaces.beyond, place)


def _localised(found: Localisation, extent: float) -> float:
    """The larger of both errors against its limit; it fails only as far as it is certain."""
    turn, place = found.rotation_excess, found.centre_excess
    likely, certain = (
        max(r / _limit("rotation"), 100 * c / extent / _limit("shift"))
        for r, c in ((turn.value, place.value), (turn.low, place.low))
    )
    bad = THRESHOLDS["localised"].fail
    assert bad is not None
    return certain if certain > bad else min(likely, bad)


def _alignment(certificate: Certificate, pair: PairFigures, place: str) -> Iterator[Finding]:
    """Whether the periods are aligned, and whether that is certain.

    They are not if either interval lies beyond the limit. They are if the interval of the precise
    measurement (all ties) ends below the limit, and the independent one (held-out tracks) agrees:
    its interval ends below the limit, or its estimate lies below and its interval ends below twice
    the limit.
    """
    held, by_all = pair.misalignment, pair.by_all
    if isinstance(held, str) or isinstance(by_all, str):
        tracks = 0 if isinstance(pair.held_out, str) else pair.held_out.tracks
        reason = held if isinstance(held, str) else str(by_all)
        yield from _check("held_out", min(tracks, 11), place, f" ({reason})")
        if isinstance(by_all, str):
            return
        held = by_all
    for key, factor in (("rotation", 1.0), ("shift", 100.0 / certificate.extent)):
        limit = _limit(key)
        one, every = getattr(held, key), getattr(by_all, key)
        low = max(one.low, every.low) * factor
        high, loose, estimate = every.high * factor, one.high * factor, one.value * factor
        if low > limit:
            yield from _check(key, max(one.value, every.value) * factor, place)
        elif high > limit or (loose > limit and (estimate > limit or loose > 2 * limit)):
            unit = THRESHOLDS[key].unit
            bound = max(high, loose)
            found = (
                f"{THRESHOLDS[key].what}: {estimate:.3g} {unit}, but up to {bound:.3g} cannot be "
                f"ruled out; expected at most {limit:g}"
            )
            yield Finding("doubtful", key, place, found, THRESHOLDS[key].why, THRESHOLDS[key].todo)


def _limit(key: str) -> float:
    return THRESHOLDS[key].doubtful


def _excess(certificate: Certificate, pair: PairFigures) -> float:
    """Held-out residual beyond the noise of matching, in degrees.

    The residuals of the model show that noise, slightly underestimated because points were fitted
    to them (`FITTED`).
    """
    assert not isinstance(pair.held_out, str)
    own = [certificate.periods[p].error or 0.0 for p in (pair.a, pair.b)]
    beyond = np.sqrt(max(0.0, pair.held_out.noise**2 - (FITTED * max(own)) ** 2))
    return float(np.degrees(np.arctan2(beyond, certificate.focal)))


def _links(
    certificate: Certificate, pairs: dict[tuple[int, int], Level | None], good: Array
) -> Iterator[Finding]:
    """Pairs without a link of their own that no good chain of other periods links.

    Args:
        certificate: What was measured.
        pairs: Level of each pair; None where nothing links the two directly.
        good: From `_bounds`, along pairs that passed.
    """
    names = certificate.labels
    some = _bounds(certificate, [k for k, level in pairs.items() if level is not None])
    for (a, b), level in pairs.items():
        place = f"periods {names[a]} and {names[b]}"
        if not np.isfinite(some[a, b]):
            yield Finding(
                "fail", "link", place, "no measurement links them",
                "without matches between them, their alignment is unknown", _CLICK,
            )  # fmt: skip
        elif level is None and not good[a, b] <= 1:
            left = (
                f"a chain of good pairs links them, but only to within {good[a, b]:.2g} times the "
                "limits"
                if np.isfinite(good[a, b])
                else "no chain of good pairs links them"
            )
            yield Finding("doubtful", "chain", place, left, "the errors of a chain add up", _CLICK)


def _bounds(certificate: Certificate, pairs: list[tuple[int, int]]) -> Array:
    """How far apart two periods can be, in units of the limits, by chains of pairs. [T, T]

    Errors of the links of a chain are independent: their squares add up.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import shortest_path

    weights = np.zeros((len(certificate.labels),) * 2)
    for pair in certificate.pairs:
        if (pair.a, pair.b) in pairs:
            weights[pair.a, pair.b] = 1e6
            if isinstance(pair.by_all, Misalignment):
                shift = 100 * pair.by_all.shift.high / certificate.extent / _limit("shift")
                worst = max(pair.by_all.rotation.high / _limit("rotation"), shift, 1e-3)
                weights[pair.a, pair.b] = worst**2
    return np.asarray(np.sqrt(shortest_path(csr_array(weights), directed=False)))


def _words(certificate: Certificate, level: Level, findings: list[Finding]) -> str:
    count = len(certificate.labels)
    if level == "pass" and count == 1:
        return "There is only one period, so there is no alignment to judge."
    if level == "pass":
        return (
            f"The {count} periods lie in one frame, within 0.1 degrees and 0.2% of the scene's "
            "extent of each other, according to matches that took no part in the estimation."
        )
    first = findings[0]
    start = (
        "The periods do not fit each other; do not use this registration as it is."
        if level == "fail"
        else "The registration may be correct, but the measurements do not prove it."
    )
    place = first.place[0].upper() + first.place[1:]  # labels stay as they are
    return f"{start} {place}: {first.found}."
