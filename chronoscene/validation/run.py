"""Run the rules on scenes."""

from __future__ import annotations

import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from chronoscene import formats
from chronoscene.colmap.raw_model import find_model, model_files
from chronoscene.convert import remarks_on, unread_tests
from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.formats import DetectedFormat
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared.colmap_layout import Assigned
from chronoscene.images.masks import mask_place
from chronoscene.images.store import place_image
from chronoscene.io.wording import printable
from chronoscene.validation.checks.reprojection import period_errors
from chronoscene.validation.folder.scene_folder import Origin, RawScene, Track, no_progress
from chronoscene.validation.rule import (
    SEVERITIES,
    Finding,
    Hit,
    PeriodSummary,
    Rule,
    SceneReport,
    Skipped,
    Summary,
)
from chronoscene.validation.rules import all_rules
from chronoscene.validation.rules.cs0_folder import RULES_ON_ORIGINS
from chronoscene.validation.rules.cs3_split import SPLIT_ELSEWHERE

RULE_FAILED = "CS000"
"""Code of the finding that a rule itself failed: a bug of ours, reported as such."""

RELEASED_CODE = "CS7"  # Codes of the rules on what the released ChronoGS code reads


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of a user on how to read scenes."""

    format: str | None = None
    """Name of the format; None to detect it."""
    period_by: str | None = None
    """Rule by which images are grouped into periods, where the format leaves a choice."""


DETECT = ReadOptions()


def find_folders(path: Path) -> list[Path]:
    """The folder itself if it looks like a scene, else its subfolders that do, sorted.

    A folder looks like a scene if it has ``sparse/`` or ``images/``, a model where programs leave
    it, or the files of another format.

    Raises:
        SceneError: If nothing looks like a scene.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise SceneError(path, expected="a scene folder", found=found, todo="check the path")
    try:
        children = sorted(p for p in path.iterdir() if p.is_dir())
        if _looks_like_scene(path):
            return [path]
        inside = [child for child in children if _looks_like_scene(child)]
    except OSError as error:
        found = error.strerror or "an error"
        todo = "check the permissions"
        raise SceneError(path, expected="a folder", found=found, todo=todo) from error
    if inside:
        return inside
    found, todo = "neither", "give the folder of one scene; DATASET.md describes its files"
    if project := formats.project_above(path):
        found, todo = "a part of one", f"give the folder of the whole project, {project}"
    expected = "a scene (a folder with images/ and sparse/) or a folder of scenes"
    raise SceneError(path, expected=expected, found=found, todo=todo)


def _looks_like_scene(path: Path) -> bool:
    if (path / "images").is_dir():
        return True
    if formats.project_above(path) is not None:
        return False  # a part of it
    ours = (path / "sparse").is_dir() or bool(model_files(path)) or find_model(path) is not None
    return ours or other_format(path) is not None


def other_format(path: Path, options: ReadOptions = DETECT) -> DetectedFormat | None:
    """Detect the format of a folder that is not in the ChronoScene format, not even with faults.

    A ``split.txt`` in a wrong place shows that it is meant to be. Of several formats the first is
    returned: reading the scene reports that there are several.

    Raises:
        ConfigError: If periods are to be chosen, and it is in the ChronoScene format.
    """
    if options.format == our_format.NAME or (options.format is None and our_format.matches(path)):
        _ = DetectedFormat(path, our_format.NAME, period_by=options.period_by).options  # raises
        return None
    if options.format is not None:
        return formats.detect(path, format=options.format, period_by=options.period_by)
    if any((path / place).is_file() for place in SPLIT_ELSEWHERE):
        return None
    try:
        return formats.match_format(path, period_by=options.period_by)
    except OSError:
        return None


def is_project(detected: DetectedFormat) -> bool:
    """Return True if a scene is a COLMAP project that can be checked where it is."""
    model = detected.model
    return detected.is_by_names and model is not None and model[1] == "images"


def _read_project(scene: RawScene, detected: DetectedFormat) -> Origin:
    """Assign periods to the images of a COLMAP project as its format defines them."""
    try:
        detected.check_single()
        module, images = detected.module, scene.root / "images"
        assigned: Assigned = module.assign(images, scene.names, **detected.options)
    except SceneError as error:
        return Origin(detected, is_project=True, error=error)
    if not scene.names:
        return Origin(detected, is_project=True)
    remarks = () if assigned.tests is None else tuple(unread_tests(scene.root, assigned.rule))
    labelled = _with_labels(assigned, detected)
    return Origin(detected, is_project=True, remarks=remarks, assigned=labelled)


def _with_labels(assigned: Assigned, detected: DetectedFormat) -> Assigned:
    """Take labels and dates of the periods from their file, unless a rule defines the periods."""
    periods, table = assigned.grouped
    if detected.period_by is None and (detected.path / our_format.PERIODS).exists():
        with suppress(SceneError):  # which reading the scene reports
            table = our_format.read_periods(detected.path, len(table))
    return replace(assigned, grouped=(periods, table))


@contextmanager
def in_our_format(detected: DetectedFormat) -> Iterator[tuple[Path, Origin]]:
    """A temporary ChronoScene folder of the scene, or its own one if it cannot be read."""
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
        ours = Path(temporary) / "scene"
        try:
            scene = detected.read()
            our_format.write(scene, ours, image_source="none")
            (ours / "images").mkdir(exist_ok=True)
            for frame in scene.frames:
                source = scene.image_path(frame)
                if source.is_file():
                    place_image(source, ours / "images" / frame.name, "symlink")
            for name, mask in scene.masks.items():
                place_image(mask, ours / mask_place(name), "symlink")
            origin = Origin(detected, remarks=tuple(remarks_on(scene)))
        except SceneError as error:
            origin = Origin(detected, error=error)
        yield detected.path if origin.error else ours, origin


