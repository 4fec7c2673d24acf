"""Pass, doubtful or fail: what the thresholds say of a certificate.

A pass promises that the periods lie within 0.1 degrees and 0.2% of the scene's extent of each
other. It needs positive evidence: what could not be measured never counts in favour. A
registration fails only where a measurement contradicts it; everything between is doubtful.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array
from chronoscene.registration.quality.certificate import Certificate, PairFigures, PeriodFigures
from chronoscene.registration.quality.gps_fit import PeriodGpsFit
from chronoscene.registration.quality.localisation import Localisation
from chronoscene.registration.quality.misalignment import MIN_TRACKS, Interval, Misalignment
from chronoscene.registration.quality.surface_distance import SurfaceDistance
from chronoscene.registration.quality.thresholds import (
    AFTER_INTO,
    CLICK,
    LEVELS,
    LOOK,
    PLACE,
    THRESHOLDS,
    Level,
    Objection,
    check,
    worst_level,
)
from chronoscene.registration.result import ANOTHER_PLACE

FITTED = 1.3
"""Upper limit of the ratio of the noise of an observation to its residual after fitting."""

FEW_TRACKS = 4  # Held-out tracks whose agreement counts where they are too few to measure
FEW_AGREEING = 0.5  # Share of their observations that agrees
FACING = 0.8
"""Share of the error of localised images that counts in forward-facing captures: turns and shifts
of a camera make up for each other there."""
VAGUE = 1.0
"""Noise of a localised image, in units of the limits, beyond which its error counts only where the
images agree on it."""
SURELY = 1.5
"""Limits within which the interval of the surfaces must end, with its middle below them, to confirm
what the ties determine more precisely."""
ROOM, MARGIN = 0.95, 0.8
"""Shares of the limits within which an interval must end: one in forty ends below the truth, most
of them by little. The second is that of forward-facing captures, and of intervals that only
surfaces narrow so far, as neighbouring patches of real surfaces can err together."""

MIN_TIES = 3  # Tie points, clicked ones for example, that two periods need to be linked

LACKING = ("held_out", "rotation", "shift", "occupied", "tied")
"""Checks that are doubtful for lack of evidence, which a chain of other periods can supply."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement on a certificate."""

    level: Level
    text: str
    """One or two sentences."""
    objections: tuple[Objection, ...]
    """The most severe first."""
    pairs: dict[tuple[int, int], Level | None]
    """Level of each pair of periods; None where nothing links the two directly."""

    @property
    def todo(self) -> tuple[str, ...]:
        """Things to do, without repetition, the most important first."""
        found = tuple(dict.fromkeys(f.todo for f in self.objections))
        return tuple(one for one in found if not any(one in more != one for more in found))


def judge(certificate: Certificate) -> Verdict:
    """Judge a registration by its certificate."""
    if certificate.route == "resection":
        return _judge_resection(certificate)
    objections = [f for p in certificate.periods for f in _of_period(p)]
    objections += _between_gps(certificate)
    pairs: dict[tuple[int, int], Level | None] = {}
    for pair in certificate.pairs:
        mine = list(_of_pair(certificate, pair))
        measured = isinstance(pair.by_all, Misalignment) or not isinstance(pair.held_out, str)
        linked = measured or pair.ties.points >= MIN_TIES
        pairs[pair.a, pair.b] = worst_level(f.level for f in mine) if linked else None
        objections += mine if linked else []
    good = _bounds(certificate, [k for k, level in pairs.items() if level == "pass"])
    for pair in certificate.pairs:  # what surfaces measure is no longer a question of the chain
        if np.isfinite(good[pair.a, pair.b]) and _surfaces_fit(certificate, pair):
            good[pair.a, pair.b] = min(good[pair.a, pair.b], 1.0)
    if all(good[k] <= 1 or level == "pass" for k, level in pairs.items()):
        # Chains of good pairs that link all periods supply what single pairs lack.
        objections = [o for o in objections if o.level == "fail" or o.check not in LACKING]
    objections += _links(certificate, pairs, good)
    level = worst_level(f.level for f in objections)
    if level != "pass":  # the cause of other findings, before them
        objections = [f for p in certificate.periods for f in _thin(p)] + objections
    objections.sort(key=lambda f: -LEVELS.index(f.level))
    if certificate.route == "frozen":
        objections = [replace(f, todo=AFTER_INTO.get(f.todo, f.todo)) for f in objections]
    return Verdict(level, _words(certificate, level, objections), tuple(objections), pairs)


