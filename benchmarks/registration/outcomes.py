"""Outcomes of registrations, and the call of the command; shared by the tiers of `accuracy.py`."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.registration.generated import pose_errors
from chronoscene.registration.output import Inspection
from chronoscene.registration.pipeline import Options
from chronoscene.registration.quality.verdict import Verdict
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.tracks import track_owners

ROUTES = ("joint", "separate", "frozen")

REFUSED = "refused"

ROTATION, CENTRE = 0.1, 0.2
"""Degrees, and percent of the extent, within which a registration is right."""

ABSENT = (np.inf,) * 4  # Errors of a period without a pose


@dataclass(frozen=True, slots=True)
class Outcome:
    """One case: errors of each period but the first, and the verdict."""

    family: str
    route: str
    """Empty where there is no choice."""
    periods: tuple[tuple[float, float, float, float], ...]
    """Rotation median and largest, degrees; centre median and largest, percent of the extent, where
    the median is at least that of the depths of points, by the scale of the cameras."""
    verdict: str
    reason: str
    seconds: float
    """CPU time."""

    @property
    def right(self) -> bool:
        return all(r < ROTATION and c < CENTRE for r, _, c, _ in self.periods)


def judged(
    family: str,
    route: str,
    model: Registered,
    truth: np.ndarray,
    verdict: Verdict,
    seconds: float,
    where: np.ndarray | None = None,
) -> Outcome:
    """Compare a registration with the truth [N, 4, 4], where that is known. [N]"""
    where = np.ones(len(truth), bool) if where is None else where
    reason = verdict.objections[0].check if verdict.objections else ""
    reference = where & (model.periods == 0)
    if not reference.any():  # nothing to compare the other periods with
        wrong = (ABSENT,) * (model.num_periods - 1)
        return Outcome(family, route, wrong, verdict.level, reason, seconds)
    rotation, centre = pose_errors(model.cam_from_world, truth, reference)
    depth = true_depth(model, truth, reference)
    extent = max(true_extent(truth[where]), depth)
    first = _spread(model, truth, reference)
    rows = []
    for p in range(1, model.num_periods):
        mine = where & (model.periods == p)
        if not mine.any():
            rows.append(ABSENT)
            continue
        r, c = rotation[mine], 100 * centre[mine] / extent
        deep = 100 * depth * abs(_spread(model, truth, mine) / first - 1) / extent
        rows.append((np.median(r), r.max(), max(np.median(c), deep), max(c.max(), deep)))
    return Outcome(family, route, tuple(rows), verdict.level, reason, seconds)


def refused(family: str, route: str, periods: int, seconds: float) -> Outcome:
    """A command that ended with a message instead of a registration."""
    return Outcome(family, route, (ABSENT,) * (periods - 1), REFUSED, "", seconds)


def save(outcomes: list[Outcome], file: Path) -> None:
    """Write outcomes, for a comparison with those of another version."""
    file.write_text(json.dumps([asdict(o) for o in outcomes], indent=0) + "\n", encoding="utf-8")


def load(file: Path) -> list[Outcome]:
    """Read what `save` wrote."""
    return [Outcome(**row) for row in json.loads(file.read_text(encoding="utf-8"))]


def true_extent(truth: np.ndarray) -> float:
    """Diagonal of the box around cameras."""
    return float(np.linalg.norm(np.ptp(camera_centre(truth), axis=0)))


def true_depth(model: Registered, truth: np.ndarray, images: np.ndarray) -> float:
    """Median distance along the view at which some images see points, in units of the truth."""
    image = model.track_image
    rows = np.flatnonzero(images[image])
    point = model.points[track_owners(model.track_start)[rows]]
    along = model.cam_from_world[image[rows], 2]
    depth = (along[:, :3] * point).sum(axis=1) + along[:, 3]
    size = true_extent(model.cam_from_world[images])
    return float(np.median(depth) * true_extent(truth[images]) / size)


def _spread(model: Registered, truth: np.ndarray, mine: np.ndarray) -> float:
    """Scale of some cameras against the truth, by their distances from their middle."""
    here, there = (
        np.linalg.norm(c - c.mean(axis=0), axis=1)
        for c in (camera_centre(p[mine]) for p in (model.cam_from_world, truth))
    )
    return float(np.median(here / there)) if mine.sum() > 1 else 1.0


@contextmanager
def work_folder(kept: Path | None) -> Iterator[Path]:
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as folder:
        yield Path(folder)


def cpu_seconds() -> float:
    """Seconds of this process and of those it started and waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def options_for(work: Path, route: str | None) -> Options:
    """Return the options of the command, with the page; None lets it choose the route."""
    return Options(route=route, overwrite=True, work=work, page=True)  # type: ignore[arg-type]


def print_outcome(outcome: Outcome, inspection: Inspection) -> None:
    """Errors by period, the verdict, and what it rests on."""
    for p, row in enumerate(outcome.periods, 1):
        print(
            f"  period {p}: rotation {row[0]:.4f} (largest {row[1]:.4f}) degrees, centre "
            f"{row[2]:.4f} (largest {row[3]:.4f}) % of the extent"
        )
    first = inspection.verdict.objections[:2]
    reasons = "; ".join(f"{o.check} {o.place}: {o.found}" for o in first)
    print(f"  verdict {outcome.verdict} {reasons}", flush=True)
