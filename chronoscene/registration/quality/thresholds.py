"""Thresholds of the checks of a registration, each with its reason and with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

Level = Literal["pass", "doubtful", "fail"]

LEVELS: tuple[Level, ...] = ("pass", "doubtful", "fail")


@dataclass(frozen=True, slots=True, kw_only=True)
class Threshold:
    """One check: the limits beyond which a figure is doubtful, and beyond which it fails."""

    what: str
    unit: str = ""
    doubtful: float
    fail: float | None = None
    """None where the figure alone proves no error."""
    larger_is_better: bool = False
    why: str
    todo: str

    def level(self, value: float) -> Level:
        """Level of a measured figure."""
        sign = -1.0 if self.larger_is_better else 1.0
        if self.fail is not None and sign * value > sign * self.fail:
            return "fail"
        return "doubtful" if sign * value > sign * self.doubtful else "pass"


_MARK = "mark points that both dates show with chronoscene mark (--report may suggest spots), and"
_LOOK = (
    "look at the comparisons on the page (--report); if flat ground that did not change jumps in "
    "most of them,"
)
_RELIABLE = "if the GPS is reliable,"
_CALIBRATE, _OBLIQUE = "calibrate each date (--calibration per-period)", "add oblique photos"
_SAME_LENS = "if the lens and its focus were the same,"
_FLAT = (
    "if the photos were not cropped and the zoom is as stated, add oblique photos, or photos from "
    "a second height: photos of flat ground from one height do not determine it; or"
)
_TAKE_OFF = "heights are those above the take-off point: if that lies on the ground of the scene,"
_OTHER_LENS = "else calibrate it (--cameras), or photograph from the sides as well"

CLICK = f"{_MARK} run again with --tie-points"
LOOK = f"{_LOOK} {CLICK}"
OFFSET = f"{_RELIABLE} {CLICK}"
WORST = "look at the worst pair on the page (--report); remove its photos if they do not fit"
PLACE = "check that the photos show this place; leave out those that do not"
REPEAT = (
    "photograph again from where the photos of the other date were taken, in the same directions"
)
CONTROL = "give ground control: --tie-points with world coordinates"
FLAT, TAKE_OFF = f"{_FLAT} {CONTROL}", f"{_TAKE_OFF} {CONTROL}"
BEND = f"{_CALIBRATE}, or {_OBLIQUE}; otherwise {CONTROL}"
SHARED = f"{_SAME_LENS} run again with --calibration shared; {_OTHER_LENS}"

_TOGETHER = "register all dates together, without --into,"
_CLICKED = f"{_MARK} {_TOGETHER} with --tie-points"
_CONTROLLED = f"{_TOGETHER} with ground control: --tie-points with world coordinates"
AFTER_INTO = {
    CLICK: _CLICKED,
    LOOK: f"{_LOOK} {_CLICKED}",
    OFFSET: f"{_RELIABLE} {_CLICKED}",
    CONTROL: _CONTROLLED,
    FLAT: f"{_FLAT} {_CONTROLLED}",
    TAKE_OFF: f"{_TAKE_OFF} {_CONTROLLED}",
    BEND: f"{_OBLIQUE}, or {_CONTROLLED}",
    SHARED: f"{_SAME_LENS} {_TOGETHER} with --calibration shared; {_OTHER_LENS}",
}
"""Advice after ``--into``, which takes neither tie points nor another calibration, in place of the
keys; other advice stays as it is."""

THRESHOLDS: dict[str, Threshold] = {
    "registered": Threshold(
        what="share of the photos of a period that are registered",
        doubtful=0.6, fail=0.1, larger_is_better=True,
        why="measurements say little about a period most of whose photos are missing",
        todo="registration_log.json says why photos are missing; add photos half a step apart "
        "between them and their neighbours, and with viewpoints between those of the dates",
    ),
    "images": Threshold(
        what="registered images of a period",
        unit="images", doubtful=5, fail=3, larger_is_better=True,
        why="fewer images cannot place points by themselves, so nothing can be checked",
        todo="add photos of the periods with so few",
    ),
    "rotation": Threshold(
        what="remaining rotation between two periods",
        unit="degrees", doubtful=0.1, fail=0.1,
        why="0.1 degrees is 1.7 pixels at a focal length of 1000: twice the error of matching",
        todo=CLICK,
    ),
    "shift": Threshold(
        what="remaining displacement between two periods",
        unit="% of extent", doubtful=0.2, fail=0.2,
        why="0.2% is 20 cm in 100 m: smaller changes cannot be distinguished from misalignment",
        todo=CLICK,
    ),
    "held_out": Threshold(
        what="held-out tracks between two periods",
        unit="tracks", doubtful=12, larger_is_better=True,
        why="a similarity has seven unknowns and fits almost any smaller number of tracks",
        todo=CLICK,
    ),
    "agreeing": Threshold(
        what="share of held-out observations that agree",
        doubtful=0.35, fail=0.15, larger_is_better=True,
        why="false matches that are scattered do no harm, but with more of them than right ones "
        "the estimate may be one of theirs",
        todo=WORST,
    ),
    "together": Threshold(
        what="share of held-out observations that disagree in one direction",
        doubtful=0.08,
        why="matches that err by one step come from repeated structure, and these may be the right "
        "ones",
        todo=LOOK,
    ),
    "gathered": Threshold(
        what="share of held-out observations that disagree and gather in some images",
        doubtful=0.15,
        why="the poses of these images are wrong, or those of the others",
        todo=WORST,
    ),
    "excess": Threshold(
        what="residual of ties and held-out tracks beyond the noise of matching, as an angle",
        unit="degrees", doubtful=0.04, fail=0.4,
        why="errors that no similarity explains come from drift that deforms a period (doming), "
        "which turns images by twice as much, or from a wrong camera",
        todo=BEND,
    ),
    "loose": Threshold(
        what="photos in parts of the model that most of their matches contradict",
        doubtful=0.0,
        why="where few photos turn a corner, what comes behind can get another size: each two "
        "photos agree with that, but not what three of them see; or false matches hold the part",
        todo="photograph the way between these photos and the others again, with steps so short "
        "that three photos show every spot, also in corners; or leave the photos out",
    ),
    "occupied": Threshold(
        what="share of the overlap of two periods that has tie points",
        doubtful=0.15, larger_is_better=True,
        why="matches in one spot can come from repeated structure, and say little about the rest",
        todo=CLICK,
    ),
    "tied": Threshold(
        what="share of the images of a period that see tie points",
        doubtful=0.5, larger_is_better=True,
        why="images without any are held by their own period alone",
        todo=REPEAT,
    ),
    "in_three": Threshold(
        what="share of the points of a period that three images or more see",
        doubtful=0.5, larger_is_better=True,
        why="photos that overlap with the next one alone let a row bend, and nothing shows it; "
        "counts only beside other findings",
        todo="photograph more, so that three photos show every spot: steps half as long, a second "
        "pass along each row that looks diagonally ahead, and loops or crossings that connect "
        "rows",
    ),
    "localised": Threshold(
        what="pose error of images localised from the other period, beyond its noise",
        unit="times 0.1 degrees or 0.2%", doubtful=0.6, fail=10.0,
        why="the points of each period must place the images of the other correctly",
        todo=LOOK,
    ),
    "focal_gap": Threshold(
        what="difference between the focal lengths of two periods whose cameras look one way from "
        "nearly one place",
        unit="%", doubtful=0.2,
        why="there, a camera that stands further back with a longer lens sees nearly the same, so "
        "an error of the focal length moves it by that share of the depth",
        todo=SHARED,
    ),
    "clouds": Threshold(
        what="shift between the surfaces of two periods, if its interval excludes 0",
        unit="% of extent", doubtful=0.15,
        why="surfaces are compared without matches, so repeated structure shows here; but a beach "
        "or a quarry may really have moved",
        todo=LOOK,
    ),
    "open": Threshold(
        what="shift between the surfaces of two periods that is not ruled out",
        unit="% of extent", doubtful=0.75,
        why="matches of repeated structure agree with each other wherever they lead; surfaces must "
        "exclude its steps",
        todo=LOOK,
    ),
    "surfaces": Threshold(
        what="share of the surfaces beyond their level of detection",
        doubtful=0.3,
        why="correct registrations stay below 0.25 even where two thirds of the scene is new; "
        "above, surfaces contradict the matches, as with repeated structure",
        todo=LOOK,
    ),
    "gps_offset": Threshold(
        what="horizontal offset between the GPS of two periods, beyond its spread",
        unit="m", doubtful=5.0, fail=15.0,
        why="the bias of a receiver varies by up to about 3.5 m from day to day; heights vary "
        "more, so they are not judged",
        todo=OFFSET,
    ),
    "gps_residual": Threshold(
        what="residual of a period's cameras to its own GPS, median of neighbouring ones",
        unit="m", doubtful=12.0,
        why="receivers err by 3 to 8 m; more means that part of the poses is wrong, or that the "
        "view of the sky was obstructed",
        todo="look at the map on the page (--report); register the period alone to see which "
        "photos deform it",
    ),
    "gps_part": Threshold(
        what="photos in parts of the model that GPS places elsewhere",
        doubtful=0.0,
        why="where neighbours are 30 m or more from their GPS, all in one direction, the model may "
        "have them in the wrong place; gross errors of a receiver differ from photo to photo",
        todo="look at the map on the page (--report); if the GPS is right, photograph the way "
        "between these photos and the others again, or leave them out",
    ),
    "gps_scale": Threshold(
        what="scale of a period against its own GPS, beyond its spread",
        unit="%", doubtful=2.0, fail=10.0,
        why="GPS errs in position, hardly in scale",
        todo=CONTROL,
    ),
    "gps_turn": Threshold(
        what="heading of a period against its own GPS, beyond its spread",
        unit="degrees", doubtful=2.0, fail=10.0,
        why="GPS errs in position, hardly in direction",
        todo=CONTROL,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Objection:
    """A figure beyond its limit, or one that is needed and missing."""

    level: Level
    check: str
    """Key of the threshold, or name of another test."""
    place: str
    """Period or pair of periods, in words."""
    found: str
    why: str
    todo: str


def worst_level(levels: Iterator[Level]) -> Level:
    """The most severe of some levels; pass if there are none."""
    return max(levels, key=LEVELS.index, default="pass")


def check(
    threshold: Threshold, value: float, place: str, key: str, note: str = ""
) -> Iterator[Objection]:
    """An objection, unless the figure passes."""
    level = threshold.level(value)
    if level == "pass":
        return
    limit = threshold.doubtful if level == "doubtful" or threshold.fail is None else threshold.fail
    side = "at least" if threshold.larger_is_better else "at most"
    unit = f" {threshold.unit}" if threshold.unit else ""
    found = f"{threshold.what}: {value:.3g}{unit}, expected {side} {limit:g}{note}"
    yield Objection(level, key, place, found, threshold.why, threshold.todo)
