"""Skeletons: scenes of a given size for measuring tools, with tiny images and no ground truth.

A skeleton is a valid scene in the ChronoScene format: poses, points and tracks fit each other
within a pixel. Its images are coloured noise of the cameras' size; nothing can be learnt from them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from benchmarks.data.skeletons.geometry import flying_height, make_camera, make_houses, make_poses
from benchmarks.data.skeletons.tracks import Flight, add_noise, make_tracks
from chronoscene.colmap.raw_model import RawPoints
from chronoscene.colmap.write import posed_images, write_raw_model
from chronoscene.formats import chronoscene as scene_format
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Camera, WorldFrame
from chronoscene.scene.splits import TEST_EVERY, format_split_text
from chronoscene.synth.render.noise import rng_for

SIZE = (64, 48)
"""Width and height of cameras and images in pixels."""

_NOISE_CELL = 4
"""Pixels along each side of a patch of one colour in an image."""


def write_skeleton(out: Path, counts: Sequence[tuple[int, int]], *, seed: int = 0) -> None:
    """Write one scene.

    Args:
        out: New or empty folder.
        counts: Images, three or more, and points of each period;
            `chronoscene.statistics.count_scene` finds these.
        seed: Another seed is another place; equal arguments give equal bytes.

    Raises:
        SceneError: If ``out`` is in use.
    """
    camera = make_camera(*SIZE)
    with staged_folder(out) as staged:
        model = staged / scene_format.MODEL
        model.mkdir(parents=True)
        flights = _make_flights(camera, [images for images, _ in counts], seed)
        names = _write_texts(staged, counts)
        _write_model(model, camera, flights, names, counts, seed)
        _write_images(staged / "images", names, seed)


def _make_flights(camera: Camera, images: Sequence[int], seed: int) -> list[Flight]:
    height, first = flying_height(images), 0
    flights = []
    for period, count in enumerate(images):
        poses, targets = make_poses(count, height, rng_for(seed, "flight", period))
        flights.append(Flight(camera, poses, cKDTree(targets), first))
        first += count
    return flights


def _write_texts(root: Path, counts: Sequence[tuple[int, int]]) -> list[str]:
    """Split, test list and unit; returns the names of all images, sorted."""
    by_period = [[f"p{p:02d}_{i:05d}.jpg" for i in range(n)] for p, (n, _) in enumerate(counts)]
    periods = {name: p for p, names in enumerate(by_period) for name in names}
    tests = [name for names in by_period for name in names[::TEST_EVERY]]
    texts = {
        scene_format.SPLIT: format_split_text(periods),
        scene_format.TEST: "".join(f"{name}\n" for name in tests),
        scene_format.WORLD: json.dumps(scene_format.world_item(WorldFrame(unit="metre"))) + "\n",
    }
    for place, text in texts.items():
        (root / place).write_text(text, encoding="utf-8", newline="\n")
    return list(periods)


def _write_model(
    folder: Path,
    camera: Camera,
    flights: Sequence[Flight],
    names: Sequence[str],
    counts: Sequence[tuple[int, int]],
    seed: int,
) -> None:
    rng = rng_for(seed, "points")
    houses = make_houses(len(counts), rng_for(seed, "houses"))
    surface, tracks = make_tracks(houses, flights, [points for _, points in counts], rng)
    xy = add_noise(tracks, camera, rng)
    residual = np.linalg.norm(xy - tracks.exact, axis=1)
    length = np.bincount(tracks.point, minlength=len(surface.xyz))
    error = np.bincount(tracks.point, residual, len(length)) / np.maximum(length, 1)
    poses = np.concatenate([flight.poses for flight in flights])
    order = np.lexsort((tracks.image, tracks.point))
    point, image = tracks.point[order], tracks.image[order]
    ids, camera_ids = 1 + np.arange(len(names)), np.full(len(names), camera.camera_id)
    seen = (image, 1 + point, xy[order])
    images, keypoint = posed_images(ids, names, poses, camera_ids, seen)
    points = RawPoints(
        ids=1 + np.arange(len(length)),
        xyz=surface.xyz,
        rgb=np.round(surface.rgb).astype(np.uint8),
        error=error,
        track_start=np.concatenate([[0], np.cumsum(length)]),
        track_image=1 + image,
        track_keypoint=keypoint,
    )
    write_raw_model(folder, [camera], images, points)


def _write_images(folder: Path, names: Sequence[str], seed: int) -> None:
    """Patches of random colours: small files, no two of them alike."""
    rng = rng_for(seed, "images")
    folder.mkdir()
    cells = (SIZE[1] // _NOISE_CELL, SIZE[0] // _NOISE_CELL, 3)
    for name in names:
        patches = Image.fromarray(rng.integers(0, 256, cells, dtype=np.uint8))
        patches.resize(SIZE, Image.Resampling.NEAREST).save(folder / name, quality=80)
