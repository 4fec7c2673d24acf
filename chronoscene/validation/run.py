"""Run the rules on scenes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronoscene.colmap.raw_model import model_files
from chronoscene.errors import SceneError
from chronoscene.io.wording import printable
from chronoscene.validation.finding import SEVERITIES, Finding, Hit
from chronoscene.validation.other_formats import in_our_format, other_format
from chronoscene.validation.report.report import SceneReport, Skipped, Summary, summarise
from chronoscene.validation.rule import Rule
from chronoscene.validation.rules import all_rules
from chronoscene.validation.rules.foreign_folder import OF_ORIGINS
from chronoscene.validation.scene_folder import RawScene, Track, no_progress

RULE_FAILED = "CS000"
"""Code of the finding that a rule itself failed: our mistake, reported as such."""


NOTHING_KNOWN = Summary(None, None, None, None, 0, ())


def find_folders(path: Path) -> list[Path]:
    """The folder itself if it looks like a scene, else the folders in it that do, sorted.

    Looking like a scene is not much: it has ``sparse/`` or ``images/``, or files of a model, or the
    marks of another format.

    Raises:
        SceneError: If there is nothing that looks like a scene.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise SceneError(path, expected="a scene folder", found=found, todo="check the path")
    try:
        children = sorted(p for p in path.iterdir() if p.is_dir())
        if _like_scene(path):
            return [path]
        inside = [child for child in children if _like_scene(child)]
    except OSError as error:
        found = error.strerror or "an error"
        raise SceneError(path, expected="a folder", found=found, todo="check the rights") from error
    if inside:
        return inside
    raise SceneError(
        path,
        expected="a scene (a folder with images/ and sparse/) or a folder of scenes",
        found="neither",
        todo="give the folder of one scene; DATASET.md describes its files",
    )


def _like_scene(path: Path) -> bool:
    ours = any((path / name).is_dir() for name in ("sparse", "images")) or bool(model_files(path))
    return ours or other_format(path) is not None


def validate_scene(
    path: Path,
    *,
    rules: Sequence[Rule] | None = None,
    decode: bool = False,
    track: Track = no_progress,
) -> SceneReport:
    """Run rules on one scene folder. Reads only; never raises for what is in the folder.

    A scene of another format is checked as `chronoscene convert` would write it.

    Args:
        path: The scene folder.
        rules: Rules to run (see `chronoscene.validation.rule.choose_rules`); None for all.
        decode: Whether to decode all images: slower, finds damaged pixels and copied images.
        track: Shows the progress of what takes long.
    """
    chosen = all_rules() if rules is None else rules
    with quiet_numbers(), in_our_format(Path(path)) as (root, origin):
        scene = RawScene(root, decode=decode, track=track, origin=origin)
        report = _validate(scene, chosen)
    if origin is None:
        return report
    return replace(report, name=printable(Path(path).resolve().name), path=Path(path))


@contextmanager
def quiet_numbers() -> Iterator[None]:
    """Without numpy's warnings: absurd numbers are what is looked for, and compare as false."""
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
            findings.extend(_finding(rule, hit) for hit in rule.check(scene))
        except Exception as error:  # a mistake of ours must not hide what other rules find
            findings.append(_failure(rule, error))
    findings.sort(key=lambda f: (SEVERITIES.index(f.severity), f.code))
    return SceneReport(
        name=printable(scene.name),
        path=scene.root,
        summary=_summary(scene),
        findings=tuple(findings),
        skipped=tuple(sorted(skipped, key=lambda s: s.code)),
    )


def _reason_to_skip(rule: Rule, scene: RawScene, findings: Sequence[Finding]) -> str | None:
    if scene.origin is not None and scene.origin.error is not None and rule.code not in OF_ORIGINS:
        return f"it cannot be read as {scene.origin.format}"
    for attribute in rule.needs:
        if getattr(scene, attribute) is None:
            return scene.reason(attribute)
    if rule.last and any(f.severity == "error" for f in findings):
        return "other rules found errors"
    return None


def _failure(rule: Rule, error: Exception) -> Finding:
    hit = Hit(
        f"rule {rule.code}",
        "a rule that runs on every scene",
        f"{type(error).__name__}: {error}",
        "report this; it is a mistake in ChronoScene, not in the scene",
    )
    failed = replace(rule, code=RULE_FAILED, name="rule-failed", severity="error")
    return _finding(failed, hit)


def _summary(scene: RawScene) -> Summary:
    try:
        return summarise(scene)
    except Exception:  # the rules that need the same part have said so
        return NOTHING_KNOWN


def lost_report(path: Path) -> SceneReport:
    """The report on a scene whose check ended with its process."""
    finding = Finding(
        code=RULE_FAILED,
        name="rule-failed",
        severity="error",
        place=".",
        expected="a scene that can be checked",
        found="one whose check died with its process",
        remedy="if memory ran out, check this scene by itself; else report this",
        count=1,
    )
    name = printable(path.resolve().name)
    return SceneReport(name, path, NOTHING_KNOWN, findings=(finding,), skipped=())


def _finding(rule: Rule, hit: Hit) -> Finding:
    return Finding(
        code=rule.code,
        name=rule.name,
        severity=rule.severity,
        place=printable(hit.place),
        expected=printable(hit.expected),
        found=printable(hit.found),
        remedy=printable(hit.remedy or rule.remedy),
        count=hit.count,
        also=tuple(map(printable, hit.also)),
    )