def _judge_resection(certificate: Certificate) -> Verdict:
    """Judge photos that surveyed points placed: too few for the measurements between periods."""
    objections = [f for p in certificate.periods for f in _of_period(p) if f.check != "images"]
    if len(certificate.labels) > 1:
        objections.append(
            Objection(
                "doubtful",
                "control",
                "the periods",
                "each is placed by the control points alone",
                "no match that took no part in it measures them against each other; how well the "
                "poses are known is said under absolute position",
                "add photos that overlap, for an independent measurement",
            )
        )
    level = worst_level(f.level for f in objections)
    pairs: dict[tuple[int, int], Level | None] = {(p.a, p.b): None for p in certificate.pairs}
    return Verdict(level, _words(certificate, level, objections), tuple(objections), pairs)


def _check(key: str, value: float, place: str, note: str = "") -> Iterator[Objection]:
    yield from check(THRESHOLDS[key], value, place, key, note)


def _of_period(p: PeriodFigures) -> Iterator[Objection]:
    place = f"period {p.label}"
    for found in _check("registered", p.registered / max(p.photos, 1), place):
        far = [reason for reason in p.reasons if reason.endswith(ANOTHER_PLACE)]
        yield replace(found, found=f"{found.found}; {far[0]}", todo=PLACE) if far else found
    yield from _check("images", p.registered, place)
    for key, part in (("loose", p.loose), ("gps_part", p.elsewhere)):
        if part:
            yield from _check(key, len(part), place, f" ({part[0]} to {part[-1]})")
    if isinstance(p.gps, PeriodGpsFit):
        gps = p.gps
        yield from _check("gps_residual", gps.local, place)
        if gps.scale is not None and gps.scale_error is not None:
            beyond = abs(gps.scale - 1) - 3 * gps.scale_error
            yield from _check("gps_scale", 100 * beyond, place)
        if gps.turn is not None and gps.turn_error is not None:
            yield from _check("gps_turn", abs(gps.turn) - 3 * gps.turn_error, place)


def _thin(p: PeriodFigures) -> Iterator[Objection]:
    """Objection to photos that overlap too little; no reason for doubt by itself."""
    if p.in_three is not None:
        yield from _check("in_three", p.in_three, f"period {p.label}")


def _between_gps(certificate: Certificate) -> Iterator[Objection]:
    """Judge the GPS offset between every two periods; either of the two may be wrong."""
    fits = [(p, p.gps) for p in certificate.periods if isinstance(p.gps, PeriodGpsFit)]
    for i, (p, one) in enumerate(fits):
        for q, other in fits[i + 1 :]:
            gap = (one.offset - other.offset)[:2]
            distance = float(np.linalg.norm(gap))
            spread = np.hypot(one.offset_error[:2], other.offset_error[:2]).max()
            beyond = distance - 3 * float(spread)
            place = f"periods {p.label} and {q.label}"
            yield from _check("gps_offset", beyond, place, f" ({distance:.1f} m in all)")


