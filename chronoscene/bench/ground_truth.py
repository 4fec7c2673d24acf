"""The test photos at evaluation resolution, frozen once per scene beside the runs."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from chronoscene.bench.image_store import ImageWriter, Manifest, read_manifest, safe_name
from chronoscene.bench.results import GROUND_TRUTH
from chronoscene.errors import ConfigError
from chronoscene.images.store import ImageStore
from chronoscene.scene import Scene


def ground_truth_folder(runs: Path, scene: str) -> Path:
    """Where the ground truth of a scene lies."""
    return runs / GROUND_TRUTH / safe_name(scene)


def freeze_ground_truth(
    runs: Path, scene: Scene, scene_hash: str, store: ImageStore, max_width: int
) -> Manifest:
    """Write the test photos once; later calls only check that they are of the same scene and size.

    Raises:
        ConfigError: If the folder of runs holds another scene of this name, or another size.
    """
    folder = ground_truth_folder(runs, scene.name)
    details = {"max_width": max_width}
    if not folder.exists():
        _write(folder, scene, scene_hash, store, details)
    manifest = read_manifest(folder)
    if manifest.scene_hash != scene_hash:
        raise _conflict(folder, "the same scene", "another scene of this name, or other photos")
    if manifest.details.get("max_width") != max_width:
        found = f"--max-width {manifest.details.get('max_width')}"
        raise _conflict(folder, f"--max-width {max_width}", found)
    return manifest


def _write(
    folder: Path, scene: Scene, scene_hash: str, store: ImageStore, details: dict[str, int]
) -> None:
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        writer = ImageWriter(partial)
        for frame in scene.select(split="test"):
            writer.add(
                frame.name,
                store.load(frame),
                camera_period=frame.period,
                rendered_period=frame.period,
            )
        writer.close(kind="ground truth", scene=scene.name, scene_hash=scene_hash, details=details)
        if not folder.exists():  # a bench beside this one may have been quicker
            os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _conflict(folder: Path, expected: str, found: str) -> ConfigError:
    return ConfigError(
        folder, expected=expected, found=found, todo="choose another folder with --out"
    )
