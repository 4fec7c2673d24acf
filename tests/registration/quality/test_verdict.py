"""Every check of the verdict by itself: a value just inside its limit, and one just outside.

The certificates are made by hand. Limits are written here as numbers, so that a changed threshold
shows; the scene measures 50 units and the focal length is 1000 pixels, so that forgotten factors
show as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import Any, cast

import numpy as np
import pytest

from chronoscene.registration.quality import metadata
from chronoscene.registration.quality.certificate import (
    Certificate,
    HeldOut,
    PairFigures,
    PeriodFigures,
)
from chronoscene.registration.quality.disagreement import Disagreement
from chronoscene.registration.quality.gps_fit import PeriodGpsFit
from chronoscene.registration.quality.localisation import Excess, Localisation
from chronoscene.registration.quality.misalignment import Interval, Misalignment
from chronoscene.registration.quality.overlap import TieSpread
from chronoscene.registration.quality.surface_distance import SurfaceDistance
from chronoscene.registration.quality.thresholds import AFTER_INTO, THRESHOLDS
from chronoscene.registration.quality.verdict import Verdict, _of_period, judge
from chronoscene.registration.result import ANOTHER_PLACE
from chronoscene.scene.similarity import Sim3

Change = Callable[[Certificate, float], Certificate]


def misalignment(rotation: float = 0.03, shift: float = 0.03) -> Misalignment:
    """Intervals from 0 to twice the value. Degrees and world units."""
    sizes = (Interval(x, 0.0, 2 * x) for x in (rotation, shift))
    return Misalignment(40, Sim3.identity(), *sizes, motion=cast(Any, None), noise=0.5)


def beyond(value: float, low: float = 0.0) -> Excess:
    """Error of localised images beyond a noise of half a limit or less."""
    return Excess(value, low, noise=0.05)


def made(count: int = 2) -> Certificate:
    """A registration that passes with a margin in every figure."""
    gps = PeriodGpsFit(
        positions=20, median=3.0, local=4.0, largest=9.0, outliers=0,
        scale=1.0, scale_error=0.01, turn=0.0, turn_error=0.5,
        offset=np.zeros(3), offset_error=np.array([0.3, 0.1, 50.0]),
    )  # fmt: skip
    local = Localisation(
        images=10, tried=10, rotation=0.01, centre=0.01,
        rotation_excess=beyond(0.01), centre_excess=beyond(0.01),
    )  # fmt: skip
    pair = PairFigures(
        a=0,
        b=1,
        ties=TieSpread(
            points=500, cells=90, occupied=0.8, hull=0.9, tied_a=1.0, tied_b=1.0,
            gaps=np.zeros((0, 3)),
        ),
        held_out=HeldOut(
            tracks=40, observations=300, median=0.5, p90=1.2, noise=0.5, agreeing=0.95,
            distance=0.01, gap=0.02, gap_tracks=20, epipolar=0.4, matches=200,
        ),
        misalignment=misalignment(),
        by_all=misalignment(),
        localised_b=local,
        localised_a=local,
        surfaces=SurfaceDistance(
            cores=900, stable=800, median=0.01, level=0.03, beyond=0.05,
            shift=Interval(0.01, 0.0, 0.2),
        ),
    )  # fmt: skip
    labels = ("May 2016", "May 2017", "May 2018", "May 2019")[:count]
    return Certificate(
        route="joint",
        unit="metre",
        extent=50.0,
        focal=1000.0,
        labels=labels,
        periods=tuple(
            PeriodFigures(i, label, 20, 20, {}, 0.5, 1000, gps) for i, label in enumerate(labels)
        ),
        pairs=tuple(replace(pair, a=a, b=b) for a, b in combinations(range(count), 2)),
        evidence=cast(Any, None),  # the verdict does not look at it
    )


def with_period(certificate: Certificate, period: int = 1, **changes: Any) -> Certificate:
    periods = list(certificate.periods)
    periods[period] = replace(periods[period], **changes)
    return replace(certificate, periods=tuple(periods))


def with_gps(certificate: Certificate, period: int = 1, **changes: Any) -> Certificate:
    gps = certificate.periods[period].gps
    assert isinstance(gps, PeriodGpsFit)
    return with_period(certificate, period, gps=replace(gps, **changes))


def with_loose(certificate: Certificate, count: int) -> Certificate:
    return with_period(certificate, 1, loose=tuple(f"{i}.jpg" for i in range(count)))


def with_pair(
    certificate: Certificate, pair: tuple[int, int] = (0, 1), **changes: Any
) -> Certificate:
    changed = tuple(replace(p, **changes) if (p.a, p.b) == pair else p for p in certificate.pairs)
    return replace(certificate, pairs=changed)


def with_part(
    certificate: Certificate, part: str, pair: tuple[int, int] = (0, 1), **changes: Any
) -> Certificate:
    """Change fields of one of the figures of a pair."""
    figures = next(getattr(p, part) for p in certificate.pairs if (p.a, p.b) == pair)
    return with_pair(certificate, pair, **{part: replace(figures, **changes)})


def apart(certificate: Certificate, pair: tuple[int, int], ties: int = 0) -> Certificate:
    """Take all measurements of the alignment from a pair."""
    nothing = "nothing is seen by both"
    changed = with_part(certificate, "ties", pair, points=ties)
    return with_pair(
        changed, pair, held_out=nothing, misalignment=nothing, by_all=nothing,
        localised_a=nothing, localised_b=nothing, surfaces=nothing,
    )  # fmt: skip


def found(verdict: Verdict) -> list[tuple[str, str]]:
    return [(f.check, f.level) for f in verdict.objections]


def test_a_registration_that_is_good_in_everything_passes() -> None:
    for count in (1, 2, 4):
        verdict = judge(made(count))
        assert verdict.level == "pass"
        assert not verdict.objections
        assert set(verdict.pairs.values()) <= {"pass"}
        assert verdict.text.startswith(
            "There is only" if count == 1 else f"The {count} periods lie"
        )


LIMITS: dict[str, tuple[str, str, Change, float, float]] = {
    # name: (check, level of what is outside, change, value inside, value outside)
    "registered": ("registered", "doubtful", lambda c, x: with_period(c, photos=x), 33, 34),
    "registered, fail": ("registered", "fail", lambda c, x: with_period(c, photos=x), 200, 201),
    "registered, first": (
        "registered", "doubtful", lambda c, x: with_period(c, 0, photos=x), 33, 34,
    ),
    "images": ("images", "doubtful", lambda c, x: with_period(c, registered=x, photos=x), 5, 4),
    "images, fail": ("images", "fail", lambda c, x: with_period(c, registered=x, photos=x), 3, 2),
    "rotation, all ties": (
        "rotation", "doubtful",
        lambda c, x: with_part(c, "by_all", rotation=Interval(0.04, 0.0, x)), 0.0949, 0.0951,
    ),
    "rotation, all ties, fail": (
        "rotation", "fail",
        lambda c, x: with_part(c, "by_all", rotation=Interval(x, x, 0.5)), 0.0999, 0.1001,
    ),
    "rotation, held out": (
        "rotation", "doubtful",
        lambda c, x: with_part(c, "misalignment", rotation=Interval(0.04, 0.0, x)), 0.1999, 0.2001,
    ),
    "rotation, held out, estimate": (
        "rotation", "doubtful",
        lambda c, x: with_part(c, "misalignment", rotation=Interval(x, 0.0, 0.15)), 0.0999, 0.1001,
    ),
    "rotation, held out, fail": (
        "rotation", "fail",
        lambda c, x: with_part(
            with_part(c, "by_all", rotation=Interval(0.11, 0.0, 0.5)),
            "misalignment", rotation=Interval(x, x, 0.5),
        ), 0.0999, 0.1001,
    ),
    "shift, all ties": (
        "shift", "doubtful",
        lambda c, x: with_part(c, "by_all", shift=Interval(0.04, 0.0, x)), 0.0949, 0.0951,
    ),
    "shift, all ties, fail": (
        "shift", "fail",
        lambda c, x: with_part(c, "by_all", shift=Interval(x, x, 0.5)), 0.0999, 0.1001,
    ),
    "shift, held out": (
        "shift", "doubtful",
        lambda c, x: with_part(c, "misalignment", shift=Interval(0.04, 0.0, x)), 0.1999, 0.2001,
    ),
    "shift, held out, estimate": (
        "shift", "doubtful",
        lambda c, x: with_part(c, "misalignment", shift=Interval(x, 0.0, 0.15)), 0.0999, 0.1001,
    ),
    "shift, held out, fail": (
        "shift", "fail",
        lambda c, x: with_part(
            with_part(c, "by_all", shift=Interval(0.11, 0.0, 0.5)),
            "misalignment", shift=Interval(x, x, 0.5),
        ), 0.0999, 0.1001,
    ),
    "agreeing": (
        "agreeing", "doubtful", lambda c, x: with_part(c, "held_out", agreeing=x), 0.351, 0.349,
    ),
    # Half of the observations disagree.
    "together": (
        "together", "doubtful",
        lambda c, x: with_part(c, "held_out", agreeing=0.5, disagreement=Disagreement(step=x)),
        0.159, 0.161,
    ),
    "gathered": (
        "gathered", "doubtful",
        lambda c, x: with_part(c, "held_out", agreeing=0.5, disagreement=Disagreement(images=x)),
        0.299, 0.301,
    ),
    "agreeing, fail": (
        "agreeing", "fail", lambda c, x: with_part(c, "held_out", agreeing=x), 0.151, 0.149,
    ),
    # With an error of 0.5 px, 1.3 times that is noise: 0.698 px are 0.04 degrees, 6.981 px 0.4.
    "excess": (
        "excess", "doubtful", lambda c, x: with_part(c, "by_all", noise=x), 0.953, 0.954,
    ),
    "excess, fail": (
        "excess", "fail", lambda c, x: with_part(c, "by_all", noise=x), 7.011, 7.012,
    ),
    "occupied": (
        "occupied", "doubtful", lambda c, x: with_part(c, "ties", occupied=x), 0.151, 0.149,
    ),
    "tied, first": ("tied", "doubtful", lambda c, x: with_part(c, "ties", tied_a=x), 0.501, 0.499),
    "tied, second": ("tied", "doubtful", lambda c, x: with_part(c, "ties", tied_b=x), 0.501, 0.499),
    "localised, first, rotation": (
        "localised", "doubtful",
        lambda c, x: with_part(c, "localised_a", rotation_excess=beyond(x)), 0.0599, 0.0601,
    ),
    "localised, second, centre": (
        "localised", "doubtful",
        lambda c, x: with_part(c, "localised_b", centre_excess=beyond(x)), 0.0599, 0.0601,
    ),
    "localised, forward-facing": (
        "localised", "doubtful",
        lambda c, x: with_part(
            replace(c, facing=True), "localised_b", centre_excess=beyond(x)
        ), 0.0749, 0.0751,
    ),
    "localised, rotation, fail": (
        "localised", "fail",
        lambda c, x: with_part(c, "localised_a", rotation_excess=beyond(5.0, x)), 0.999, 1.001,
    ),
    "localised, centre, fail": (
        "localised", "fail",
        lambda c, x: with_part(c, "localised_b", centre_excess=beyond(5.0, x)), 0.999, 1.001,
    ),
    "focal_gap": (
        "focal_gap", "doubtful",
        lambda c, x: with_pair(replace(c, facing=True), focal_gap=x), 0.199, 0.201,
    ),
    "clouds": (
        "clouds", "doubtful",
        lambda c, x: with_part(c, "surfaces", shift=Interval(x, 0.01, 0.2)), 0.0749, 0.0751,
    ),
    "clouds, interval": (
        "clouds", "doubtful",
        lambda c, x: with_part(c, "surfaces", shift=Interval(0.2, x, 0.3)), 0.0, 1e-6,
    ),
    "open": (
        "open", "doubtful",
        lambda c, x: with_part(c, "surfaces", shift=Interval(0.01, 0.0, x)), 0.3749, 0.3751,
    ),
    "surfaces": (
        "surfaces", "doubtful", lambda c, x: with_part(c, "surfaces", beyond=x), 0.299, 0.301,
    ),
    # The spread of the difference is hypot(0.3, 0.3) m; three times that is 1.273 m.
    "gps offset, east": (
        "gps_offset", "doubtful",
        lambda c, x: with_gps(c, offset=np.array([x, 0.0, 0.0])), 6.27, 6.28,
    ),
    "gps offset, north": (
        "gps_offset", "doubtful",
        lambda c, x: with_gps(c, 0, offset=np.array([0.0, x, 0.0])), 6.27, 6.28,
    ),
    "gps offset, fail": (
        "gps_offset", "fail",
        lambda c, x: with_gps(c, offset=np.array([x, 0.0, 0.0])), 16.27, 16.28,
    ),
    "loose": ("loose", "doubtful", with_loose, 0, 3),
    "gps part": (
        "gps_part", "doubtful",
        lambda c, x: with_period(c, 1, elsewhere=("1.jpg",) * x), 0, 3,
    ),
    "gps residual": ("gps_residual", "doubtful", lambda c, x: with_gps(c, local=x), 11.9, 12.1),
    "gps scale": ("gps_scale", "doubtful", lambda c, x: with_gps(c, scale=x), 1.0499, 1.0501),
    "gps scale, small": (
        "gps_scale", "doubtful", lambda c, x: with_gps(c, scale=x), 0.9501, 0.9499,
    ),
    "gps scale, fail": ("gps_scale", "fail", lambda c, x: with_gps(c, scale=x), 1.1299, 1.1301),
    "gps turn": ("gps_turn", "doubtful", lambda c, x: with_gps(c, turn=x), 3.49, 3.51),
    "gps turn, clockwise": ("gps_turn", "doubtful", lambda c, x: with_gps(c, turn=x), -3.49, -3.51),
    "gps turn, fail": ("gps_turn", "fail", lambda c, x: with_gps(c, turn=x), 11.49, 11.51),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMITS)
def test_each_check_has_its_limit(name: str) -> None:
    check, level, change, inside, outside = LIMITS[name]
    milder = [(check, "doubtful")] if level == "fail" else []
    assert found(judge(change(made(), inside))) == milder
    verdict = judge(change(made(), outside))
    assert found(verdict) == [(check, level)]
    assert verdict.level == level


def test_a_finding_states_the_limit_that_was_passed() -> None:
    for agreeing, limit in ((0.3, "0.35"), (0.1, "0.15")):
        (objection,) = judge(with_part(made(), "held_out", agreeing=agreeing)).objections
        assert objection.found.endswith(f": {agreeing}, expected at least {limit}")
    (objection,) = judge(with_gps(made(), local=14.0)).objections
    assert objection.found.endswith(": 14 m, expected at most 12")
    for part, limit in (("misalignment", "0.095"), ("by_all", "0.08")):
        wide = with_part(made(), part, rotation=Interval(0.04, 0.0, 0.3))
        (objection,) = judge(wide).objections
        assert objection.found.endswith(
            f": {0.04 if part == 'misalignment' else 0.03} degrees, but up to 0.3 cannot be ruled "
            f"out; expected at most {limit}"
        )


@pytest.mark.parametrize("noisy", [0, 1])
def test_the_noise_of_matching_is_that_of_the_noisier_period(noisy: int) -> None:
    certificate = with_part(made(), "by_all", noise=0.95)
    assert not judge(certificate).objections
    calm = with_period(certificate, 1 - noisy, error=0.1)
    assert not judge(calm).objections
    for error in (0.1, None):
        both_calm = with_period(calm, noisy, error=error)
        assert found(judge(both_calm)) == [("excess", "doubtful")]


@pytest.mark.parametrize(
    "change",
    [
        lambda c: with_gps(c, offset=np.array([0.0, 0.0, 80.0])),
        lambda c: with_gps(
            with_gps(c, offset=np.array([20.0, 0.0, 0.0])), 0, offset=np.array([20.0, 0.0, 0.0])
        ),
        lambda c: with_gps(c, scale=None, scale_error=None, turn=None, turn_error=None),
        lambda c: with_period(c, gps="the frame is not georeferenced"),
        lambda c: with_part(c, "held_out", tracks=11, agreeing=0.0, noise=50.0),
        lambda c: with_part(
            c, "localised_a", images=2, rotation_excess=beyond(50.0, 40.0)
        ),
        lambda c: with_pair(c, localised_a="no image", localised_b="no image"),
        lambda c: with_pair(c, surfaces="too few for surfaces"),
    ],
    ids=[
        "height", "common offset", "short path", "no GPS", "11 tracks", "2 images", "no image",
        "no surfaces",
    ],
)  # fmt: skip
def test_what_cannot_be_judged_is_not(change: Callable[[Certificate], Certificate]) -> None:
    assert judge(change(made())).level == "pass"


def test_a_dozen_tracks_and_three_images_are_enough_to_be_judged() -> None:
    tracks = with_part(made(), "held_out", tracks=12, agreeing=0.3)
    assert found(judge(tracks)) == [("agreeing", "doubtful")]
    images = with_part(made(), "localised_b", images=3, rotation_excess=beyond(0.5, 0.1))
    assert found(judge(images)) == [("localised", "doubtful")]


@pytest.mark.parametrize(
    "missing", [("misalignment",), ("by_all",), ("misalignment", "by_all")], ids="+".join
)
@pytest.mark.parametrize("tracks", [0, 8, 40])
def test_without_both_measurements_there_is_no_pass(missing: tuple[str, ...], tracks: int) -> None:
    """Many held-out tracks that do not determine the alignment prove no more than few."""
    certificate = with_part(made(), "held_out", tracks=tracks)
    verdict = judge(with_pair(certificate, **dict.fromkeys(missing, "all in one spot")))
    assert found(verdict) == [("held_out", "doubtful")]
    assert f"{min(tracks, 11)} tracks, expected at least 12 (" in verdict.objections[0].found


def test_without_held_out_tracks_the_ties_can_still_prove_an_error() -> None:
    nothing = with_pair(made(), held_out="no track", misalignment="no track")
    assert found(judge(nothing)) == [("held_out", "doubtful")]
    assert "0 tracks, expected at least 12" in judge(nothing).objections[0].found
    wrong = with_part(nothing, "by_all", rotation=Interval(0.4, 0.2, 0.6))
    assert found(judge(wrong)) == [("rotation", "fail"), ("held_out", "doubtful")]


def confirmed(high: float = 0.1499) -> Certificate:
    """Three held-out tracks, and few ties in one spot, with surfaces that measure the rest."""
    few = with_part(made(), "held_out", tracks=3)
    few = with_part(few, "ties", occupied=0.05, tied_a=0.0)
    surfaces = (Interval(0.0999, 0.0, high),) * 2
    return with_pair(few, misalignment="too few", by_surfaces=surfaces, independent=surfaces)


def test_surfaces_confirm_what_few_held_out_tracks_leave_open() -> None:
    assert judge(confirmed()).level == "pass"
    unsure = with_pair(confirmed(), misalignment=misalignment(rotation=0.2, shift=0.2))
    for estimate, level in ((0.09, "pass"), (0.11, "doubtful")):
        wide = (Interval(estimate, 0.0, 0.3),) * 2
        assert judge(with_pair(unsure, independent=wide)).level == level


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("size", [Interval(0.1001, 0.0, 0.14), Interval(0.05, 0.0, 0.1501)])
def test_surfaces_confirm_only_what_they_measure(which: int, size: Interval) -> None:
    surfaces = [Interval(0.05, 0.0, 0.1)] * 2
    surfaces[which] = size
    checks = {"held_out", "occupied", "tied"}
    verdict = judge(with_pair(confirmed(), by_surfaces=tuple(surfaces)))
    assert {f.check for f in verdict.objections} == checks
    assert checks == {f.check for f in judge(with_pair(confirmed(), by_surfaces=None)).objections}


@pytest.mark.parametrize(
    "change",
    [
        lambda c: with_pair(c, held_out="no track"),
        lambda c: with_part(c, "held_out", tracks=4, agreeing=0.49),
    ],
)
def test_some_held_out_tracks_must_be_there_and_agree(
    change: Callable[[Certificate], Certificate],
) -> None:
    verdict = judge(change(confirmed()))
    assert {f.check for f in verdict.objections} == {"held_out", "occupied", "tied"}


@pytest.mark.parametrize(
    "figures", [{"agreeing": 0.1}, {"agreeing": 0.5, "disagreement": Disagreement(step=1.0)}]
)
def test_surfaces_tell_which_of_the_matches_are_right(figures: dict[str, Any]) -> None:
    divided = with_part(made(), "held_out", **figures)
    assert judge(divided).level != "pass"
    surfaces = (Interval(0.05, 0.0, 0.1499),) * 2
    assert judge(with_pair(divided, by_surfaces=surfaces)).level == "pass"
    gathered = with_part(divided, "held_out", agreeing=0.5, disagreement=Disagreement(images=1.0))
    assert found(judge(with_pair(gathered, by_surfaces=surfaces))) == [("gathered", "doubtful")]


def test_surfaces_can_stand_for_a_chain_that_is_too_long() -> None:
    loose = apart(made(3), (0, 2))
    for pair in ((0, 1), (1, 2)):
        loose = with_pair(loose, pair, by_all=misalignment(rotation=0.045))
    assert found(judge(loose)) == [("chain", "doubtful")]
    surfaces = (Interval(0.05, 0.0, 0.1499),) * 2
    assert judge(with_pair(loose, (0, 2), by_surfaces=surfaces)).level == "pass"


def test_an_error_that_surfaces_do_not_share_is_no_failure() -> None:
    wrong = with_part(made(), "by_all", rotation=Interval(0.4, 0.2, 0.6))
    assert judge(wrong).level == "fail"
    both = (Interval(0.05, 0.0, 0.08), Interval(0.05, 0.0, 0.08))
    assert judge(with_pair(wrong, by_ties_and_surfaces=both)).level == "pass"


def test_focal_lengths_of_dates_may_differ_where_cameras_surround_the_scene() -> None:
    assert judge(with_pair(made(), focal_gap=3.0)).level == "pass"


def test_forward_facing_captures_need_a_margin() -> None:
    facing = replace(made(), facing=True)
    for high, level in ((0.0799, "pass"), (0.0801, "doubtful")):
        verdict = judge(with_part(facing, "by_all", shift=Interval(0.04, 0.0, high)))
        assert verdict.level == level
    assert "expected at most 0.16" in verdict.objections[0].found
    # Surfaces may narrow the interval, but not from beyond the limit.
    narrow = (Interval(0.01, 0.0, 0.02), Interval(0.02, 0.0, 0.04))
    for high, level in ((0.0999, "pass"), (0.1001, "doubtful")):
        wide = with_part(facing, "by_all", shift=Interval(0.04, 0.0, high))
        assert judge(with_pair(wide, by_ties_and_surfaces=narrow)).level == level


@pytest.mark.parametrize("tracks", ["by_all", "misalignment"])
def test_shifted_surfaces_that_contradict_the_matches_are_a_doubt(tracks: str) -> None:
    both = (Interval(0.03, 0.0, 0.06),) * 2
    shifted = Interval(0.07, 0.001, 0.2)
    certificate = with_part(made(), "surfaces", motion=cast(Any, "some motion"), shift=shifted)
    certificate = with_pair(certificate, by_ties_and_surfaces=both, independent=both)
    assert judge(certificate).level == "pass"
    without = "by_ties_and_surfaces" if tracks == "by_all" else "independent"
    verdict = judge(with_pair(certificate, **{without: None}))
    assert found(verdict) == [("clouds", "doubtful")]
    # They contradict nothing where the tracks are too few to measure, or they may not be shifted.
    few = with_pair(certificate, **{without: None, tracks: "too few"})
    assert "clouds" not in {check for check, _ in found(judge(few))}
    still = with_part(certificate, "surfaces", shift=Interval(0.07, 0.0, 0.2))
    still = with_pair(still, **{without: None})
    assert judge(still).level == "pass"
    # A similarity alone is one if it displaces beyond the limit; patches turn by chance.
    for turn, shift, level in ((0.2, 0.099, "pass"), (0.0, 0.101, "doubtful")):
        alone = tuple(Interval(value, value - 0.01, value + 0.01) for value in (turn, shift))
        similar = with_pair(still, by_surfaces=alone)
        assert judge(similar).level == level
        # Forward-facing captures leave the depths of surfaces open.
        assert judge(replace(similar, facing=True)).level == "pass"


def test_held_out_tracks_beyond_the_limit_fail_with_the_estimate_of_all_ties() -> None:
    far = with_part(made(), "misalignment", rotation=Interval(0.3, 0.11, 0.5))
    assert found(judge(far)) == [("rotation", "doubtful")]
    for estimate, level in ((0.099, "doubtful"), (0.101, "fail")):
        all_ties = with_part(far, "by_all", rotation=Interval(estimate, 0.0, 0.2))
        assert found(judge(all_ties)) == [("rotation", level)]


def test_an_error_far_below_the_noise_counts_only_if_the_images_agree_on_it() -> None:
    for low, noise, level in (
        (0.0, 0.099, "doubtful"), (0.0, 0.101, "pass"), (0.01, 0.3, "doubtful")
    ):  # fmt: skip
        certificate = with_part(made(), "localised_a", rotation_excess=Excess(0.1, low, noise))
        assert judge(certificate).level == level


def test_surfaces_narrow_what_ties_leave_open() -> None:
    wide = with_part(made(), "by_all", rotation=Interval(0.04, 0.0, 0.3))
    both = (Interval(0.03, 0.0, 0.0799), Interval(0.03, 0.0, 0.06))
    assert judge(with_pair(wide, by_ties_and_surfaces=both)).level == "pass"
    loose = with_part(made(), "misalignment", rotation=Interval(0.12, 0.0, 0.15))
    assert found(judge(with_pair(loose, independent=both))) == []
    assert found(judge(with_pair(loose, by_ties_and_surfaces=both))) == [("rotation", "doubtful")]


def test_three_ties_are_a_link_and_two_are_none() -> None:
    linked, unlinked = (judge(apart(made(), (0, 1), ties=n)) for n in (3, 2))
    assert linked.pairs[0, 1] == "doubtful"
    assert found(linked) == [("held_out", "doubtful")]
    assert unlinked.pairs[0, 1] is None
    assert found(unlinked) == [("link", "fail")]


def test_measured_tracks_link_without_any_tie() -> None:
    """Clicked points alone, or held-out tracks alone."""
    for measured in ({"by_all": misalignment()}, {"held_out": made().pairs[0].held_out}):
        verdict = judge(with_pair(apart(made(), (0, 1)), **measured))
        assert verdict.pairs[0, 1] == "doubtful"
        assert verdict.level == "doubtful"


@pytest.mark.parametrize(("rotation", "shift"), [(1.0, 0.0), (0.0, 1.0)])
def test_a_chain_counts_as_far_as_its_errors_add_up(rotation: float, shift: float) -> None:
    """Two links of 0.0707 degrees, or of 0.1414% of the extent, make 0.1 or 0.2%."""

    def chained(size: float) -> Verdict:
        certificate = apart(made(3), (0, 2))
        link = misalignment(max(rotation * size, 1e-3) / 2, max(shift * size, 1e-3) / 2)
        for pair in ((0, 1), (1, 2)):
            certificate = with_pair(certificate, pair, by_all=link)
        return judge(certificate)

    assert chained(0.0707).level == "pass"
    longer = chained(0.0708)
    assert found(longer) == [("chain", "doubtful")]
    assert "within 1 times the limits" in longer.objections[0].found
    assert longer.pairs == {(0, 1): "pass", (0, 2): None, (1, 2): "pass"}


def test_a_chain_has_no_doubtful_link() -> None:
    certificate = with_part(apart(made(3), (0, 2)), "held_out", (1, 2), agreeing=0.3)
    verdict = judge(certificate)
    assert found(verdict) == [("agreeing", "doubtful"), ("chain", "doubtful")]
    assert verdict.objections[1].found == "no chain of good pairs links them"


def test_a_period_that_nothing_links_fails_with_each_of_the_others() -> None:
    verdict = judge(apart(apart(made(3), (0, 2)), (1, 2)))
    assert found(verdict) == [("link", "fail")] * 2
    assert [f.place for f in verdict.objections] == [
        "periods May 2016 and May 2018",
        "periods May 2017 and May 2018",
    ]


WEAK: dict[str, Callable[[Certificate], Certificate]] = {
    "held_out": lambda c: with_pair(c, (0, 2), misalignment="few"),
    "rotation": lambda c: with_part(c, "by_all", (0, 2), rotation=Interval(0.04, 0.0, 0.3)),
    "shift": lambda c: with_part(c, "by_all", (0, 2), shift=Interval(0.04, 0.0, 0.3)),
    "occupied": lambda c: with_part(c, "ties", (0, 2), occupied=0.05),
    "tied": lambda c: with_part(c, "ties", (0, 2), tied_b=0.1),
    "agreeing": lambda c: with_part(c, "held_out", (0, 2), agreeing=0.3),
    "excess": lambda c: with_part(c, "by_all", (0, 2), noise=3.0),
    "localised": lambda c: with_part(c, "localised_a", (0, 2), rotation_excess=beyond(0.3)),
    "clouds": lambda c: with_part(c, "surfaces", (0, 2), shift=Interval(0.2, 0.1, 0.3)),
    "surfaces": lambda c: with_part(c, "surfaces", (0, 2), beyond=0.5),
}
"""Doubt about the pair of the first and the last of three periods."""


@pytest.mark.parametrize("check", WEAK)
def test_a_chain_supplies_evidence_but_refutes_nothing(check: str) -> None:
    verdict = judge(WEAK[check](made(3)))
    assert verdict.pairs[0, 2] == "doubtful"
    lacking = check in ("held_out", "rotation", "shift", "occupied", "tied")
    assert found(verdict) == ([] if lacking else [(check, "doubtful")])
    # A chain that is itself loose supplies nothing.
    loose = made(3)
    for pair in ((0, 1), (1, 2)):
        loose = with_pair(loose, pair, by_all=misalignment(rotation=0.045))
    assert (check, "doubtful") in found(judge(WEAK[check](loose)))


def test_a_chain_does_not_heal_a_failure() -> None:
    turned = with_part(made(3), "by_all", (0, 2), rotation=Interval(0.4, 0.2, 0.6))
    assert found(judge(turned)) == [("rotation", "fail")]


def test_the_worst_comes_first_and_is_what_the_text_names() -> None:
    certificate = with_period(with_part(made(), "held_out", agreeing=0.1), 0, photos=50)
    verdict = judge(certificate)
    assert found(verdict) == [("agreeing", "fail"), ("registered", "doubtful")]
    assert verdict.text.startswith("The periods do not fit each other")
    assert "Periods May 2016 and May 2017: share of held-out observations" in verdict.text
    assert [len(verdict.todo), verdict.todo[0]] == [2, verdict.objections[0].todo]
    doubtful = judge(with_period(made(), photos=50))
    assert "Period May 2017: share of the photos" in doubtful.text
    assert "do not prove it" in doubtful.text


def test_what_to_do_is_said_once_and_can_be_done() -> None:
    turned = with_part(made(), "by_all", rotation=Interval(0.4, 0.2, 0.6))
    both = with_part(turned, "surfaces", beyond=0.4)
    (todo,) = judge(both).todo
    assert todo.startswith("look at the comparisons") and todo.endswith("again with --tie-points")
    (extended,) = judge(replace(both, route="frozen")).todo
    assert extended.endswith("register all dates together, without --into, with --tie-points")


@pytest.mark.parametrize("usual", [*(t.todo for t in THRESHOLDS.values()), *metadata.TODO.values()])
def test_no_advice_after_into_is_refused_with_into(usual: str) -> None:
    advice = AFTER_INTO.get(usual, usual)
    refused = "--tie-points" in advice or "--calibration" in advice
    assert not refused or "without --into" in advice


def test_a_row_that_is_not_proven_is_told_what_to_photograph() -> None:
    assert judge(with_period(made(), in_three=0.4)).level == "pass"  # no doubt by itself
    few = with_part(made(), "ties", tied_a=0.4)
    assert found(judge(with_period(few, in_three=0.5))) == [("tied", "doubtful")]
    verdict = judge(with_period(few, in_three=0.4))
    assert found(verdict) == [("in_three", "doubtful"), ("tied", "doubtful")]
    assert "Period May 2017: share of the points" in verdict.text
    for words in ("steps half as long", "second pass", "diagonally ahead", "loops"):
        assert words in verdict.todo[0]
    assert "from where the photos of the other date were taken" in verdict.todo[1]
    failed = judge(with_period(with_part(made(), "held_out", agreeing=0.1), in_three=0.4))
    assert found(failed) == [("agreeing", "fail"), ("in_three", "doubtful")]


def test_another_place_is_not_told_to_add_viewpoints_between() -> None:
    figures = {
        reason: PeriodFigures(1, "b", 0, 20, {reason: 20}, None, 0, "none")
        for reason in ("too few matches", f"2,415 km from the other dates by GPS: {ANOTHER_PLACE}")
    }
    usual, far = (
        next(o for o in _of_period(p) if o.check == "registered") for p in figures.values()
    )
    assert "viewpoints between" in usual.todo
    assert "2,415 km" in far.found and "check that the photos show this place" in far.todo
    assert "viewpoints" not in far.todo
