"""Scene and method that a run comes from (``source.json``)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeInt

from chronoscene.formats import DetectedFormat, detect
from chronoscene.harness.files.records import SOURCE_FILE, read_document
from chronoscene.images.store import resize_camera
from chronoscene.io.staging import write_text_atomic
from chronoscene.scene import Scene
from chronoscene.scene.similarity import Sim3


class RunOrigin(BaseModel):
    """Method and scene of a run as it is planned."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: str
    """Argument of `load_spec`: a name or ``module:SPEC``."""
    plugin_path: str | None = None
    """Folder from which ``module:SPEC`` is imported."""
    scene_root: str
    scene_format: str
    """Name in `chronoscene.formats`."""
    period_by: str | None = None
    """Rule by which the images are grouped into periods, as for `read_scene`."""
    validation: bool = False
    """Argument of `read_bench_scene`, as the next two."""
    validation_seed: NonNegativeInt = 0
    shrink: int = 1

    def read_scene(self, root: Path | None = None) -> Scene:
        """Read the scene, from ``root`` if it has moved.

        Raises:
            SceneError: If it cannot be read.
        """
        place = root or Path(self.scene_root)
        found = detect(place, format=self.scene_format, period_by=self.period_by)
        return read_bench_scene(
            found,
            validation=self.validation,
            validation_seed=self.validation_seed,
            shrink=self.shrink,
        )


class RunSource(RunOrigin):
    """Method and scene of a run, which are needed to use its files again."""

    training_from_world: list[list[float]]
    """Similarity transform as a matrix. [4, 4]"""


def write_source(folder: Path, origin: RunOrigin, training_from_world: Sim3) -> None:
    """Write ``source.json`` of a run into its folder."""
    matrix = training_from_world.to_matrix().tolist()
    source = RunSource(**origin.model_dump(), training_from_world=matrix)
    write_text_atomic(folder / SOURCE_FILE, source.model_dump_json(indent=1) + "\n")


def read_source(folder: Path) -> RunSource:
    """Read ``source.json`` of a run.

    Raises:
        CheckpointError: If it is missing or damaged.
    """
    return read_document(
        folder / SOURCE_FILE,
        RunSource,
        expected="the scene and method of the run",
        found="no such file: an earlier version made the run",
        todo="run bench again with --overwrite",
    )


def read_bench_scene(
    found: DetectedFormat, *, validation: bool, validation_seed: int = 0, shrink: int = 1
) -> Scene:
    """Read a scene as runs use it: in bench, in its workers, and when a run is opened later.

    Args:
        found: Folder of the scene, with its format.
        validation: True for the training views alone, some of which are test views.
        validation_seed: Of the choice of these.
        shrink: Divisor of the width and height of all images.

    Raises:
        SceneError: If the scene cannot be read, or has too few views for validation.
    """
    scene = found.read()
    if shrink > 1:
        scene = _shrunk(scene, shrink)
    if validation:
        from chronoscene.scene.split_making import hold_out_validation  # scipy takes time to load

        return hold_out_validation(scene, validation_seed)
    return scene


def _shrunk(scene: Scene, divisor: int) -> Scene:
    """Scale the cameras of a scene down; images follow when they are read."""
    old = [frame.camera for frame in scene.frames]
    new = [resize_camera(c, *(max(1, size // divisor) for size in c.size)) for c in old]
    pairs = zip(scene.frames, new, strict=True)
    scales = np.array([c.size for c in new]) / np.array([c.size for c in old])
    points = scene.points
    track_xy = points.track_xy * scales[points.track_frame]
    return replace(
        scene.with_frames([replace(frame, camera=camera) for frame, camera in pairs]),
        points=replace(points, track_xy=track_xy),
    )
