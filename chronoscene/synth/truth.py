"""Ground truth beside the scene: depth, changes, and the test views at every other period."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Camera, Period
from chronoscene.synth.city.world import World
from chronoscene.synth.flights import View
from chronoscene.synth.render.renderer import PeriodRenderer, PixelMaps

UNCHANGED, APPEARANCE, GEOMETRY = 0, 127, 255
"""Values of change masks."""
DEPTH_TOLERANCE = 1e-3
"""Relative difference of depth that counts as a change of geometry."""
ALBEDO_TOLERANCE = 0.02
"""Linear difference of albedo that counts as a change of appearance."""
SHEET_COLUMNS = 6

Advance = Callable[[str], None]


def save_jpeg(path: Path, image: NDArray[np.uint8]) -> None:
    """Write RGB at quality 95 without subsampling of the colours."""
    flags = [
        cv2.IMWRITE_JPEG_QUALITY,
        95,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., ::-1]), flags)


def change_mask(here: PixelMaps, there: PixelMaps) -> NDArray[np.uint8]:
    """What differs between two periods seen by one camera. [H, W]

    Light does not count: the mask compares objects, depth and albedo at the pixel centres.
    """
    mask = np.full(here.depth.shape, UNCHANGED, np.uint8)
    paint = np.abs(here.albedo - there.albedo).max(axis=2) > ALBEDO_TOLERANCE
    mask[paint] = APPEARANCE
    gap = np.abs(here.depth - there.depth) > DEPTH_TOLERANCE * np.maximum(here.depth, there.depth)
    mask[gap | (here.element != there.element)] = GEOMETRY
    return mask


def write_truth(
    folder: Path,
    world: World,
    renderers: Sequence[PeriodRenderer],
    camera: Camera,
    views: Sequence[View],
    periods: Sequence[Period],
    images: Path,
    advance: Advance,
) -> None:
    """Write the folder ``gt``.

    Args:
        folder: The folder; it is made.
        world: Lights, edits and objects.
        renderers: One per period.
        camera: Shared camera.
        views: All views.
        periods: Labels and dates.
        images: Folder of the photos, for the contact sheet.
        advance: Told the name of each finished unit of work.
    """
    tests = [v for v in views if v.split == "test"]
    for view in tests:
        stem = view.name.removesuffix(".jpg")
        here = renderers[view.period].maps(camera, view.cam_from_world)
        _save_depth(folder / "depth" / f"{stem}.npz", here)
        for other, renderer in enumerate(renderers):
            if other == view.period:
                continue
            name = f"{stem}__p{other}"
            there = renderer.maps(camera, view.cam_from_world)
            _save_depth(folder / "cross_depth" / f"{name}.npz", there)
            save_jpeg(
                folder / "cross_rgb" / f"{name}.jpg", renderer.image(camera, view.cam_from_world)
            )
            _save_png(folder / "change" / f"{name}.png", change_mask(here, there))
            advance("ground truth")
    _save_png(folder / "contact_sheet.png", _contact_sheet(folder, images, tests, len(renderers)))
    text = json.dumps(_story(world, periods), indent=1)
    (folder / "periods.json").write_text(text + "\n", encoding="utf-8", newline="\n")


def _save_depth(path: Path, maps: PixelMaps) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, depth=maps.depth)


def _save_png(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def _story(world: World, periods: Sequence[Period]) -> dict[str, Any]:
    """Light, edits, and every object with its states and the periods that show them."""
    objects: dict[str, Any] = {}
    for e in world.elements:
        low, high = e.part.bounds
        entry = objects.setdefault(e.name, {"kind": e.kind, "states": []})
        entry["states"].append(
            {
                "state": e.state,
                "periods": e.periods,
                "bounds": [np.round(low, 3).tolist(), np.round(high, 3).tolist()],
            }
        )
    return {
        "periods": [
            {"id": p.id, "label": p.label, "date": p.date, "light": asdict(light)}
            for p, light in zip(periods, world.lights, strict=True)
        ],
        "edits": [asdict(e) for e in world.edits],
        "objects": objects,
    }


def _contact_sheet(
    folder: Path, images: Path, tests: Sequence[View], periods: int
) -> NDArray[np.uint8]:
    """One row per period, the same cameras in every row; green marks the real photo."""
    pick = np.unique(np.linspace(0, len(tests) - 1, min(SHEET_COLUMNS, len(tests))).astype(int))
    rows = []
    for period in range(periods):
        row = []
        for view in (tests[int(i)] for i in pick):
            stem = view.name.removesuffix(".jpg")
            own = view.period == period
            path = images / view.name
            image = cv2.imread(
                str(path if own else folder / "cross_rgb" / f"{stem}__p{period}.jpg")
            )
            assert image is not None
            small = _at_most(np.asarray(image[..., ::-1]), 320)
            if own:
                cv2.rectangle(small, (0, 0), (small.shape[1] - 1, small.shape[0] - 1), (0, 220, 0),
                              max(1, small.shape[1] // 100))  # fmt: skip
            row.append(small)
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def _at_most(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    if image.shape[1] <= width:
        return np.ascontiguousarray(image)
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
