"""Regions of test views that are scored apart: changed between periods, and invariant.

The masks are frozen beside the photos of the ground truth, so that earlier and later runs are
scored by the same regions.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from chronoscene.arrays import Mask
from chronoscene.errors import ConfigError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import (
    ImageEntry,
    Manifest,
    image_file,
    load_changed,
    load_mask,
    read_manifest,
    safe_part,
    to_grey,
    write_manifest,
    write_png,
)
from chronoscene.harness.files.records import read_run, run_folders
from chronoscene.images.truth import changed_at_all, check_distinct, truth_place

ALL, CHANGED, INVARIANT = REGIONS = ("all", "changed", "invariant")


def left_half(height: int, width: int) -> Mask:
    """Return the pixels of the left half of an image. [H, W]"""
    return np.broadcast_to(np.arange(width) < width // 2, (height, width))


def scored_mask(folder: Path, entry: ImageEntry, fitted: str = "") -> Mask | None:
    """Return the pixels of a view that are scored; None for all of them. [H, W]

    The mask of the photo ignores the others, or an appearance was fitted to them
    (`RunRecord.fitted`).
    """
    mask = load_mask(folder, entry)
    if not fitted:
        return mask
    right = ~left_half(entry.height, entry.width)
    return right if mask is None else mask & right


def regions_of(
    folder: Path, entry: ImageEntry, fitted: str = ""
) -> Iterator[tuple[str, Mask | None]]:
    """Yield names and masks of the regions of a view; None for all pixels. [H, W]

    A pixel is *changed* if it differs from at least one other period, and *invariant* if it is the
    same in all of them. Pixels that are not scored (`scored_mask`) are in no region.
    """
    mask, changed = scored_mask(folder, entry, fitted), load_changed(folder, entry)
    yield ALL, mask
    if changed is not None:
        counted = True if mask is None else mask
        yield CHANGED, changed & counted
        yield INVARIANT, ~changed & counted


def change_masks_hash(truth: Manifest) -> str | None:
    """Fingerprint of the change masks of the ground truth; None if there are none."""
    found = [[e.view, e.changed_sha256] for e in truth.images if e.changed_sha256]
    return hashlib.sha256(json.dumps(found).encode()).hexdigest() if found else None


def freeze_change_masks(runs: Path, truth: Path) -> None:
    """Put the change masks of test views beside their photos, in place of earlier ones.

    Args:
        runs: Folder that bench wrote.
        truth: Folder laid out like ``gt/`` of a generated scene; or a folder of scenes, each with
            such a folder.

    Raises:
        ConfigError: If no test view has masks.
        ImageError: If a mask is missing or damaged, or of another size than its photo.
        CheckpointError: If the ground truth is damaged.
    """
    periods = {}
    for folder in run_folders(runs):
        record = read_run(folder)
        periods[record.scene] = [int(period) for period in record.period_labels]
    found = False
    for scene, ids in periods.items():
        place = truth / safe_part(scene) / "gt"
        if place.is_dir() or len(periods) == 1:
            found |= _freeze(
                ground_truth_folder(runs, scene), place if place.is_dir() else truth, ids
            )
    if not found:
        raise ConfigError(
            f"--truth {truth}",
            expected=f"change masks of test views, such as {truth_place('change', 'a/x.jpg', 1)}",
            found="none",
            todo="name the folder in which change/ is; DATASET.md describes it",
        )


def _freeze(frozen: Path, truth: Path, periods: list[int]) -> bool:
    """Freeze the masks of one scene; return True if there are any."""
    manifest, entries = read_manifest(frozen), []
    check_distinct(truth, (entry.view for entry in manifest.images))
    for entry in manifest.images:
        others = [period for period in periods if period != entry.camera_period]
        size, max_width = (entry.width, entry.height), manifest.details["max_width"]
        changed = changed_at_all(truth, entry.view, others, size, max_width)
        file = sha256 = None
        if changed is not None:
            file = image_file(f"{entry.view}.changed")
            sha256 = write_png(frozen, file, to_grey(changed))
        update = {"changed_file": file, "changed_sha256": sha256}
        entries.append(entry.model_copy(update=update))
    manifest = manifest.model_copy(update={"images": tuple(entries)})
    if any(entry.changed_file for entry in entries):
        write_manifest(frozen, manifest)
        return True
    return False
