"""CS0: the folder as a whole."""

from __future__ import annotations

import os
from collections.abc import Iterator

from chronoscene.colmap.model import Model, read_poses
from chronoscene.colmap.raw_model import model_kind, numbered_models
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.io.wording import shown
from chronoscene.scene import Points
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene


@rule(
    "CS001",
    "no-images-folder",
    "error",
    what="There is no folder `images/`.",
    remedy="put the images into images/, below the scene folder",
    bad="photos in `photos/`",
)
def no_images_folder(scene: RawScene) -> Iterator[Hit]:
    if not (scene.root / "images").is_dir():
        inside = sorted(p.name for p in scene.root.iterdir() if p.is_dir())
        found = f"the folders {shown(inside, 5)}" if inside else "no folder at all"
        yield Hit("images", "a folder with the images", found)


@rule(
    "CS002",
    "model-misplaced",
    "error",
    what="The COLMAP model is not in `sparse/0/`, where all readers look for it.",
    remedy="move the model files to sparse/0/",
    bad="`sparse/cameras.bin`, as COLMAP's undistorter writes it",
)
def model_misplaced(scene: RawScene) -> Iterator[Hit]:
    place = scene.model_place
    if place is not None and place != our_format.MODEL:
        found = f"one in {place}/" if place else "one at the top of the folder"
        yield Hit(our_format.MODEL, "the model", found)


@rule(
    "CS003",
    "several-models",
    "warning",
    what="COLMAP made several models that it could not join; only `sparse/0/` is read.",
    remedy="match images across the models and map again, or delete the models that are not meant",
    bad="`sparse/0/` and `sparse/1/`, a period in each",
)
def several_models(scene: RawScene) -> Iterator[Hit]:
    place = scene.model_place
    others = [
        f"sparse/{folder.name}"
        for folder in numbered_models(scene.root)
        if f"sparse/{folder.name}" not in (place, our_format.MODEL)
    ]
    if others:
        yield Hit("sparse", f"one model, {place}", f"{shown(others)} too", count=len(others))


@rule(
    "CS004",
    "bad-periods-json",
    "error",
    what="`sparse/periods.json` is there and is not right.",
    remedy="correct the file, or delete it: it only gives labels",
    bad='`[{"id": 1}]` in a scene of two periods',
    needs=("periods",),
)
def bad_periods_json(scene: RawScene) -> Iterator[Hit]:
    ids = scene.period_ids
    if ids != list(range(len(ids))):
        return  # they have their own rule
    if len(scene.periods or ()) < len(scene.names):
        return  # some period may be missing, which is reported
    try:
        our_format.read_periods(scene.root, len(ids))
    except ChronoSceneError as error:
        yield relative_hit(scene, error, our_format.PERIODS)


@rule(
    "CS005",
    "bad-world-json",
    "error",
    what="`sparse/world.json` is there and is not right.",
    remedy="correct the file, or delete it",
    bad='`{"unit": "feet"}`',
)
def bad_world_json(scene: RawScene) -> Iterator[Hit]:
    try:
        our_format.read_world(scene.root)
    except ChronoSceneError as error:
        yield relative_hit(scene, error, our_format.WORLD)


@rule(
    "CS009",
    "reader-refuses",
    "error",
    what="Nothing else is wrong, but the reader (or COLMAP itself) refuses the scene.",
    remedy="do as the message says; if it makes no sense to you, report it",
    bad="a model that COLMAP does not open although its records are complete",
    needs=("cameras", "images", "points"),
    last=True,
)
def reader_refuses(scene: RawScene) -> Iterator[Hit]:
    model = scene.model
    assert model is not None and model.images is not None
    try:
        if model_kind(model.folder) == "binary":  # the rules checked points and tracks already
            images = read_poses(scene.root / our_format.MODEL, model.images)
            our_format.read(scene.root, model=Model(images, Points.empty()))
        else:
            our_format.read(scene.root)
    except ChronoSceneError as error:
        yield relative_hit(scene, error, "scene")


def relative_hit(scene: RawScene, error: ChronoSceneError, place: str) -> Hit:
    """The same message with a place relative to the scene folder."""
    root = os.path.join(scene.root, "")
    where = error.place.removeprefix(root) if error.place.startswith(root) else place
    return Hit(where, error.expected, error.found, error.todo)
