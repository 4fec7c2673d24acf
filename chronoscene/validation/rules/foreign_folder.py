"""CS006 to CS008: folders of other formats."""

from __future__ import annotations

from collections.abc import Iterator

from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.folder import relative_hit
from chronoscene.validation.scene_folder import RawScene


@rule(
    "CS006",
    "other-format",
    "info",
    what="The folder is of another format. It is checked as `chronoscene convert` writes it, and "
    "places are those of the converted scene.",
    remedy="nothing to do; `chronoscene convert DIR OUT` makes a scene of it for other tools",
    bad="`transforms.json` of nerfstudio",
)
def other_format(scene: RawScene) -> Iterator[Hit]:
    if scene.origin is not None and scene.origin.error is None:
        yield Hit(".", "a scene in the ChronoScene format", f"one in {scene.origin.format}")


@rule(
    "CS007",
    "other-format-unreadable",
    "error",
    what="The folder is of another format, and cannot be read as such.",
    remedy="correct the file that is named",
    bad="a `transforms.json` without poses",
)
def other_format_unreadable(scene: RawScene) -> Iterator[Hit]:
    if scene.origin is not None and scene.origin.error is not None:
        yield relative_hit(scene, scene.origin.error, ".")


@rule(
    "CS008",
    "other-format-left-out",
    "warning",
    what="A folder of another format has something that does not become part of the scene.",
    remedy="nothing to do if that is meant; else add what is missing",
    bad="frames in `transforms.json` whose image is missing",
)
def other_format_left_out(scene: RawScene) -> Iterator[Hit]:
    for remark in scene.origin.remarks if scene.origin is not None else ():
        yield Hit(".", "a folder that becomes a scene as a whole", remark)


OF_ORIGINS = ("CS006", "CS007")
"""Codes of the rules on folders of other formats."""
