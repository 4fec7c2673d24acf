"""Raster of a survey: square cells, north up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.errors import ConfigError
from chronoscene.images.store import evaluation_size, resize_camera
from chronoscene.scene import Scene
from chronoscene.scene.tracks import track_owners
from chronoscene.survey.map_frame import MapFrame

MAX_CELLS = 20_000_000
EDGE = 1.0  # Percent of the sparse points that lie beyond each edge of the area


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of a raster; the first is in the north-west."""

    left: float
    """East of its western edge."""
    top: float
    """North of its northern edge."""
    resolution: float
    """Metres."""
    width: int
    """Cells."""
    height: int
    low: float
    """Range of heights in which surfaces are expected."""
    high: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def centres(self) -> Array:
        """East and north of the centres of all cells. [H, W, 2]"""
        east = self.left + (np.arange(self.width) + 0.5) * self.resolution
        north = self.top - (np.arange(self.height) + 0.5) * self.resolution
        return np.stack(np.meshgrid(east, north), axis=-1)

    def holds(self, places: Array) -> Mask:
        """Return True for places over the cells and within the heights. [N, 3] -> [N]"""
        right = self.left + self.width * self.resolution
        bottom = self.top - self.height * self.resolution
        low, high = (self.left, bottom, self.low), (right, self.top, self.high)
        return np.asarray(((places >= low) & (places <= high)).all(axis=1))

    def cells(self, places: Array) -> tuple[Ints, Ints]:
        """Return row and column of the cells below places that the grid `holds`. [N, 3] -> [N]"""
        column = ((places[:, 0] - self.left) / self.resolution).astype(int)
        row = ((self.top - places[:, 1]) / self.resolution).astype(int)
        return np.minimum(row, self.height - 1), np.minimum(column, self.width - 1)

    def tiles(self, size: int) -> Iterator[tuple[slice, slice]]:
        """Yield rows and columns of parts of at most ``size`` cells a side."""
        for row in range(0, self.height, size):
            for column in range(0, self.width, size):
                bottom, right = min(row + size, self.height), min(column + size, self.width)
                yield slice(row, bottom), slice(column, right)


def natural_resolution(scene: Scene, max_width: int) -> float:
    """Median size in metres of a pixel of the training photos, at most ``max_width`` wide, on the
    sparse points; to two digits.

    Raises:
        ConfigError: If no photo sees a point.
    """
    points, sizes = scene.points, [np.zeros(0)]
    owners = track_owners(points.track_start)
    for number, frame in enumerate(scene.frames):
        if frame.split == "train":
            seen = points.xyz[owners[points.track_frame == number]]
            size = evaluation_size(*frame.camera.size, max_width)
            depth = seen @ frame.cam_from_world[2, :3] + frame.cam_from_world[2, 3]
            sizes.append(depth / resize_camera(frame.camera, *size).K[0, 0])
    found = np.concatenate(sizes)
    if not len(found):
        raise ConfigError(
            "--resolution",
            expected="the size of a cell, as no training photo sees a sparse point",
            found="none",
            todo="add it, in metres",
        )
    return float(f"{np.median(found):.2g}")


def choose_grid(scene: Scene, frame: MapFrame, resolution: float) -> Grid:
    """Make a raster of the area of the sparse points, its edges at multiples of the resolution.

    Raises:
        ConfigError: If there are no points, or too many cells.
    """
    if not len(scene.points):
        raise ConfigError(
            scene.root,
            expected="sparse points, which say where the area is",
            found="none",
            todo="add them with chronoscene triangulate",
        )
    low, high = np.percentile(frame.to_map(scene.points.xyz), [EDGE, 100 - EDGE], axis=0)
    left, bottom = np.floor(low[:2] / resolution)
    right, top = np.ceil(high[:2] / resolution)
    width, height = max(1, int(right - left)), max(1, int(top - bottom))
    if width * height > MAX_CELLS:
        finest = float(np.sqrt(np.prod(high[:2] - low[:2]) / MAX_CELLS))
        raise ConfigError(
            f"--resolution {resolution:g}",
            expected=f"at most {MAX_CELLS:,} cells",
            found=f"{width * height:,}",
            todo=f"choose {1.1 * finest:.2g} or more",
        )
    margin = max((high[2] - low[2]) / 2, resolution)  # for what is above the highest points
    heights = float(low[2] - margin), float(high[2] + margin)
    return Grid(left * resolution, top * resolution, resolution, width, height, *heights)
