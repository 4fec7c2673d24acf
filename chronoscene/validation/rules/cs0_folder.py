"""CS0: the folder as a whole, folders in other formats, and the reader's last word."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from chronoscene.colmap.model import Model, read_poses
from chronoscene.colmap.raw_model import RawImages, RawModel, model_kind, numbered_models
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.io.wording import shown
from chronoscene.scene import Points
from chronoscene.validation import rule
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

RULES_ON_ORIGINS = ("CS006", "CS007")
"""Codes of the rules that run on folders in other formats even if they cannot be read."""


@rule.error(
    "CS001", bad="photos in `photos/`", remedy="put the images into images/ in the scene folder"
)
def no_images_folder(scene: RawScene) -> Iterator[Hit]:
    """There is no `images/` folder."""
    if not (scene.root / "images").is_dir():
        inside = sorted(p.name for p in scene.root.iterdir() if p.is_dir())
        found = f"the folders {shown(inside, 5)}" if inside else "no folder at all"
        yield Hit("images", "a folder with the images", found)


@rule.error(
    "CS002",
    bad="`sparse/cameras.bin`, as written by COLMAP's undistorter",
    remedy="move the model files to sparse/0/",
)
def model_misplaced(scene: RawScene) -> Iterator[Hit]:
    """The COLMAP model is not in `sparse/0/`, where readers look for it."""
    place = scene.model_place
    if place is not None and place != our_format.MODEL and not scene.is_project:
        found = f"a model in {place}/" if place else "a model at the top of the folder"
        remedy = None
        if scene.model_images != "images":
            found += f", of the images in {scene.model_images}/"
            remedy = "move the model files to sparse/0/, and these images to images/"
        yield Hit(our_format.MODEL, "the COLMAP model", found, remedy)


@rule.warning(
    "CS003",
    bad="`sparse/0/` and `sparse/1/`, each with one period",
    remedy="match images across the models and run the mapper again, or delete the models that "
    "are not needed",
)
def several_models(scene: RawScene) -> Iterator[Hit]:
    """COLMAP built several models that it could not merge; only `sparse/0/` is read."""
    place = scene.model_place
    numbered = (f"sparse/{folder.name}" for folder in numbered_models(scene.root / "sparse"))
    others = [name for name in numbered if name not in (place, our_format.MODEL)]
    if others:
        yield Hit("sparse", f"a single model, {place}", f"also {shown(others)}", count=len(others))


@rule.error(
    "CS004",
    bad='`[{"id": 1}]` in a scene with two periods',
    remedy="correct the file, or delete it: it only holds labels and dates",
    needs=("periods",),
)
def bad_periods_json(scene: RawScene) -> Iterator[Hit]:
    """`sparse/periods.json` is invalid."""
    ids = scene.period_ids
    if scene.is_project or ids != list(range(len(ids))):
        return  # has its own rule
    if len(scene.periods or ()) < len(scene.names):
        return  # a period may be missing, which has its own rule
    try:
        our_format.read_periods(scene.root, len(ids))
    except ChronoSceneError as error:
        yield _relative_hit(scene.root, error, our_format.PERIODS)


@rule.error("CS005", bad='`{"unit": "feet"}`', remedy="correct the file, or delete it")
def bad_world_json(scene: RawScene) -> Iterator[Hit]:
    """`sparse/world.json` is invalid."""
    try:
        our_format.read_world(scene.root)
    except ChronoSceneError as error:
        yield _relative_hit(scene.root, error, our_format.WORLD)


@rule.info(
    "CS006",
    bad="`transforms.json` of nerfstudio",
    remedy="nothing to do; `chronoscene convert DIR OUT` converts it for other tools",
)
def other_format(scene: RawScene) -> Iterator[Hit]:
    """The folder is in another format. It is checked as `chronoscene convert` would write it, and
    places refer to the converted scene. A COLMAP project is checked where it is."""
    origin = scene.origin
    if origin is not None and origin.error is None:
        found = f"a scene in {origin.detected.name}"
        if origin.assigned is not None:
            found += f", with the periods {shown(p.label for p in origin.assigned.grouped[1])}"
        found = "; ".join([found, *origin.detected.notes])
        yield Hit(".", "a scene in the ChronoScene format", found)


@rule.error("CS007", bad="a `transforms.json` without poses", remedy="correct the file named here")
def other_format_unreadable(scene: RawScene) -> Iterator[Hit]:
    """The folder is in another format, but cannot be read as such."""
    if scene.origin is not None and scene.origin.error is not None:
        yield _relative_hit(scene.root, scene.origin.error, ".")


@rule.warning(
    "CS008",
    bad="frames in `transforms.json` whose image is missing",
    remedy="nothing to do if this is intended; otherwise add what is missing",
)
def other_format_left_out(scene: RawScene) -> Iterator[Hit]:
    """Part of a folder in another format is left out by the conversion."""
    for remark in scene.origin.remarks if scene.origin is not None else ():
        yield Hit(".", "a folder that can be converted completely", remark)


@rule.error(
    "CS009",
    bad="a model that COLMAP cannot open although its records are complete",
    remedy="follow the message; if it makes no sense, report it",
    needs=("cameras", "points"),
    last=True,
)
def reader_refuses(scene: RawScene, model: RawModel, images: RawImages) -> Iterator[Hit]:
    """No other rule found an error, but the reader (or COLMAP itself) rejects the scene."""
    try:
        if scene.origin is not None and scene.origin.is_project:
            scene.origin.detected.read()
        elif model_kind(model.folder) == "binary":  # the rules have checked points and tracks
            posed = read_poses(scene.root / our_format.MODEL, images)
            our_format.read(scene.root, model=Model(posed, Points.empty()))
        else:
            our_format.read(scene.root)
    except ChronoSceneError as error:
        yield _relative_hit(scene.root, error, "scene")


def _relative_hit(root: Path, error: ChronoSceneError, place: str) -> Hit:
    """An error as a hit, with its place relative to the scene folder if it is inside."""
    top = os.path.join(root, "")
    where = place if error.place == str(root) else error.place.removeprefix(top)
    return Hit(where, error.expected, error.found, error.todo)