def _of_pair(certificate: Certificate, pair: PairFigures) -> Iterator[Objection]:
    names = certificate.labels
    place = f"periods {names[pair.a]} and {names[pair.b]}"
    yield from _alignment(certificate, pair, place)
    if not isinstance(pair.held_out, str) and pair.held_out.tracks >= MIN_TRACKS:
        held = pair.held_out
        # Surfaces that measure the alignment by themselves tell which of the matches are right.
        if not _surfaces_fit(certificate, pair):
            yield from _check("agreeing", held.agreeing, place)
            yield from _check("together", (1 - held.agreeing) * held.disagreement.step, place)
        yield from _check("gathered", (1 - held.agreeing) * held.disagreement.images, place)
        yield from _check("excess", _excess(certificate, pair), place)
    if not _confirmed(certificate, pair):
        yield from _check("occupied", pair.ties.occupied, place)
        yield from _check("tied", min(pair.ties.tied_a, pair.ties.tied_b), place)
    for found in (pair.localised_b, pair.localised_a):
        if isinstance(found, Localisation) and found.images >= 3:
            yield from _check("localised", _localised(found, certificate), place)
    if certificate.facing and pair.focal_gap is not None:
        yield from _check("focal_gap", pair.focal_gap, place)
    if isinstance(pair.surfaces, SurfaceDistance):
        shift = pair.surfaces.shift
        moved = 100 * shift.value / certificate.extent if shift.low > 0 else 0.0
        against = list(_check("clouds", moved, place))
        yield from against or _contradiction(certificate, pair, place)
        yield from _check("open", 100 * shift.high / certificate.extent, place)
        yield from _check("surfaces", pair.surfaces.beyond, place)


def _contradiction(certificate: Certificate, pair: PairFigures, place: str) -> Iterator[Objection]:
    """Judge surfaces that contradict the matches, but not by a shift beyond the limit.

    Patches of real surfaces are surer than they are right, and err most in their turn. So the
    contradiction counts only where they are shifted, or by themselves find the periods displaced
    beyond the limit; forward-facing captures leave their depths open, so the latter says nothing
    there.
    """
    if isinstance(pair.surfaces, str) or not _contradicted(pair):
        return
    shifted = pair.surfaces.shift.low > 0
    alone = _of_limits(certificate, pair.by_surfaces)
    displaced = bool(alone) and alone[1].value > 1 and not certificate.facing
    if shifted or displaced:
        state = "are shifted" if shifted else "find the periods displaced beyond the limit"
        found = f"the surfaces {state}, and contradict the matches (Hotelling, 99 %)"
        yield Objection("doubtful", "clouds", place, found, THRESHOLDS["clouds"].why, LOOK)


def _of_limits(
    certificate: Certificate, found: tuple[Interval, Interval] | None
) -> tuple[Interval, ...]:
    """Rotation and displacement in units of their limits; nothing if they are not measured."""
    factors = 1 / _limit("rotation"), 100 / certificate.extent / _limit("shift")
    return tuple(
        Interval(*(factor * x for x in (one.value, one.low, one.high)))
        for one, factor in zip(found or (), factors, strict=False)
    )


def _contradicted(pair: PairFigures) -> bool:
    """True if the similarity of the surfaces excludes that of the ties, or of held-out tracks."""
    if isinstance(pair.surfaces, str) or pair.surfaces.motion is None:
        return False
    return any(
        isinstance(tracks, Misalignment) and both is None
        for tracks, both in (
            (pair.by_all, pair.by_ties_and_surfaces),
            (pair.misalignment, pair.independent),
        )
    )


def _localised(found: Localisation, certificate: Certificate) -> float:
    """The larger of both errors against its limit; it fails only as far as it is certain.

    An error far below the noise of the images counts only if they agree on it.
    """
    share = FACING if certificate.facing else 1.0
    likely = certain = 0.0
    for error, limit in (
        (found.rotation_excess, _limit("rotation")),
        (found.centre_excess, _limit("shift") * certificate.extent / 100),
    ):
        certain = max(certain, share * error.low / limit)
        if error.low > 0 or error.noise < VAGUE * limit:
            likely = max(likely, share * error.value / limit)
    bad = THRESHOLDS["localised"].fail
    assert bad is not None
    return certain if certain > bad else min(likely, bad)


