"""Models that are trained first and teach the model that stays.

What a long training adds is more and more of what single photos show. Models of several seeds err
differently elsewhere, so that the mean of their images is closer to the truth than each of them is.
The model that stays learns from the photos and from such means, seen from between the photos:
distillation (Hinton et al. 2015) at views without a photo, where CoR-GS (Zhang et al. 2024) lets
two models correct each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from chronoscene.methods import Prediction, TrainingSet, TrainingView, View
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation

VIEWS_PER_PHOTO = 4
"""Views that the teachers show, to each photo."""
NEAREST = 4
"""Photos of the same period between which such a view may lie."""
MEMORY = 2**29
"""Bytes that their images may take: with large photos there are fewer views."""


class Teacher(Protocol):
    """The part of `chronoscene.methods.Method` that teaching asks for."""

    def render(self, view: View, period: float) -> Prediction: ...

    def save(self, folder: Path) -> None: ...

    def load(self, folder: Path, *, device: str) -> None: ...


Files = Mapping[str, bytes]
"""A saved model: the content of its files, by name."""


@dataclass
class Lessons:
    """The models of a training, one after the other.

    Teachers take equal shares of the first half of the training, the model that stays the second.
    """

    count: int
    """Of the teachers."""
    seed: int
    train: TrainingSet
    device: str
    taught: list[Files] = field(default_factory=list)
    """The teachers that are trained."""
    first: int = 0
    """Step at which the present model began."""

    def is_over(self, progress: float) -> bool:
        """Whether the present model is a teacher whose share of the training is over."""
        done = len(self.taught)
        return done < self.count and progress >= (done + 1) / (2 * self.count) - 1e-9

    def end(self, method: Teacher, index: int) -> None:
        """Keep a teacher; the next model begins with the step of this number."""
        with TemporaryDirectory() as folder:
            method.save(Path(folder))
            files = {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
        self.taught.append(files)
        self.first = index

    def own_time(self, index: int, progress: float) -> tuple[int, float]:
        """Number of a step and progress, counted from the beginning of the present model."""
        own = index - self.first
        if len(self.taught) < self.count:
            return own, max(progress * 2 * self.count - len(self.taught), 0.0)
        # A share of the steps that are expected, so that a training can go on for longer.
        return own, progress * own / (index - progress * self.first) if own else 0.0

    def own_seed(self) -> int:
        """Of the present model. The one that stays has that of the training."""
        number = len(self.taught)
        if number == self.count:
            return self.seed
        return int(np.random.SeedSequence((self.seed, 4, number)).generate_state(1)[0])

    def training_set(self, make: Callable[[], Teacher]) -> TrainingSet:
        """What the present model learns from.

        Args:
            make: Gives an empty method, to load a teacher.
        """
        train = self.train
        if len(self.taught) < self.count:
            return train
        teachers = [self._load(files, make()) for files in self.taught]
        views = views_between(train, np.random.default_rng((self.seed, 5)))
        shown = [mean_image(teachers, view) for view in views]
        photos = len(train.views)

        def load_image(index: int) -> NDArray[np.uint8]:
            return train.load_image(index) if index < photos else shown[index - photos]

        def load_mask(index: int) -> NDArray[np.bool_] | None:
            return train.load_mask(index) if index < photos else None

        def expect(indices: Sequence[int]) -> None:
            train.expect([index for index in indices if index < photos])

        return replace(
            train,
            views=(*train.views, *views),
            load_image=load_image,
            load_mask=load_mask,
            expect=expect,
        )

    def _load(self, files: Files, method: Teacher) -> Teacher:
        with TemporaryDirectory() as folder:
            for name, content in files.items():
                (Path(folder) / name).write_bytes(content)
            method.load(Path(folder), device=self.device)
        return method

    def write(self, folder: Path) -> dict[str, int]:
        """Write the teachers beside a training; returns what `read` asks for."""
        for number, files in enumerate(self.taught):
            for name, content in files.items():
                (folder / f"{_prefix(number)}{name}").write_bytes(content)
        return {"taught": len(self.taught), "first": self.first}

    def read(self, folder: Path, values: Mapping[str, int]) -> None:
        """Inverse of `write`."""
        self.first, self.taught = values["first"], []
        for number in range(values["taught"]):
            paths = sorted(folder.glob(f"{_prefix(number)}*"))
            files = {p.name.removeprefix(_prefix(number)): p.read_bytes() for p in paths}
            self.taught.append(files)


def _prefix(number: int) -> str:
    """Of the names of a teacher's files."""
    return f"teacher-{number}-"


def views_between(train: TrainingSet, generator: np.random.Generator) -> list[TrainingView]:
    """Views at random places between a photo and one of the nearest of its period, at any period
    that has photos.

    Their sizes and intrinsics are those of the photo.
    """
    poses = np.stack([view.cam_from_world for view in train.views]).astype(np.float64)
    periods, centres = np.array([view.period for view in train.views]), camera_centre(poses)
    largest = max(view.width * view.height * 3 for view in train.views)
    count = min(VIEWS_PER_PHOTO * len(poses), MEMORY // largest)
    views = []
    for number in range(count):
        here = int(generator.integers(len(poses)))
        of_period = np.flatnonzero(periods == periods[here])
        _, near = cKDTree(centres[of_period]).query(centres[here], min(NEAREST + 1, len(of_period)))
        there = int(generator.choice(of_period[np.atleast_1d(near)]))
        share, period = generator.random(), int(generator.choice(np.unique(periods)))
        pose = pose_between(poses[here], poses[there], share)
        name = f"between {number}"
        views.append(replace(train.views[here], cam_from_world=pose, name=name, period=period))
    return views


def pose_between(
    first: NDArray[np.float64], second: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    """A camera on the way from one to another: its centre on a line, its rotation turning evenly.

    Args:
        first: ``cam_from_world``. [4, 4]
        second: Likewise.
        share: Of the way, 0..1.
    """
    rotations = Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]]))
    rotation = Slerp([0.0, 1.0], rotations)(share).as_matrix()
    centre = (1.0 - share) * camera_centre(first) + share * camera_centre(second)
    pose: NDArray[np.float64] = pose_from_rotation_translation(rotation, -rotation @ centre)
    return pose


def mean_image(teachers: Sequence[Teacher], view: TrainingView) -> NDArray[np.uint8]:
    """What the teachers show in a view at its period. [H, W, 3]"""
    total = sum(teacher.render(view, float(view.period)).rgb.clip(0, 1) for teacher in teachers)
    return np.asarray(total / len(teachers) * 255 + 0.5).astype(np.uint8)
