"""Images of the test views by another program: found by their names, checked, scored.

They become a run like those of bench, with the same scores; costs are absent.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import Any

from chronoscene.errors import ConfigError, ImageError, SceneError
from chronoscene.formats.shared.grouping import read_table
from chronoscene.harness.files import records
from chronoscene.harness.files.ground_truth import freeze_ground_truth, ground_truth_folder
from chronoscene.harness.files.predictions import ImageWriter, safe_part
from chronoscene.harness.files.provenance import (
    code_version,
    config_hash,
    library_versions,
    scene_hash,
)
from chronoscene.harness.plan.parts import check_scene
from chronoscene.harness.plan.scenes import check_not_among_runs
from chronoscene.harness.score.scoring import score_run
from chronoscene.images.decoding import image_size, load_opaque
from chronoscene.images.store import evaluation_size
from chronoscene.io.staging import staged_folder, write_text_atomic
from chronoscene.io.wording import counted, shown
from chronoscene.metrics.registry import Scorers
from chronoscene.scene import Frame, Scene
from chronoscene.scene.splits import NameIndex, split_hash

STRATEGY, PRESET = "external", "images"
"""Strategy and preset in the name of such a run."""


def find_images(folder: Path, scene: Scene, table: Path | None = None) -> dict[str, Path]:
    """Return the image of each test view, by the name of the view.

    Args:
        folder: PNG files named like the test views, with or without their own extension, in
            subfolders if the names need them.
        scene: The scene with the views.
        table: CSV file with the columns ``file``, below the folder, and ``view``, for files with
            other names.

    Raises:
        ImageError: If a view has no image, or several, or an image belongs to no test view.
    """
    index = NameIndex(frame.name for frame in scene.frames)
    tests = {frame.name for frame in scene.select(split="test")}
    if table is not None:
        named = [(file, view) for _, file, view in read_table(table, label="view")]
    else:
        files = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.png"))]
        named = [(file, file) for file in files]
    found: dict[str, Path] = {}
    wrong = []
    for file, name in named:
        views = index.find(name) or index.find(name.removesuffix(".png"))
        if len(views) != 1 or views[0] not in tests - found.keys() or not (folder / file).is_file():
            wrong.append(file)
        else:
            found[views[0]] = folder / file
    problems = []
    if missing := sorted(tests - found.keys()):
        problems.append(f"no image of {shown(missing)}")
    if wrong:
        problems.append(f"{shown(wrong)}, which is not the one file of one test view")
    if problems:
        raise ImageError(
            table or folder,
            expected=f"one PNG image of each of {counted(len(tests), 'test view')}",
            found="; ".join(problems),
            todo="name the files like the views, or list them in a CSV file (--map)",
        )
    return found


def add_images(
    writer: ImageWriter, frames: Sequence[Frame], images: Mapping[str, Path], max_width: int
) -> int:
    """Put images into a folder of predictions; return the number of resized ones.

    They have the size of the evaluation, or the full size of their camera; then they are resized
    like the photos.

    Raises:
        ImageError: If an image has another size or transparent pixels, or cannot be decoded.
    """
    resized = 0
    for frame in frames:
        path = images[frame.name]
        target = evaluation_size(*frame.camera.size, max_width)
        size = image_size(path)
        if size not in (target, frame.camera.size):
            allowed = " or ".join(
                f"{w} x {h}" for w, h in dict.fromkeys((target, frame.camera.size))
            )
            raise ImageError(
                path,
                expected=f"{allowed} pixels, as its view {frame.name!r} has",
                found=f"{size[0]} x {size[1]}",
                todo="render the view with the camera of the scene",
            )
        resized += size != target
        pixels = load_opaque(path, size=target)
        writer.add(frame.name, pixels, camera_period=frame.period, rendered_period=frame.period)
    return resized


def foreign_record(scene: Scene, reason: str, **known: Any) -> records.RunRecord:
    """Return the record of a run of another program, in which unknown costs are absent.

    Args:
        scene: The scene that the program was trained on.
        reason: Reason for absent costs.
        known: Fields of the record.
    """
    costs = (
        *("seconds", "iterations", "primitives"),
        *("render_seconds", "checkpoint_bytes", "peak_memory_bytes", "sharing"),
    )
    others = ("parameters", "warmup_seconds", "setup_seconds", "threads")
    unknown = dict.fromkeys((*costs, *others, "peak_device_memory_bytes"))
    fields: dict[str, Any] = {
        "scene": scene.name,
        "aggregates": {},
        "periods": {},
        "skipped": {},
        "split_hash": split_hash(scene),
        "period_labels": {str(p.id): p.label for p in scene.periods},
        "libraries": library_versions(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "notices": [],
        **unknown,
        **known,
    }
    absent = [name for name in costs if fields[name] is None]
    return records.RunRecord(**fields, absent=dict.fromkeys(absent, reason))


def score_images(
    scene: Scene,
    folder: Path,
    name: str,
    runs: Path,
    scorers: Scorers,
    *,
    table: Path | None = None,
    seed: int = 0,
    max_width: int,
) -> Path:
    """Score the images of another program; return the folder of the run.

    Args:
        scene: The scene with the test views.
        folder: Folder of the images, as for `find_images`.
        name: Name of the program in tables.
        runs: Folder of all runs.
        scorers: The metrics.
        table: Table of files and views, as for `find_images`.
        seed: Seed of the training.
        max_width: Largest width of the evaluation, in pixels.

    Raises:
        SceneError: If there are no test views.
        ConfigError: If there is such a run, or the folder of runs has this scene itself, another
            one of its name, or other sizes.
        ImageError: If images are missing, too many, or of another size.
    """
    check_not_among_runs(scene, runs)
    check_scene(scene)
    tests, method = _test_views(scene), _method_name(name)
    out = runs / safe_part(scene.name) / f"{method}-{STRATEGY}-{PRESET}" / f"seed{seed}"
    if out.exists():
        raise ConfigError(
            out,
            expected="no run of this name and seed",
            found="one",
            todo="choose another --name or --seed, or delete it",
        )
    images = find_images(folder, scene, table)
    digest = scene_hash(scene)
    freeze_ground_truth(runs, scene, digest, max_width)
    config = {
        "method": method,
        "preset": PRESET,
        "method_config": {},
        "strategy": STRATEGY,
        "max_width": max_width,
    }
    run = {"config_hash": config_hash(config), "scene_hash": digest, "seed": seed}
    record = foreign_record(
        scene,
        f"{name} is another program, and only its images are here",
        title=name,
        method=method,
        strategy=STRATEGY,
        preset=PRESET,
        max_width=max_width,
        commit=code_version(),
        method_version="not known",
        device="not known",
        **run,
    )
    with staged_folder(out) as staging:
        writer = ImageWriter(staging / records.PREDICTIONS)
        resized = add_images(writer, tests, images, max_width)
        details = {"name": name, "folder": str(folder.resolve()), "resized": resized}
        writer.close(kind="predictions", scene=scene.name, scene_hash=digest, details=details)
        if resized:
            record.notices.append(
                f"{record.label}: {counted(resized, 'image')} of full size resized like the photos"
            )
        document = {"config": config, "scene": scene.name, **run}
        write_text_atomic(staging / records.CONFIG_FILE, json.dumps(document, indent=1) + "\n")
        score_run(staging, record, ground_truth_folder(runs, scene.name), scorers)
    return out


def _test_views(scene: Scene) -> tuple[Frame, ...]:
    """Return the test views of a scene, of which there must be some."""
    if not (tests := scene.select(split="test")):
        raise SceneError(
            scene.root,
            expected="test views to score",
            found=f"none ({scene.split_rule})",
            todo=f"choose some (chronoscene split {quote(str(scene.root))} --scene-out NEW), "
            "and use NEW",
        )
    return tests


def _method_name(name: str) -> str:
    """Return the name of a program as that of a method, without spaces and the like."""
    if not re.search(r"\w", name):
        raise ConfigError(
            "--name",
            expected="letters or digits",
            found=repr(name),
            todo="choose the name that tables are to show",
        )
    return re.sub(r"[^\w.+-]+", "-", name)
