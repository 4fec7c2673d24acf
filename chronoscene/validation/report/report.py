"""The outcome of a validation, as data. `report_text` and `report_json` write it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from chronoscene.validation.finding import SEVERITIES, Finding, Severity
from chronoscene.validation.scene_folder import RawScene


@dataclass(frozen=True, slots=True)
class PeriodSummary:
    """Counts of one period."""

    id: int
    images: int
    train: int | None
    """None if the split is not known."""
    test: int | None
    reprojection_px: float | None = None
    """Median over its images of their median reprojection errors, if it was looked at."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What is in a scene; None for what cannot be read."""

    images: int | None
    cameras: int | None
    points: int | None
    observations: int | None
    image_files: int
    """Files in ``images/``, registered or not."""
    periods: tuple[PeriodSummary, ...]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A rule that could not be run."""

    code: str
    reason: str


@dataclass(frozen=True, slots=True)
class SceneReport:
    """Everything that was found in one scene."""

    name: str
    path: Path
    summary: Summary
    findings: tuple[Finding, ...]
    """Errors first, then by code, then in the order of the rule."""
    skipped: tuple[Skipped, ...]

    def count(self, severity: Severity) -> int:
        return sum(f.severity == severity for f in self.findings)


def counts(reports: Iterable[SceneReport]) -> dict[Severity, int]:
    """Number of findings by severity over some scenes."""
    found = tuple(reports)
    return {severity: sum(r.count(severity) for r in found) for severity in SEVERITIES}


def summarise(scene: RawScene) -> Summary:
    """Count what is there."""
    periods = scene.periods or {}
    images = Counter(periods.values())
    tests = Counter(periods[name] for name in scene.tests or () if name in periods)
    observations = None if scene.points is None else len(scene.points.track_image)
    return Summary(
        images=None if scene.images is None else len(scene.images),
        cameras=None if scene.cameras is None else len(scene.cameras),
        points=None if scene.points is None else len(scene.points),
        observations=observations,
        image_files=len(scene.files),
        periods=tuple(_period(scene, period, images, tests) for period in scene.period_ids),
    )


def _period(
    scene: RawScene, period: int, images: Counter[int], tests: Counter[int]
) -> PeriodSummary:
    number = images[period]
    train, test = (None, None) if scene.tests is None else (number - tests[period], tests[period])
    looked_at = "reprojections" in vars(scene) and scene.reprojections is not None
    error = scene.period_errors.get(period) if looked_at else None
    return PeriodSummary(period, number, train, test, error)