def validate_scene(
    path: Path,
    *,
    rules: Sequence[Rule] | None = None,
    decode: bool = False,
    track: Track = no_progress,
    options: ReadOptions = DETECT,
) -> SceneReport:
    """Run rules on one scene folder. Reads only; never raises for what is in the folder.

    A COLMAP project is checked where it is, a scene in another format as `chronoscene convert`
    would write it.

    Args:
        path: The scene folder.
        rules: Rules to run (see `chronoscene.validation.rules.choose_rules`); None for all.
        decode: Whether to decode all images: slower, finds damaged pixels and copied images.
        track: Shows the progress of slow parts.
        options: How to read the scene.

    Raises:
        ConfigError: If the format has no such periods.
    """
    chosen = all_rules() if rules is None else rules
    detected = other_format(path, options)
    with quiet_numbers():
        if detected is None:
            return _validate(RawScene(path, decode=decode, track=track), chosen)
        if is_project(detected):
            project = Origin(detected, is_project=True)
            scene = RawScene(path, decode=decode, track=track, origin=project)
            scene.origin = _read_project(scene, detected)
            return _validate(scene, chosen)
        with in_our_format(detected) as (root, origin):
            scene = RawScene(root, decode=decode, track=track, origin=origin)
            report = _validate(scene, chosen)
    return replace(report, name=printable(path.resolve().name), path=path)


@contextmanager
def quiet_numbers() -> Iterator[None]:
    """Without NumPy's warnings: absurd numbers are what rules look for; they compare as false."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def _validate(scene: RawScene, rules: Sequence[Rule]) -> SceneReport:
    findings: list[Finding] = []
    skipped: list[Skipped] = []
    for rule in sorted(rules, key=lambda r: (r.last, r.code)):
        try:
            reason = _reason_to_skip(rule, scene, findings)
            if reason is not None:
                skipped.append(Skipped(rule.code, reason))
                continue
            findings.extend(_finding(rule, hit) for hit in rule.hits(scene))
        except Exception as error:  # a bug of ours must not hide what other rules find
            found = printable(f"{type(error).__name__}: {error}")
            expected = "a rule that runs on every scene"
            todo = "report this bug; the scene is not at fault"
            findings.append(_failure(f"rule {rule.code}", expected, found, todo))
    try:
        summary = _summarise(scene)
    except Exception:  # the rules that need the same part report it
        summary = Summary()
    findings.sort(key=lambda f: (SEVERITIES.index(f.severity), f.code))
    skipped.sort(key=lambda s: s.code)
    return SceneReport(printable(scene.name), scene.root, summary, tuple(findings), tuple(skipped))


def _reason_to_skip(rule: Rule, scene: RawScene, findings: Sequence[Finding]) -> str | None:
    origin = scene.origin
    if origin is not None and origin.is_project:
        if rule.code.startswith(RELEASED_CODE):
            return f"the released code does not read {origin.detected.name}"
    elif origin is not None and origin.error and rule.code not in RULES_ON_ORIGINS:
        return f"the folder cannot be read as {origin.detected.name}"
    for attribute in rule.needs:
        if getattr(scene, attribute) is None:
            return scene.reason(attribute)
    if rule.last and any(f.severity == "error" for f in findings):
        return "other rules found errors"
    return None


def _finding(rule: Rule, hit: Hit) -> Finding:
    place, expected, found = map(printable, (hit.place, hit.expected, hit.found))
    remedy, also = printable(hit.remedy or rule.remedy), tuple(map(printable, hit.also))
    head = rule.code, rule.name, rule.severity
    return Finding(*head, place, expected, found, remedy, hit.count, also)


def _failure(place: str, expected: str, found: str, remedy: str) -> Finding:
    """A finding on ourselves, not on the scene."""
    return Finding(RULE_FAILED, "rule-failed", "error", place, expected, found, remedy, 1)


def lost_report(path: Path) -> SceneReport:
    """The report on a scene whose process died."""
    todo = "if memory ran out, check this scene by itself; otherwise report the bug"
    finding = _failure(".", "a scene that can be checked", "one whose checking process died", todo)
    return SceneReport(printable(path.resolve().name), path, Summary(), (finding,), ())


def _summarise(scene: RawScene) -> Summary:
    periods = scene.periods or {}
    images = Counter(periods.values())
    tests = Counter(periods[name] for name in scene.tests or () if name in periods)
    # Medians are shown, but not computed, if no rule has needed the reprojections.
    reprojected = "reprojections" in vars(scene) and scene.reprojections is not None
    medians = period_errors(scene) if reprojected else {}
    labels = _labels(scene)
    in_periods = []
    for period in scene.period_ids:
        total, test = images[period], tests[period] if scene.tests is not None else None
        train = None if test is None else total - test
        in_periods.append(
            PeriodSummary(
                period,
                images=total,
                train=train,
                test=test,
                reprojection_px=medians.get(period),
                label=labels.get(period),
            )
        )
    return Summary(
        images=None if scene.images is None else len(scene.images),
        cameras=None if scene.cameras is None else len(scene.cameras),
        points=None if scene.points is None else len(scene.points),
        observations=None if scene.points is None else len(scene.points.track_image),
        image_files=len(scene.files),
        periods=tuple(in_periods),
    )


def _labels(scene: RawScene) -> dict[int, str]:
    """Labels of the periods that are more than their ids; none if they cannot be read."""
    try:
        periods = scene.period_table()
    except ChronoSceneError:  # a rule reports it
        return {}
    return {p.id: printable(p.label) for p in periods if p.label != str(p.id)}