def _alignment(certificate: Certificate, pair: PairFigures, place: str) -> Iterator[Objection]:
    """Judge the alignment of two periods, and its uncertainty.

    They are misaligned if the interval of all ties (and that of ties and surfaces) lies beyond the
    limit, or that of held-out tracks and the estimate of all ties: one interval in twenty misses
    the truth by chance.
    They are aligned if the interval of the precise measurement (all ties, and the surfaces) ends
    below the limit, and an independent one (held-out tracks, and the surfaces) agrees: its interval
    ends below the limit, or its estimate lies below it and its interval ends below twice the limit.
    Where it is wider, with its estimate below the limit, surfaces alone must confirm the ties.
    """
    held, by_all = pair.misalignment, pair.by_all
    confirmed = _confirmed(certificate, pair)
    if isinstance(by_all, str) or (isinstance(held, str) and not confirmed):
        tracks = 0 if isinstance(pair.held_out, str) else pair.held_out.tracks
        reason = held if isinstance(held, str) else str(by_all)
        yield from _check("held_out", min(tracks, 11), place, f" ({reason})")
    if isinstance(by_all, str):
        return
    for i, (key, factor) in enumerate((("rotation", 1.0), ("shift", 100.0 / certificate.extent))):
        limit, every = _limit(key), getattr(by_all, key)
        one = every if isinstance(held, str) else getattr(held, key)
        high = _precise(pair)[i].high * factor
        both = pair.by_ties_and_surfaces
        low = every.low if both is None else min(every.low, both[i].low)
        if max(low, min(one.low, every.value)) * factor > limit:
            yield from _check(key, max(one.value, every.value) * factor, place)
            continue
        # Surfaces alone where held-out tracks measure nothing.
        independent = pair.by_surfaces if isinstance(held, str) else pair.independent
        if independent is not None:
            one = min(one, independent[i], key=_high)
        loose, estimate = one.high * factor, one.value * factor
        beyond = loose > limit and estimate > limit  # Nothing confirms what this contradicts
        # Forward-facing cameras leave depths open, which errors of their poses bend, those of the
        # surfaces with them: without these, ties must end below the limit as well.
        if certificate.facing and every.high * factor > limit:
            high = every.high * factor
        room = (ROOM if every.high * factor <= limit and not certificate.facing else MARGIN) * limit
        if high > room or beyond or (loose > 2 * limit and not confirmed):
            t = THRESHOLDS[key]
            found = (
                f"{t.what}: {estimate:.3g} {t.unit}, but up to {max(high, loose):.3g} cannot be "
                f"ruled out; expected at most {room:g}"
            )
            yield Objection("doubtful", key, place, found, t.why, t.todo)


def _precise(pair: PairFigures) -> tuple[Interval, Interval]:
    """Rotation and displacement by all ties, and by the surfaces if these narrow them."""
    assert isinstance(pair.by_all, Misalignment)
    ties = pair.by_all.rotation, pair.by_all.shift
    both = pair.by_ties_and_surfaces or ties
    return min(ties[0], both[0], key=_high), min(ties[1], both[1], key=_high)


def _high(interval: Interval) -> float:
    return interval.high


def _confirmed(certificate: Certificate, pair: PairFigures) -> bool:
    """True if surfaces confirm the ties, and no held-out tracks deny them.

    Surfaces exclude a step of repeated structure; how far few ties determine the rotation is then
    a question of their noise, which the interval answers.
    """
    held = pair.held_out
    if isinstance(held, str) or (held.tracks >= FEW_TRACKS and held.agreeing < FEW_AGREEING):
        return False
    return _surfaces_fit(certificate, pair)


