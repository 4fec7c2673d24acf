"""Record of the scene and method that a run comes from (``source.json``)."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from chronoscene.bench.files.records import damaged
from chronoscene.errors import CheckpointError


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
    training_from_world: list[list[float]]
    """Similarity transform as a matrix. [4, 4]"""


def _read_source(path: Path) -> RunSource:
    try:
        return RunSource.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise CheckpointError(
            path,
            expected="the scene and method of the run",
            found="no such file: an earlier version made the run",
            todo="run bench again with --overwrite",
        ) from error
    except ValidationError as error:
        raise damaged(path, error) from error
