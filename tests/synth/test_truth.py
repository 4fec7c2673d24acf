"""Depth, change masks and the story in gt/."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from chronoscene.images.truth import APPEARANCE, GEOMETRY, UNCHANGED, changed_at_all
from chronoscene.synth.city.buildings import SLAB
from chronoscene.synth.render.renderer import PixelMaps
from chronoscene.synth.truth import change_mask, save_image


def stem(name: str) -> str:
    return name.removesuffix(".jpg")


def depth_of(path: Path) -> np.ndarray:
    return np.load(path)["depth"]


def unproject(frame, depth: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """World points of a depth map at pixel centres. [H, W, 3]"""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(frame.camera.K).T
    pose = np.linalg.inv(frame.cam_from_world)
    return (local * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def pairs(made):  # type: ignore[no-untyped-def]
    """Test frames with every other period."""
    tests = made.scene.select(split="test")
    every = range(made.scene.num_periods)
    return [(f, q) for f, q in product(tests, every) if q != f.period]


def test_depth_puts_the_ground_at_its_height(made) -> None:  # type: ignore[no-untyped-def]
    """Pixel centres, principal point and pose must all be right for the ground to be level."""
    level = 0
    for frame in made.scene.select(split="test"):
        depth = depth_of(made.folder / "gt/depth" / f"{stem(frame.name)}.npz")
        z = unproject(frame, depth)[depth > 0][:, 2]
        flat = np.minimum(np.abs(z), np.abs(z - SLAB)) < 5e-4
        level += int(flat.mean() > 0.1)
    assert level == len(made.scene.select(split="test"))


def test_points_lie_on_the_depth_maps(made) -> None:  # type: ignore[no-untyped-def]
    """A point of the period is never in front of the depth map, and mostly on it."""
    seen = made.scene.point_periods()
    for frame in made.scene.select(split="test"):
        depth = depth_of(made.folder / "gt/depth" / f"{stem(frame.name)}.npz")
        x = made.scene.points.xyz[seen[:, frame.period]]
        local = x @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
        pixel = (local @ frame.camera.K.T)[:, :2] / local[:, 2:]
        size = [frame.camera.width, frame.camera.height]
        inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        cell = np.floor(pixel[inside]).astype(int)
        ratio = local[inside, 2] / np.maximum(depth[cell[:, 1], cell[:, 0]], 1e-6)
        # Half a pixel of a slanted surface changes depth by a few percent.
        assert (ratio < 0.95).mean() < 0.06
        assert (np.abs(ratio - 1) < 0.05).mean() > 0.5


def test_changes_lie_where_objects_changed(made) -> None:  # type: ignore[no-untyped-def]
    """Every marked pixel shows, in one of the two periods, an object that the story changes."""
    story = json.loads((made.folder / "gt/periods.json").read_text())
    for frame, other in pairs(made):
        name = f"{stem(frame.name)}__p{other}"
        mask = cv2.imread(str(made.folder / f"gt/change/{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.ndim == 2 and set(np.unique(mask)) <= {UNCHANGED, APPEARANCE, GEOMETRY}
        own = depth_of(made.folder / f"gt/depth/{stem(frame.name)}.npz")
        then = depth_of(made.folder / f"gt/cross_depth/{name}.npz")
        allowed = np.zeros(mask.shape, bool)
        for depth, period in ((own, frame.period), (then, other)):
            world_points = unproject(frame, depth)
            for low, high in changed_boxes(story["objects"], frame.period, other, period):
                inside = (world_points > low - 0.02) & (world_points < high + 0.02)
                allowed |= inside.all(axis=-1) & (depth > 0)
        assert not (mask[~allowed] != UNCHANGED).any(), name
        assert 0.02 < (mask != UNCHANGED).mean() < 0.9


def changed_boxes(objects: dict, a: int, b: int, shown: int) -> list[np.ndarray]:
    """Boxes, in period ``shown``, of the objects whose states differ between two periods."""
    boxes = []
    for entry in objects.values():
        states = {p: i for i, s in enumerate(entry["states"]) for p in s["periods"]}
        if states.get(a) != states.get(b) and shown in states:
            boxes.append(np.array(entry["states"][states[shown]]["bounds"]))
    return boxes


def test_the_new_building_is_geometry(made, world, renderers) -> None:  # type: ignore[no-untyped-def]
    """Wherever the finished hall is seen, the mask against the empty lot says geometry."""
    hall = next(i for i, name in enumerate(world.names) if name.endswith("/hall"))
    found = 0
    for frame, other in pairs(made):
        if frame.period != 1:
            continue
        here = renderers[1].maps(frame.camera, frame.cam_from_world)
        name = f"{stem(frame.name)}__p{other}"
        mask = cv2.imread(str(made.folder / f"gt/change/{name}.png"), cv2.IMREAD_UNCHANGED)
        assert (mask[here.element == hall] == GEOMETRY).all()
        found += int((here.element == hall).sum())
    assert found > 50


def test_mask_of_a_period_with_itself_is_empty(made, renderers) -> None:  # type: ignore[no-untyped-def]
    frame = made.scene.frames[0]
    maps = renderers[0].maps(frame.camera, frame.cam_from_world)
    assert not change_mask(maps, maps).any()


def test_depth_changes_by_a_thousandth_of_the_larger_one() -> None:
    near = np.full((1, 3), 100.0, np.float32)
    far = near * np.array([[1.00095, 1.0010005, 1.00105]])
    element, albedo = np.zeros((1, 3), np.int32), np.zeros((1, 3, 3))
    here, there = (PixelMaps(depth, element, albedo) for depth in (near, far))
    for mask in (change_mask(here, there), change_mask(there, here)):
        assert mask.tolist() == [[UNCHANGED, UNCHANGED, GEOMETRY]]


def test_edits_tell_every_difference(made, world) -> None:  # type: ignore[no-untyped-def]
    story = json.loads((made.folder / "gt/periods.json").read_text())
    listed = {(e["target"], e["period"]) for e in story["edits"]}
    differ = set()
    for name, entry in story["objects"].items():
        states = {p: i for i, s in enumerate(entry["states"]) for p in s["periods"]}
        for p in range(1, made.scene.num_periods):
            if states.get(p - 1) != states.get(p):
                differ.add((name, p))
    assert listed == differ and differ
    assert {"add", "remove", "grow"} <= {e["action"] for e in story["edits"]}


def test_cross_renders_differ_from_the_photo(made) -> None:  # type: ignore[no-untyped-def]
    """Ignoring the period must cost a lot: the mean over periods is far from each of them."""
    errors = []
    for frame, other in pairs(made):
        own = cv2.imread(str(made.scene.image_path(frame))).astype(float)
        path = made.folder / f"gt/cross_rgb/{stem(frame.name)}__p{other}.jpg"
        errors.append(np.mean((own - (own + cv2.imread(str(path))) / 2) ** 2))
    psnr = 10 * np.log10(255**2 / np.mean(errors))
    assert psnr < 23


@pytest.mark.parametrize("part", ["depth", "cross_depth"])
def test_depth_files_are_plain_float32(made, part: str) -> None:  # type: ignore[no-untyped-def]
    for path in (made.folder / "gt" / part).iterdir():
        depth = depth_of(path)
        assert depth.dtype == np.float32 and np.isfinite(depth).all() and (depth >= 0).all()


def test_a_picture_that_cannot_be_written_says_why(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(IsADirectoryError):
        save_image(tmp_path / "a.png", np.zeros((2, 2), np.uint8))


def test_masks_are_found_by_those_who_read_them(made) -> None:  # type: ignore[no-untyped-def]
    for frame, other in pairs(made):  # two periods, so there is one other
        changed = changed_at_all(made.folder / "gt", frame.name, [other], frame.camera.size, 1600)
        path = made.folder / f"gt/change/{stem(frame.name)}__p{other}.png"
        np.testing.assert_array_equal(changed, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0)
