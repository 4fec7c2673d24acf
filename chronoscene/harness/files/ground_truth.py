"""Ground truth of the test views, frozen once for all runs of a folder."""

from __future__ import annotations

import os
import shutil
from glob import escape
from pathlib import Path

from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import ImageWriter, Manifest, read_manifest, safe_part
from chronoscene.harness.files.records import GROUND_TRUTH
from chronoscene.images.decoding import load_photo
from chronoscene.images.store import evaluation_size
from chronoscene.io.staging import needing_space, partial_name, remove_abandoned
from chronoscene.scene import Scene


def ground_truth_folder(runs: Path, scene: str) -> Path:
    """Return the folder of the ground truth of a scene."""
    return runs / GROUND_TRUTH / safe_part(scene)


def truth_of(run: Path) -> Path:
    """Return the folder of the ground truth of a run, by its folder."""
    return run.parents[2] / GROUND_TRUTH / run.parents[1].name


def freeze_ground_truth(runs: Path, scene: Scene, scene_hash: str, max_width: int) -> Manifest:
    """Write the test photos once; later calls only check that scene and size are the same.

    Raises:
        ConfigError: If the folder of runs holds another scene of this name, or another size.
    """
    folder = ground_truth_folder(runs, scene.name)
    if not folder.exists():
        _write_ground_truth(folder, scene, scene_hash, max_width)
    manifest = read_manifest(folder)
    if manifest.scene_hash != scene_hash:
        found = "another scene of this name, another split of it, or other photos"
        raise _conflict(folder, "the same scene", found)
    if manifest.details.get("max_width") != max_width:
        found = f"--max-width {manifest.details.get('max_width')}"
        raise _conflict(folder, f"--max-width {max_width}", found)
    return manifest


def _write_ground_truth(folder: Path, scene: Scene, scene_hash: str, max_width: int) -> None:
    remove_abandoned(folder.parent, escape(folder.name))
    partial = folder.with_name(partial_name(folder.name))
    try:
        with needing_space(folder):
            writer = ImageWriter(partial)
            for frame in scene.select(split="test"):
                size = evaluation_size(*frame.camera.size, max_width)
                file, mask_file = scene.image_path(frame), scene.masks.get(frame.name)
                image, mask = load_photo(file, mask_file, size=size)
                period = frame.period
                writer.add(
                    frame.name, image, camera_period=period, rendered_period=period, mask=mask
                )
            writer.close(
                kind="ground truth",
                scene=scene.name,
                scene_hash=scene_hash,
                details={"max_width": max_width},
            )
        try:
            os.replace(partial, folder)
        except OSError:
            if not folder.is_dir():  # else another bench has written it meanwhile
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _conflict(folder: Path, expected: str, found: str) -> ConfigError:
    return ConfigError(
        folder, expected=expected, found=found, todo="choose another folder with --out"
    )
