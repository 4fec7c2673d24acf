"""A scene folder as it is on disk: read lazily, part by part, with nothing repaired.

A part that cannot be read is None, and `RawScene.reason` explains; rules that need it are skipped
with that reason. Nothing here raises for what is on disk; numbers may become infinite or NaN, so it
is used in `chronoscene.validation.run.quiet_numbers`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap import raw_model
from chronoscene.colmap.model import read_raw_model
from chronoscene.colmap.raw_model import FoundModel, RawImages, RawModel, RawPoints
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import DetectedFormat
from chronoscene.formats.chronoscene import MODEL, SPLIT, TEST, read_periods
from chronoscene.formats.shared.colmap_layout import Assigned
from chronoscene.images.masks import MASKS, mask_name, mask_place
from chronoscene.io.documents import decode_text
from chronoscene.scene import Camera, Period, splits
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.scene.grouping import grouped
from chronoscene.scene.splits import NameEntry, Problem, SplitEntry
from chronoscene.scene.tracks import seen_by_period
from chronoscene.validation.folder import observations, pixels
from chronoscene.validation.folder.names import is_safe
from chronoscene.validation.folder.observations import Observations, Reprojection
from chronoscene.validation.folder.pixels import Header, Pixels, Track

T = TypeVar("T")

MAX_CELLS = 500_000_000
"""Largest table of points times periods, in bytes. Real scenes have a few percent of this."""

_REASONS = {
    "model": f"there is no COLMAP model in {MODEL}",
    "cameras": "the cameras of the model cannot be read",
    "images": "the images of the model cannot be read",
    "points": "the points of the model cannot be read",
    "observations": "the images or the points of the model cannot be read",
    "reprojections": "the model cannot be read completely",
    "split": f"{SPLIT} cannot be read",
    "split_text": f"{SPLIT} cannot be read",
    "periods": f"{SPLIT} or the images of the model cannot be read",
    "test": "sparse/0/test.txt is absent or cannot be read",
    "tests": f"{SPLIT}, test.txt or the images of the model cannot be read",
    "point_periods": "points or periods cannot be read, or there are too many periods",
    "pixels": "images are decoded only with --decode",
}


def no_progress(items: Sequence[T], description: str) -> Iterable[T]:
    """A `Track` that shows nothing."""
    return items


@dataclass(frozen=True, slots=True)
class TextFile:
    """A small text file."""

    data: bytes
    text: str


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of a scene that is not in our format: converted from it, or a COLMAP project."""

    detected: DetectedFormat
    is_project: bool = False
    """True for a COLMAP project, which is checked where it is."""
    error: ChronoSceneError | None = None
    """Reason why the scene, or of a project the periods, cannot be read."""
    remarks: tuple[str, ...] = ()
    """Content of the folder that the conversion leaves out."""
    assigned: Assigned | None = None
    """Periods and tests of a COLMAP project."""


