"""Ground truth: depth, change masks, and the test views rendered at every other period."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chronoscene.images.decoding import load_rgb
from chronoscene.images.truth import APPEARANCE, GEOMETRY, UNCHANGED, truth_place
from chronoscene.scene import Frame, Period, Scene
from chronoscene.synth.city.world import World
from chronoscene.synth.render.renderer import PeriodRenderer, PixelMaps

DEPTH_TOLERANCE = 1e-3  # Relative difference of depth that counts as a change of geometry
ALBEDO_TOLERANCE = 0.02  # Linear difference of albedo that counts as a change of appearance
SHEET_COLUMNS = 6
JPEG_FLAGS = (
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)


def save_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB or grey image; JPEG has quality 95 and no chroma subsampling."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image
    # Not cv2.imwrite, which does not say why it failed.
    done, data = cv2.imencode(path.suffix, image, JPEG_FLAGS if path.suffix == ".jpg" else [])
    assert done
    path.write_bytes(data.tobytes())


def change_mask(here: PixelMaps, there: PixelMaps) -> NDArray[np.uint8]:
    """Pixels that differ between two periods seen by the same camera. [H, W]

    The mask compares objects, depth and albedo at the pixel centres; light does not count.
    """
    mask = np.full(here.depth.shape, UNCHANGED, np.uint8)
    paint = np.abs(here.albedo - there.albedo).max(axis=2) > ALBEDO_TOLERANCE
    mask[paint] = APPEARANCE
    gap = np.abs(here.depth - there.depth) > DEPTH_TOLERANCE * np.maximum(here.depth, there.depth)
    mask[gap | (here.element != there.element)] = GEOMETRY
    return mask


def write_truth(
    folder: Path,
    scene: Scene,
    world: World,
    renderers: Sequence[PeriodRenderer],
    advance: Callable[[str], None],
) -> None:
    """Write the folder ``gt``.

    Args:
        folder: Folder to create.
        scene: Frames, their images, and periods.
        world: Lights, edits and objects.
        renderers: One per period.
        advance: Called with the name of each finished unit of work.
    """
    tests = scene.select(split="test")
    for frame in tests:
        view = frame.camera, frame.cam_from_world
        here = renderers[frame.period].maps(*view)
        _save_depth(folder / truth_place("depth", frame.name), here)
        for other, renderer in enumerate(renderers):
            if other == frame.period:
                continue
            there = renderer.maps(*view)
            _save_depth(folder / truth_place("cross_depth", frame.name, other), there)
            image = renderer.image(*view)
            save_image(folder / truth_place("cross_rgb", frame.name, other), image)
            mask = change_mask(here, there)
            save_image(folder / truth_place("change", frame.name, other), mask)
            advance("ground truth")
    save_image(folder / "contact_sheet.png", _contact_sheet(folder, scene, tests))
    text = json.dumps(_story(world, scene.periods), indent=1)
    (folder / "periods.json").write_text(text + "\n", encoding="utf-8", newline="\n")


def _save_depth(path: Path, maps: PixelMaps) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, depth=maps.depth)


def _story(world: World, periods: Sequence[Period]) -> dict[str, Any]:
    """Periods with their light, edits, and all objects with their states."""
    objects: dict[str, Any] = {}
    for e in world.elements:
        entry = objects.setdefault(e.name, {"kind": e.kind, "states": []})
        bounds = np.round(e.mesh.bounds, 3).tolist()
        entry["states"].append({"state": e.state, "periods": e.periods, "bounds": bounds})
    return {
        "periods": [
            {"id": p.id, "label": p.label, "date": p.date, "light": asdict(light)}
            for p, light in zip(periods, world.lights, strict=True)
        ],
        "edits": [asdict(e) for e in world.edits],
        "objects": objects,
    }


def _contact_sheet(folder: Path, scene: Scene, tests: Sequence[Frame]) -> NDArray[np.uint8]:
    """One row per period, the same cameras in every row; green marks the photo itself."""
    pick = np.unique(np.linspace(0, len(tests) - 1, min(SHEET_COLUMNS, len(tests))).astype(int))
    rows = []
    for period in range(scene.num_periods):
        row = []
        for frame in (tests[int(i)] for i in pick):
            own = frame.period == period
            cross = folder / truth_place("cross_rgb", frame.name, period)
            small = _shrunk(load_rgb(scene.image_path(frame) if own else cross))
            if own:
                height, width = small.shape[:2]
                end = (width - 1, height - 1)
                cv2.rectangle(small, (0, 0), end, (0, 220, 0), max(1, width // 100))
            row.append(small)
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def _shrunk(image: NDArray[np.uint8], max_width: int = 320) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if width <= max_width:
        return image
    size = (max_width, max(1, round(height * max_width / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
