"""Record of the scene and method that a run comes from (``source.json``)."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from chronoscene.formats import DetectedFormat
from chronoscene.harness.files.records import SOURCE_FILE, read_document
from chronoscene.scene import Scene


class RunSource(BaseModel):
    """Method and scene of a run, which are needed to use its files again."""

    model_config = ConfigDict(extra="forbid")

    method: str
    """Argument of `load_spec`: a name or ``module:SPEC``."""
    plugin_path: str | None
    """Folder from which ``module:SPEC`` was imported."""
    scene_root: str
    scene_format: str
    period_by: str | None = None
    """Argument of `read_scene`."""
    validation: bool = False
    """Argument of `read_bench_scene`."""
    training_from_world: list[list[float]]
    """Similarity transform as a matrix. [4, 4]"""


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


def read_bench_scene(found: DetectedFormat, *, validation: bool) -> Scene:
    """Read a scene as runs have it: bench, its workers, and whoever opens a run later.

    Args:
        found: Folder of the scene, with its format.
        validation: True for the training views alone, some of which are test views.

    Raises:
        SceneError: If the scene cannot be read, or has too few views for validation.
    """
    scene = found.read()
    if validation:
        from chronoscene.scene.split_making import hold_out_validation  # scipy takes time to load

        return hold_out_validation(scene)
    return scene
