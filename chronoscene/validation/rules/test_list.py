"""CS32: ``sparse/0/test.txt``."""

from __future__ import annotations

import os
from collections.abc import Iterator

from chronoscene.formats.chronoscene import TEST
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene.splits import DEFAULT_RULE, NameIndex
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.split_file import meant, not_text, problem_hits, unknown_hits
from chronoscene.validation.scene_folder import RawScene

ELSEWHERE = ("test.txt", "sparse/test.txt", "images/test.txt")


@rule(
    "CS321",
    "test-absent",
    "info",
    what="There is no `sparse/0/test.txt`; the default split is used.",
    remedy="list the test images in sparse/0/test.txt, so that everybody has the same split",
    bad="a scene without `test.txt`",
)
def list_absent(scene: RawScene) -> Iterator[Hit]:
    if os.path.lexists(scene.root / TEST) or _elsewhere(scene):
        return
    size = "" if scene.tests is None else f" gives {counted(len(scene.tests), 'test view')}"
    yield Hit(TEST, "a list of test images", f"none; {DEFAULT_RULE}{size}")


@rule(
    "CS322",
    "test-misplaced",
    "warning",
    what="`test.txt` is not in `sparse/0/`, so it is not read.",
    remedy="move it to sparse/0/test.txt",
    bad="`sparse/test.txt`",
)
def list_misplaced(scene: RawScene) -> Iterator[Hit]:
    if not os.path.lexists(scene.root / TEST):
        for place in _elsewhere(scene):
            yield Hit(TEST, "the list of test images", f"{place} instead")


@rule(
    "CS323",
    "test-not-text",
    "error",
    what="`test.txt` is not a readable text file.",
    remedy="save it as UTF-8",
    bad="a `test.txt` in an old Windows encoding",
)
def list_not_text(scene: RawScene) -> Iterator[Hit]:
    return not_text(scene, TEST, scene.test_text)


@rule(
    "CS324",
    "test-unknown",
    "warning",
    what="`test.txt` names an image that is not in the model; the line has no effect, so the image "
    "that is meant may be among the training images.",
    remedy="correct the name (there are only names in test.txt, no periods), or delete the line",
    bad="`IMG_1` in `test.txt`, the image is `IMG_0001.jpg`",
    needs=("images", "test"),
)
def list_unknown(scene: RawScene) -> Iterator[Hit]:
    if not scene.names:
        return iter(())  # an error of its own
    lines = {entry.line: entry.name for entry in scene.test or ()}
    images = meant(scene, scene.test_problems, lines)
    with_period = {line: text.rsplit(maxsplit=1)[0] for line, text in lines.items()}
    images |= meant(scene, scene.test_problems, with_period)
    return unknown_hits(TEST, scene.test_problems, images)


@rule(
    "CS325",
    "test-ambiguous",
    "error",
    what="A name in `test.txt` fits several images.",
    remedy="write the full names below images/",
    bad="`0001` with `x/0001.png` and `y/0001.png` in the model",
    needs=("images", "test"),
)
def list_ambiguous(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(TEST, scene.test_problems, "ambiguous")


@rule(
    "CS326",
    "test-duplicate",
    "info",
    what="`test.txt` names an image twice.",
    remedy="delete one of the lines",
    bad="`a.jpg` twice; `a.jpg` and `a`",
    needs=("test",),
)
def list_duplicate(scene: RawScene) -> Iterator[Hit]:
    index = NameIndex(scene.names)
    written: dict[str, list[str]] = {}
    for entry in scene.test or ():
        images = index.find(entry.name)
        written.setdefault(images[0] if len(images) == 1 else entry.name, []).append(entry.name)
    for name, forms in written.items():
        if len(forms) > 1:
            also = f", as {shown(sorted(set(forms)))}" if len(set(forms)) > 1 else ""
            yield Hit(TEST, "each name once", f"{quote(name)} {len(forms)} times{also}")


def _elsewhere(scene: RawScene) -> list[str]:
    return [place for place in ELSEWHERE if (scene.root / place).is_file()]
