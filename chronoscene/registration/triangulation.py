"""Points of a scene that has poses but no points, or others than wanted."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.colmap.model import copy_poses, read_model
from chronoscene.errors import RegistrationError, SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.images.decoding import image_size
from chronoscene.images.exif import read_exif
from chronoscene.images.masks import MASKS, mask_place
from chronoscene.images.store import ImageSource, place_image, place_images
from chronoscene.io.processes import Report
from chronoscene.io.staging import sha256_of, staged_folder
from chronoscene.registration.context import EXHAUSTIVE_LIMIT, Context, Options
from chronoscene.registration.features.camera_groups import scene_groups
from chronoscene.registration.features.correspondences import extract_features
from chronoscene.registration.output import check_free
from chronoscene.registration.photos.inputs import place_photo
from chronoscene.registration.reconstruct.estimation import without_twins
from chronoscene.registration.work_folder import Stages, work_folder
from chronoscene.scene import Points, Scene

MIN_POINTS = 50
"""With fewer points, poses and photos hardly belong together."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """The result of a triangulation."""

    scene: Scene
    """The scene with its new points; its images are those of the source."""
    pairs: int
    """Pairs of images that were matched."""
    matches: int
    agreeing: int
    """Matches that agree with the poses."""


def triangulate(
    scene: Scene,
    out: Path,
    *,
    threads: int | None = None,
    image_source: ImageSource = "copy",
    model: Path | None = None,
    report: Report | None = None,
) -> Triangulated:
    """Triangulate points from SIFT features at the poses of a scene, and write it with them.

    Poses, cameras, periods, split and masks stay; points that the scene has are replaced. The
    folder ``<out>.triangulation`` has the work of a command that was stopped, which continues from
    there; it is deleted at the end.

    Args:
        scene: Any scene.
        out: Folder that does not exist yet, or is empty.
        threads: None for one per processor. With 1, every run gives bit-identical results.
        image_source: Copy or link the images.
        model: Folder of its COLMAP model, whose poses are copied to the last bit; None to write the
            matrices as quaternions.
        report: Called with the progress.

    Raises:
        RegistrationError: If there are too few points.
        SceneError: If an image is missing or has another size than its camera, or ``out`` is in
            use.
    """
    check_free(out, overwrite=False)
    if len(scene.frames) < 2:
        raise _error(scene, "two images or more", str(len(scene.frames)), "add images")
    work = Path(f"{out.resolve()}.triangulation")
    with work_folder(work) as lock:
        context = Context(work, Stages(work), Options(threads=threads), report, lock)
        names = _place(scene, context)
        _depend_on_files(scene, context)
        frames = tuple(replace(f, name=names[f.name]) for f in scene.frames)
        extract_features(scene_groups(replace(scene, frames=frames)), context)
        result = _run(replace(scene, frames=frames), context)
        new = replace(scene, points=_read_points(scene, names, work / "model-triangulated"))
        _check_result(scene, new.points, result)
        _write(new, out, image_source, model, report)
        shutil.rmtree(work)
    return Triangulated(new, result["pairs"], result["matches"], result["agreeing"])


def _place(scene: Scene, context: Context) -> dict[str, str]:
    """Place photos and masks under plain names, in the same order; return the names."""
    for folder in (context.photos, context.work / MASKS):
        shutil.rmtree(folder, ignore_errors=True)
    names = {}
    for i, frame in enumerate(scene.frames):
        path, size = scene.image_path(frame), frame.camera.size
        if not path.is_file():
            raise SceneError(path, expected="an image", found="nothing", todo="copy it there")
        if image_size(path) != size:
            found = "{} x {}".format(*image_size(path))
            raise SceneError(
                path,
                expected=f"an image of the size of its camera, {size[0]} x {size[1]}",
                found=found,
                todo="fit cameras and images to each other first: chronoscene undistort",
            )
        target = context.photos / f"{i:06}{path.suffix.lower()}"
        name = place_photo(path, target, read_exif(path)).name
        names[frame.name] = name
        if mask := scene.masks.get(frame.name):
            place_image(mask, context.work / mask_place(name), "symlink")
    return names


def _depend_on_files(scene: Scene, context: Context) -> None:
    """Make all stages depend on the content of photos and masks, which may have been corrected."""
    masks = scene.masks
    files = {
        f.name: [sha256_of(path) for path in (scene.image_path(f), masks.get(f.name)) if path]
        for f in scene.frames
    }
    context.stages.run("files", files, lambda: ({}, []))


def _run(scene: Scene, context: Context) -> Mapping[str, Any]:
    """Match and triangulate, once."""
    settings = {
        "poses": {f.name: f.cam_from_world[:3].tolist() for f in scene.frames},
        "periods": {f.name: f.period for f in scene.frames},
        "exhaustive_limit": EXHAUSTIVE_LIMIT,
    }
    places = context.places("triangulated") | {"database": str(context.database)}
    result: Mapping[str, Any] = context.stages.run(
        "triangulated", settings, lambda: (context.run_task("triangulate", settings | places), [])
    )
    return result


def _read_points(scene: Scene, names: Mapping[str, str], folder: Path) -> Points:
    """Read the points of a model over the frames of the scene."""
    found = read_model(folder)
    points = without_twins(found.points)
    row = {names[frame.name]: i for i, frame in enumerate(scene.frames)}
    frame = np.array([row[image.name] for image in found.images], np.int32)
    return replace(points, ids=np.arange(1, len(points) + 1), track_frame=frame[points.track_frame])


def _check_result(scene: Scene, points: Points, result: Mapping[str, Any]) -> None:
    if len(points) >= MIN_POINTS:
        return
    found = (
        f"{len(points)}: {result['agreeing']} of {result['matches']} matches in {result['pairs']} "
        "pairs of images agree with the poses"
    )
    few = result["agreeing"] < result["matches"] / 2
    todo = (
        "check that the poses belong to the images: chronoscene validate --decode"
        if few and result["matches"] > MIN_POINTS
        else "add images that overlap by more than half, taken from different positions"
    )
    raise _error(scene, f"at least {MIN_POINTS} points", found, todo)


def _error(scene: Scene, expected: str, found: str, todo: str) -> RegistrationError:
    return RegistrationError(scene.root, expected=expected, found=found, todo=todo)


def _write(
    scene: Scene, out: Path, image_source: ImageSource, model: Path | None, report: Report | None
) -> None:
    for frame in scene.frames:
        our_format.check_writable_name(out, frame)

    progress = None if report is None else partial(report, "images")
    with staged_folder(out) as staged:
        our_format.write_texts(scene, staged)
        if model is not None:
            copy_poses(model, staged / our_format.MODEL, scene.frames)
        place_images(scene, staged / "images", image_source=image_source, progress=progress)
