"""Whether the reader takes a scene, without reading its millions of observations a second time.

The rules on points and tracks check what the reader asks of them. What is left is COLMAP's own
opinion on cameras, rigs, frames, names and poses, and the small text files: these are given to the
reader as they are, in a temporary folder, with a binary model whose keypoints and points are left
out.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from chronoscene.colmap.raw_model import RawModel
from chronoscene.colmap.write import write_without_observations
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as our_format

TEXTS = (our_format.SPLIT, our_format.TEST, our_format.PERIODS, our_format.WORLD)


def reader_complaint(root: Path, model: RawModel) -> ChronoSceneError | None:
    """What the reader says against a scene, with places relative to its folder."""
    if set(model.files.values()) != {"cameras.bin", "images.bin", "points3D.bin"}:
        return _complaint(root)  # text is small
    assert model.images is not None
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
        skeleton = Path(temporary)
        folder = skeleton / our_format.MODEL
        folder.mkdir(parents=True)
        for place in TEXTS:
            if (root / place).is_file():
                shutil.copyfile(root / place, skeleton / place)
        images = model.images
        posed = zip(
            images.ids.tolist(),
            images.quaternions.tolist(),
            images.translations.tolist(),
            images.camera_ids.tolist(),
            (name.encode("utf-8", "surrogateescape") for name in images.names),
            strict=True,
        )
        write_without_observations(root / our_format.MODEL, posed, folder)
        return _complaint(skeleton)


def _complaint(root: Path) -> ChronoSceneError | None:
    try:
        our_format.read(root)
    except ChronoSceneError as error:
        top = os.path.join(root, "")
        place = error.place.removeprefix(top) if error.place.startswith(top) else "scene"
        return type(error)(place, expected=error.expected, found=error.found, todo=error.todo)
    return None