def _surfaces_fit(certificate: Certificate, pair: PairFigures) -> bool:
    """True if the surfaces alone measure the alignment, and find it within the limits."""
    alone = _of_limits(certificate, pair.by_surfaces)
    fit = all(x.value <= 1 and x.high <= SURELY for x in alone)
    return bool(alone) and fit and not _contradicted(pair)


def _limit(key: str) -> float:
    return THRESHOLDS[key].doubtful


def _excess(certificate: Certificate, pair: PairFigures) -> float:
    """Held-out residual beyond the noise of matching, in degrees.

    The residuals of the model show that noise, slightly underestimated because points were fitted
    to them (`FITTED`).
    """
    assert not isinstance(pair.held_out, str)
    own = [certificate.periods[p].error or 0.0 for p in (pair.a, pair.b)]
    every = pair.by_all
    noise = every.noise if isinstance(every, Misalignment) else pair.held_out.noise
    beyond = np.sqrt(max(0.0, noise**2 - (FITTED * max(own)) ** 2))
    return float(np.degrees(np.arctan2(beyond, certificate.focal)))


def _links(
    certificate: Certificate, pairs: dict[tuple[int, int], Level | None], good: Array
) -> Iterator[Objection]:
    """Pairs without a link of their own that no good chain of other periods links.

    Args:
        certificate: What was measured.
        pairs: Level of each pair; None where nothing links the two directly.
        good: From `_bounds`, along pairs that passed.
    """
    names = certificate.labels
    some = _bounds(certificate, [k for k, level in pairs.items() if level is not None])
    far = {
        p.period
        for p in certificate.periods
        if any(reason.endswith(ANOTHER_PLACE) for reason in p.reasons)
    }
    for (a, b), level in pairs.items():
        place = f"periods {names[a]} and {names[b]}"
        if not np.isfinite(some[a, b]):
            yield Objection(
                "fail", "link", place, "no measurement links them",
                "without matches between them, their alignment is unknown",
                PLACE if {a, b} & far else CLICK,
            )  # fmt: skip
        elif level is None and not good[a, b] <= 1:
            left = (
                f"a chain of good pairs links them, but only to within {good[a, b]:.2g} times the "
                "limits"
                if np.isfinite(good[a, b])
                else "no chain of good pairs links them"
            )
            yield Objection("doubtful", "chain", place, left, "the errors of a chain add up", CLICK)


def _bounds(certificate: Certificate, pairs: list[tuple[int, int]]) -> Array:
    """Largest misalignment of two periods by chains of pairs, in units of the limits. [T, T]

    Errors of the links of a chain are independent: their squares add up.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import shortest_path

    weights = np.zeros((len(certificate.labels),) * 2)
    for pair in certificate.pairs:
        if (pair.a, pair.b) in pairs:
            weights[pair.a, pair.b] = 1e6
            if isinstance(pair.by_all, Misalignment):
                # By ties alone: errors of surfaces are not independent from link to link.
                shift = 100 * pair.by_all.shift.high / certificate.extent / _limit("shift")
                worst = max(pair.by_all.rotation.high / _limit("rotation"), shift, 1e-3)
                weights[pair.a, pair.b] = worst**2
    return np.asarray(np.sqrt(shortest_path(csr_array(weights), directed=False)))


def _words(certificate: Certificate, level: Level, objections: list[Objection]) -> str:
    count = len(certificate.labels)
    if level == "pass" and count == 1:
        return "There is only one period, so there is no alignment to judge."
    if level == "pass":
        return (
            f"The {count} periods lie in one frame, within 0.1 degrees and 0.2% of the scene's "
            "extent of each other, according to matches or surfaces that took no part in the "
            "estimation."
        )
    first = objections[0]
    start = (
        "The periods do not fit each other; do not use this registration as it is."
        if level == "fail"
        else "The registration may be correct, but the measurements do not prove it."
    )
    place = first.place[0].upper() + first.place[1:]  # labels stay as they are
    return f"{start} {place}: {first.found}."