@dataclass(eq=False)
class RawScene:
    """One scene folder. Every attribute is read when it is first used, then kept."""

    root: Path
    decode: bool = False
    """True if rules may decode all images."""
    track: Track = no_progress
    """Shows the progress of slow parts."""
    origin: Origin | None = None
    memory: dict[Callable[[RawScene], Any], Any] = field(default_factory=dict, init=False)
    """Results of `derived` functions of this scene."""

    def reason(self, attribute: str) -> str:
        """Reason why an attribute is None."""
        if self.is_project and attribute in ("split", "split_text"):
            return f"{SPLIT} is no part of a COLMAP project"
        return _REASONS[attribute]

    @property
    def is_project(self) -> bool:
        """True for a COLMAP project without ``split.txt``."""
        return self.origin is not None and self.origin.is_project

    @property
    def _by_format(self) -> Assigned | None:
        return self.origin.assigned if self.origin is not None else None

    @property
    def period_place(self) -> str:
        """File or folder that defines the periods of the images."""
        return "images" if self.is_project else SPLIT

    def period_table(self) -> tuple[Period, ...]:
        """Labels and dates of the periods.

        Raises:
            ChronoSceneError: If the file that has them is invalid.
        """
        if self._by_format is not None:
            return self._by_format.grouped[1]
        return read_periods(self.root, len(self.period_ids))

    @cached_property
    def name(self) -> str:
        return self.root.resolve().name

    # The model.

    @cached_property
    def model_place(self) -> str | None:
        """Folder of the model, relative to the scene folder; None if there is none."""
        return None if self._found is None else self._found[0]

    @cached_property
    def _found(self) -> FoundModel | None:
        if self.origin is not None and self.origin.is_project:
            return self.origin.detected.model
        return raw_model.find_model(self.root)

    @property
    def model_images(self) -> str:
        """Folder of the images of a model in a wrong place."""
        return "images" if self._found is None else self._found[1]

    @cached_property
    def model(self) -> RawModel | None:
        place = self.model_place
        return None if place is None else read_raw_model(self.root / place)

    @property
    def cameras(self) -> tuple[Camera, ...] | None:
        return self.model.cameras if self.model else None

    @property
    def images(self) -> RawImages | None:
        return self.model.images if self.model else None

    @property
    def points(self) -> RawPoints | None:
        return self.model.points if self.model else None

    def model_file(self, stem: str) -> str:
        """Name of a model file for messages, relative to the scene folder."""
        file = self.model.files.get(stem, f"{stem}.bin") if self.model else f"{stem}.bin"
        return os.path.join(self.model_place or "", file)

    def image_place(self, name: str) -> str:
        """Place of an image of the model in messages."""
        return f"{self.model_file('images')} ({name})"

    def camera_place(self, camera: Camera) -> str:
        """Place of a camera in messages."""
        return f"{self.model_file('cameras')} (camera {camera.camera_id})"

    @cached_property
    def usable_cameras(self) -> dict[int, Camera]:
        """Cameras by id, those with a plausible size and focal length."""
        usable = (c for c in self.cameras or () if c.is_usable and c.model != "EQUIRECTANGULAR")
        return {camera.camera_id: camera for camera in usable}

    @cached_property
    def images_of_camera(self) -> dict[int, list[str]]:
        """Names of the images of each camera, by its id."""
        if self.images is None:
            return {}
        return grouped(zip(self.images.camera_ids.tolist(), self.images.names, strict=True))

    @cached_property
    def observations(self) -> Observations | None:
        if self.images is None or self.points is None:
            return None
        return observations.observe(self.images, self.points)

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """Camera centres in the world, NaN for invalid poses. [I, 3]"""
        if self.images is None:
            return np.zeros((0, 3))
        rotations = rotation_from_quaternion(self.images.quaternions)
        centres = -np.einsum("nji,nj->ni", rotations, self.images.translations)
        centres[~(observations.good_poses(self.images) & np.isfinite(centres).all(axis=1))] = np.nan
        return centres

    @cached_property
    def is_posed(self) -> NDArray[np.bool_]:
        """True for images with a camera centre. [I]"""
        return np.isfinite(self.centres[:, 0])

    @cached_property
    def reprojections(self) -> list[Reprojection] | None:
        """Reprojections in the images with a usable camera, a valid pose and observations."""
        images, points, seen = self.images, self.points, self.observations
        if self.cameras is None or images is None or points is None or seen is None:
            return None
        return list(observations.reproject(self.usable_cameras, images, points, seen))

    # Periods and split.

    @cached_property
    def split_text(self) -> TextFile | None:
        return None if self.is_project else read_text_file(self.root / SPLIT)

    @cached_property
    def _parsed_split(self) -> tuple[list[SplitEntry], list[Problem]]:
        return splits.parse_split_text(self.split_text.text) if self.split_text else ([], [])

    @property
    def split(self) -> list[SplitEntry] | None:
        """Readable lines of ``split.txt``."""
        return self._parsed_split[0] if self.split_text else None

    @cached_property
    def names(self) -> list[str]:
        """Names of the registered images that stay below ``images/``, sorted, each once."""
        return sorted({n for n in self.images.names if is_safe(n)}) if self.images else []

    @cached_property
    def _assigned(self) -> tuple[dict[str, int], list[Problem]]:
        if self._by_format is not None:
            return self._by_format.grouped[0], []
        return splits.assign_periods(self.names, self.split or [])

    @property
    def split_problems(self) -> list[Problem]:
        """All problems of ``split.txt``; problems with names only if the images can be read."""
        found = list(self._parsed_split[1])
        return found + (self._assigned[1] if self.periods is not None else [])

    @property
    def periods(self) -> dict[str, int] | None:
        """Period by image name, for the images that have exactly one."""
        if self.images is None or (self.split is None and self._by_format is None):
            return None
        return self._assigned[0]

    @cached_property
    def test_text(self) -> TextFile | None:
        return None if self.has_own_tests else read_text_file(self.root / TEST)

    @property
    def has_own_tests(self) -> bool:
        """True if the format itself defines the test images."""
        return self._by_format is not None and self._by_format.tests is not None

    @cached_property
    def test(self) -> list[NameEntry] | None:
        """Lines of ``test.txt``."""
        return splits.parse_test_text(self.test_text.text) if self.test_text else None

    @cached_property
    def _tested(self) -> tuple[set[str], list[Problem]]:
        return splits.assign_tests(self.names, self.test or [])

    @property
    def test_problems(self) -> list[Problem]:
        return self._tested[1]

    @cached_property
    def tests(self) -> set[str] | None:
        """Names of the test images, by ``test.txt`` or the default split."""
        if self.periods is None:
            return None
        if self._by_format is not None and self._by_format.tests is not None:
            return self._by_format.tests
        if self.test is not None:
            return self._tested[0]
        return None if os.path.lexists(self.root / TEST) else splits.default_tests(self.periods)

    @cached_property
    def image_periods(self) -> NDArray[np.int64]:
        """Index of the period of each image into `period_ids`, -1 for none. [I]"""
        periods = self.periods or {}
        index = {period: i for i, period in enumerate(self.period_ids)}
        names = self.images.names if self.images else ()
        return np.array([index[periods[n]] if n in periods else -1 for n in names], np.int64)

    @cached_property
    def point_periods(self) -> NDArray[np.bool_] | None:
        """True if a point is seen by an image of a period; columns as `period_ids`. [P, T]"""
        points, seen = self.points, self.observations
        if points is None or seen is None or self.periods is None:
            return None
        if len(points) * len(self.period_ids) > MAX_CELLS:
            return None
        period = np.append(self.image_periods, -1)[seen.image]
        rows = (period >= 0) & seen.valid
        shape = len(points), len(self.period_ids)
        return seen_by_period(seen.point[rows], period[rows], shape)

    @cached_property
    def period_ids(self) -> list[int]:
        """Ids of the periods that have images, sorted; there may be gaps."""
        return sorted(set((self.periods or {}).values()))

    # Files.

    @cached_property
    def files(self) -> list[str]:
        """Files below ``images/`` with an image extension, as relative names, sorted.

        Folders that are links are not looked into.
        """
        return _image_files(self.root / "images")

    def image_path(self, name: str) -> Path:
        return self.root / "images" / name

    @cached_property
    def present(self) -> list[str]:
        """Registered images with a file."""
        return [n for n in self.names if os.path.isfile(self.image_path(n))]

    @cached_property
    def headers(self) -> dict[str, Header]:
        """Headers of the present images."""
        return pixels.read_headers(self.root / "images", self.present)

    @cached_property
    def readable(self) -> dict[str, Header]:
        """Headers of the present images with a good one."""
        return {name: header for name, header in self.headers.items() if header.problem is None}

    @cached_property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the present files that have the same size as another; the rest are unique."""
        return pixels.hash_files(self.root / "images", self.present, self.track)

    @cached_property
    def mask_files(self) -> list[str]:
        """Files below ``masks/`` with an image extension, as relative names, sorted.

        Folders that are links are not looked into.
        """
        return _image_files(self.root / MASKS)

    @cached_property
    def mask_headers(self) -> dict[str, Header]:
        """Headers of the masks of present images, by the names of the images."""
        # Not those of `mask_files`, which lacks what is in folders that are links.
        there = (n for n in self.present if os.path.lexists(self.root / mask_place(n)))
        masked = {name: mask_name(name) for name in there}
        headers = pixels.read_headers(self.root / MASKS, list(masked.values()))
        return {name: headers[mask] for name, mask in masked.items()}

    @cached_property
    def pixels(self) -> dict[str, Pixels] | None:
        """Digests and thumbnails of the readable images, if they may be decoded."""
        if not self.decode:
            return None
        return pixels.read_pixels(self.root / "images", list(self.readable), self.track)


def derived(compute: Callable[[RawScene], T]) -> Callable[[RawScene], T]:
    """Compute a function of a scene once, although several rules call it."""

    @wraps(compute)
    def remembered(scene: RawScene) -> T:
        if compute not in scene.memory:
            scene.memory[compute] = compute(scene)
        return cast(T, scene.memory[compute])

    return remembered


def _image_files(top: Path) -> list[str]:
    """Files below a folder with an image extension, as relative names, sorted."""
    found = []
    for folder, _, files in os.walk(top):
        below = Path(folder).relative_to(top)
        found += [
            (below / file).as_posix()
            for file in files
            if file.lower().endswith(splits.IMAGE_SUFFIXES) and not file.startswith("._")
        ]
    return sorted(found)


def read_text_file(path: Path) -> TextFile | None:
    """Read a small text file; None if it is absent, not a regular file, or not text."""
    try:
        if not path.is_file():  # a pipe would block
            return None
        data = path.read_bytes()
        text = decode_text(data)
        return None if "\0" in text else TextFile(data, text)  # UTF-16 without its mark
    except (OSError, UnicodeDecodeError):
        return None
