"""A job is one run as data, which the bench passes to a worker process as JSON."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from textwrap import shorten
from typing import Any

from pydantic import TypeAdapter

from chronoscene.errors import SceneError
from chronoscene.harness.files.predictions import safe_part
from chronoscene.harness.files.provenance import config_hash, scene_hash, scene_stamp
from chronoscene.harness.files.records import Failure
from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.plan.settings import RunSettings
from chronoscene.scene import Scene

LONGEST_NAME = 180  # Characters
MOST_BYTES = 250  # File systems allow 255; special characters take three, others up to four


@dataclass(frozen=True, slots=True)
class Job:
    """One run. Paths are absolute."""

    origin: RunOrigin
    scene: str
    scene_hash: str
    split_hash: str
    method_name: str
    strategy: str
    seed: int
    settings: RunSettings
    """The overrides are those of this method."""
    notices: list[str] = field(default_factory=list)
    scene_stamp: str = ""
    """Stamp of the files that `scene_hash` was computed from."""
    staging: str = ""
    """Folder that the worker writes; renamed to `folder` when it has ended."""
    continued_from: list[int] = field(default_factory=list)
    """Iterations of the shorter trainings that this one began with."""
    continues: str = ""
    """Folder of the last of them."""
    variant: str = ""
    """Differences from the preset, in words."""
    memory: int = 0
    """Bytes of memory that the run is expected to take."""
    photo_pixels: int = 0
    """Pixels of the largest photo that is trained on."""
    commit: str = ""
    """Commit of the code that runs it; set by the worker."""
    reports: bool = False
    """True if progress is sent to the bench, which runs several jobs at a time, and not shown."""

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Job:
        """Read what `document` gave."""
        return _adapter().validate_python(document)

    def document(self) -> dict[str, Any]:
        """Return the job as plain data for JSON."""
        document: dict[str, Any] = _adapter().dump_python(self, mode="json")
        return document

    def read_scene(self) -> Scene:
        """Read the scene of the run.

        Files are read only if their sizes or times of change differ from those of the plan, as on
        another machine.

        Raises:
            SceneError: If it cannot be read, or has changed since the run was planned.
        """
        scene = self.origin.read_scene()
        if scene_stamp(scene) != self.scene_stamp and scene_hash(scene) != self.scene_hash:
            raise SceneError(
                scene.root,
                expected="the images, masks and model for which the run was planned",
                found="changes since then",
                todo="run the same command again, which plans with the present files",
            )
        return scene

    def with_settings(self, **changes: Any) -> Job:
        """Return the job with other values of some of its `RunSettings`."""
        return replace(self, settings=replace(self.settings, **changes))

    @property
    def folder(self) -> Path:
        """Folder of the finished run."""
        name = "-".join(filter(None, (*self._names, self.variant)))
        short = f"-{config_hash({'variant': self.variant})[:8]}"
        if len(name) > LONGEST_NAME:
            name = name[:LONGEST_NAME] + short
        folder = safe_part(name)
        if len(folder.encode()) > MOST_BYTES:
            folder = safe_part(name[: LONGEST_NAME // 3] + short)
        return self.settings.runs / safe_part(self.scene) / folder / f"seed{self.seed}"

    @property
    def _names(self) -> tuple[str, ...]:
        return self.method_name, self.strategy, self.settings.preset_name

    @property
    def training(self) -> Path:
        """Folder of the checkpoints of the training while the run is not finished."""
        return self.folder.with_name(f".{self.folder.name}.training")

    @property
    def label(self) -> str:
        """The run in words."""
        names = " ".join(filter(None, (*self._names, self.variant)))
        return f"{self.scene}: {names} seed {self.seed}"

    def failure(self, reason: str) -> Failure:
        """Return the record of a run that has no result; the reason becomes one line."""
        return Failure(
            method=self.method_name,
            strategy=self.strategy,
            preset=self.settings.preset_name,
            variant=self.variant,
            scene=self.scene,
            seed=self.seed,
            reason=shorten(reason, 500, placeholder=" ..."),
        )


@cache
def _adapter() -> TypeAdapter[Job]:
    return TypeAdapter(Job)
