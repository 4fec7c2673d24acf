"""Skeletons: scenes of a given size for measuring tools, with tiny images and no ground truth.

A skeleton is a valid scene in the ChronoScene format: poses, points and tracks fit each other
within a pixel. Its images are coloured noise of the cameras' size; nothing can be learnt from them.
`write_dataset` makes all scenes of the paper's table of counts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from benchmarks.data.skeletons.geometry import flying_height, make_camera, make_houses, make_poses
from benchmarks.data.skeletons.tracks import Flight, add_noise, make_tracks
from chronoscene.colmap.raw_model import RawPoints
from chronoscene.colmap.write import posed_images, write_raw_model
from chronoscene.errors import ConfigError
from chronoscene.formats import chronoscene as scene_format
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Camera, WorldFrame
from chronoscene.scene.splits import TEST_EVERY, format_split_text
from chronoscene.statistics.counts import PAPER_COUNTS
from chronoscene.synth.render.noise import rng_for

Progress = Callable[[int, int, str], None]
"""Called with scenes done, their total and the name of the one that comes."""

_NOISE_CELL = 4
"""Pixels along each side of a patch of one colour in an image."""


def write_dataset(
    out: Path,
    *,
    scenes: Sequence[str] | None = None,
    seed: int = 0,
    size: tuple[int, int] = (64, 48),
    progress: Progress | None = None,
) -> None:
    """Write skeletons of the paper's scenes, one folder each.

    Args:
        out: New or empty folder.
        scenes: Names in `PAPER_COUNTS`; None for all.
        seed: Another seed is another place.
        size: Width and height of cameras and images in pixels.
        progress: Told about each scene.

    Raises:
        ConfigError: If a scene is unknown, or a size is out of range.
        SceneError: If ``out`` is in use.
    """
    names = list(PAPER_COUNTS) if scenes is None else list(scenes)
    for name in names:
        if name not in PAPER_COUNTS:
            raise ConfigError(
                "--scene",
                expected=f"one of {', '.join(PAPER_COUNTS)}",
                found=repr(name),
                todo="name scenes of the paper's table",
            )
    with staged_folder(out) as staged:
        for done, name in enumerate(names):
            if progress is not None:
                progress(done, len(names), name)
            place = seed + list(PAPER_COUNTS).index(name) * 7919
            write_skeleton(staged / name, PAPER_COUNTS[name], seed=place, size=size)


def write_skeleton(
    out: Path, counts: Sequence[tuple[int, int]], *, seed: int = 0, size: tuple[int, int] = (64, 48)
) -> None:
    """Write one scene.

    Args:
        out: New or empty folder.
        counts: Images and points of each period; `chronoscene.statistics.count_scene` finds these.
        seed: Another seed is another place; equal arguments give equal bytes.
        size: Width and height of cameras and images in pixels.

    Raises:
        ConfigError: If there are too few images, or the size is out of range.
        SceneError: If ``out`` is in use.
    """
    _check(counts, size)
    camera = make_camera(*size)
    with staged_folder(out) as staged:
        model = staged / scene_format.MODEL
        model.mkdir(parents=True)
        flights = _make_flights(camera, [images for images, _ in counts], seed)
        names = _write_texts(staged, counts)
        _write_model(model, camera, flights, names, counts, seed)
        _write_images(staged / "images", names, size, seed)


def _check(counts: Sequence[tuple[int, int]], size: tuple[int, int]) -> None:
    least_images, sizes = 3, (16, 1024)
    if not counts or any(images < least_images or points < 0 for images, points in counts):
        raise ConfigError(
            "counts of a skeleton",
            expected=f"at least {least_images} images and no negative number of points per period",
            found=str(list(counts)),
            todo="ask for more images",
        )
    if not all(sizes[0] <= edge <= sizes[1] for edge in size):
        raise ConfigError(
            "--size",
            expected=f"from {sizes[0]} to {sizes[1]} pixels for a skeleton",
            found=f"{size[0]}x{size[1]}",
            todo="choose a size in this range",
        )


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


def _write_images(folder: Path, names: Sequence[str], size: tuple[int, int], seed: int) -> None:
    """Patches of random colours: small files, no two of them alike."""
    rng = rng_for(seed, "images")
    folder.mkdir()
    cells = (-(-size[1] // _NOISE_CELL), -(-size[0] // _NOISE_CELL), 3)
    for name in names:
        patches = Image.fromarray(rng.integers(0, 256, cells, dtype=np.uint8))
        patches.resize(size, Image.Resampling.NEAREST).save(folder / name, quality=80)
