"""The scene in memory: frames, cameras, sparse points, periods. No torch, no file access."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.cameras import Camera
from chronoscene.scene.tracks import count_views, seen_by_period, select_tracks, track_owners

Split = Literal["train", "test"]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One registered image with its camera, pose, period and split."""

    name: str
    """Path below ``images/`` with its folders and extension: the key everywhere."""
    image_id: int
    camera: Camera
    cam_from_world: NDArray[np.float64]
    """[4, 4]"""
    period: int
    split: Split


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """Sparse points with their tracks, as flat arrays (P points, M observations).

    Subclasses add ``track_*`` columns, which say what the observations refer to. [M]
    """

    ids: NDArray[np.int64]
    """COLMAP's point ids. [P]"""
    xyz: NDArray[np.float64]
    """World units. [P, 3]"""
    rgb: NDArray[np.uint8]
    """[P, 3]"""
    error: NDArray[np.float64]
    """Mean reprojection error in pixels as stored in the model. [P]"""
    track_start: NDArray[np.int64]
    """Observations of point i are ``track_start[i]:track_start[i + 1]``. [P + 1]"""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def finite(self) -> NDArray[np.bool_]:
        """True for points with finite coordinates. [P]"""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def select(self, keep: NDArray[np.bool_]) -> Self:
        """Keep some of the points [P], each with all of its observations."""
        track_start, observed = select_tracks(self.track_start, keep)
        of_points = {name: getattr(self, name)[keep] for name in ("ids", "xyz", "rgb", "error")}
        added = [f.name for f in fields(self) if f.name not in (*of_points, "track_start")]
        of_tracks = {name: getattr(self, name)[observed] for name in added}
        return replace(self, **of_points, track_start=track_start, **of_tracks)


@dataclass(frozen=True, slots=True, eq=False)
class Points(PointTable):
    """Sparse points of a scene."""

    track_frame: NDArray[np.int32]
    """Index into ``Scene.frames``. [M]"""
    track_xy: NDArray[np.float64]
    """Pixel position of the observation. [M, 2]"""

    @classmethod
    def empty(cls) -> Points:
        return cls(
            ids=np.zeros(0, np.int64),
            xyz=np.zeros((0, 3)),
            rgb=np.zeros((0, 3), np.uint8),
            error=np.zeros(0),
            track_start=np.zeros(1, np.int64),
            track_frame=np.zeros(0, np.int32),
            track_xy=np.zeros((0, 2)),
        )

    def select_observations(self, keep: NDArray[np.bool_], rank: NDArray[np.int32]) -> Points:
        """Keep some observations of all points, in frames of other indices.

        Args:
            keep: Observations that stay. [M]
            rank: New index of each frame. [F]
        """
        before = np.concatenate([[0], np.cumsum(keep)])
        return replace(
            self,
            track_start=before[self.track_start].astype(np.int64),
            track_frame=rank[self.track_frame[keep]],
            track_xy=self.track_xy[keep],
        )

    def select_observed(self, keep: NDArray[np.bool_], rank: NDArray[np.int32]) -> Points:
        """Keep some observations, as `select_observations`, and the points that have any of them.

        All points stay where none has observations, as in a laser scan.
        """
        if not self.track_frame.size:
            return self
        points = self.select_observations(keep, rank)
        return points.select(np.diff(points.track_start) > 0)


@dataclass(frozen=True, slots=True)
class Period:
    """One date of capture."""

    id: int
    label: str
    """Name for people; the id where no name is known."""
    date: str | None = None
    """ISO 8601 date, if known."""

    @property
    def title(self) -> str:
        """Id, and label in parentheses where it is more than the id."""
        return self.label if self.label == str(self.id) else f"{self.id} ({self.label})"


@dataclass(frozen=True, slots=True)
class WorldFrame:
    """Unit and reference system of the world coordinates."""

    unit: str = "unknown"
    """``metre``, or ``unknown``: COLMAP models have no unit of their own."""
    crs: str | None = None
    """Coordinate reference system of ``world + offset``, if known (``EPSG:32650``)."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to world coordinates to get coordinates in ``crs``."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One place, photographed at T periods, all cameras in one world frame."""

    name: str
    root: Path
    images_root: Path
    frames: tuple[Frame, ...]
    """Sorted by name."""
    points: Points
    periods: tuple[Period, ...]
    """Ids are 0..T-1 in this order."""
    split_rule: str
    """Origin of the split, in words: ``sparse/0/test.txt`` or the default rule."""
    format: str
    world: WorldFrame = field(default_factory=WorldFrame)
    masks: Mapping[str, Path] = field(default_factory=dict)
    """Mask files, by the names of the frames that have one."""

    @property
    def num_periods(self) -> int:
        return len(self.periods)

    def select(self, *, split: Split | None = None, period: int | None = None) -> tuple[Frame, ...]:
        """Return the frames of a split, of a period, or of both, in name order."""
        return tuple(
            f
            for f in self.frames
            if (split is None or f.split == split) and (period is None or f.period == period)
        )

    def image_path(self, frame: Frame) -> Path:
        return self.images_root / frame.name

    @property
    def frame_periods(self) -> NDArray[np.int64]:
        """Period of each frame. [F]"""
        return np.array([f.period for f in self.frames], np.int64)

    @property
    def frame_poses(self) -> NDArray[np.float64]:
        """``cam_from_world`` of each frame. [F, 4, 4]"""
        return np.stack([f.cam_from_world for f in self.frames])

    def count_views(self) -> NDArray[np.int64]:
        """Count the images of each period that see a point. [P, T]"""
        return count_views(*self._sightings(), (len(self.points), self.num_periods))

    def point_periods(self, frames: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Find the periods with images that see a point. [P, T]

        Args:
            frames: Frames that count; None for all. [F]
        """
        point, period = self._sightings()
        if frames is not None:
            counts = frames[self.points.track_frame]
            point, period = point[counts], period[counts]
        return seen_by_period(point, period, (len(self.points), self.num_periods))

    def _sightings(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return point and period of each observation. [M], [M]"""
        points = self.points
        return track_owners(points.track_start), self.frame_periods[points.track_frame]

    def with_frames(self, frames: Sequence[Frame]) -> Scene:
        """Replace the frames by others of the same names in the same order.

        Tracks refer to frames by index, so frames cannot be added, removed or reordered here.
        """
        assert [f.name for f in frames] == [f.name for f in self.frames]
        return replace(self, frames=tuple(frames))


def spread_frames(frames: Sequence[Frame], count: int) -> tuple[Frame, ...]:
    """Choose about so many frames, evenly in each period, at least one."""
    periods = sorted({frame.period for frame in frames})
    chosen: list[Frame] = []
    for period in periods:
        own = [frame for frame in frames if frame.period == period]
        number = min(len(own), math.ceil(count / len(periods)))
        chosen += (own[i * len(own) // number] for i in range(number))
    return tuple(chosen)
