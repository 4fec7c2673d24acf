"""MatrixCity: rendered blocks of a city, raw or with prepared poses.

- Raw: ``<block>/transforms.json`` with ``rot_mat`` for each frame, a camera-to-world matrix in
  metres whose rotation is scaled by 1/100; the image is ``<block>/<frame_index, 4 digits>.png``.
- Prepared: ``transforms_train.json`` and ``transforms_test.json`` (usually in ``pose/<block>/``),
  translations in units of 100 m. Raw files win where both are there.

Scenes are in metres. Blocks may be in folders; those named ``test`` hold test images, and
``train_dense`` is left out beside ``train``. One city has one date: blocks are one period, unless
every block is in a further folder, as in ``<period>/<block>/transforms.json``, or
``--period-by folder`` makes the first folders the periods.

There are no points: the offered clouds are separate downloads.

Source: Li et al., MatrixCity, ICCV 2023; layout as in ``city-super/MatrixCity`` at ``778775c``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from chronoscene.colmap.model import PosedImage
from chronoscene.errors import SceneError
from chronoscene.formats.shared import transforms
from chronoscene.formats.shared.colmap_layout import scan
from chronoscene.formats.shared.grouping import Grouped, group_labels, natural_key, rule_error
from chronoscene.formats.shared.transforms import CameraTable
from chronoscene.images.decoding import image_size
from chronoscene.io.documents import json_error, read_json_document
from chronoscene.scene import Period, Points, Scene, WorldFrame
from chronoscene.scene.splits import DEFAULT_RULE, default_tests

NAME = "matrixcity"
MARKS = "transforms.json with rot_mat, or pose/<block>/transforms_train.json"
"""Description of the marks that `matches` looks for."""

PERIOD_BY = ("one", "folder")  # All blocks in one period, or one period for each first folder

RAW = "transforms.json"
PREPARED = ("transforms_train.json", "transforms_test.json")
RAW_KEY = '"rot_mat"'

ROTATION_SCALE = 100.0
PREPARED_UNIT = 100.0  # Metres

PARTS_OF_A_CITY = ("train", "test", "train_dense", "pose", "aerial", "street")
"""Folders named after the purpose or the flight of images: neither blocks nor periods."""

OF_OTHER_SCENES = ("images", "sparse")
"""Folders that scenes of most formats have, and blocks of a city do not."""

MAX_DEPTH = 4
MAX_FOLDERS = 5000  # Folders that are searched, so that a wrong path does not take forever


@dataclass(frozen=True, slots=True)
class PoseFile:
    """A file with the poses of a block."""

    folder: str
    """Below the scene folder; "" for the scene folder."""
    name: str

    @property
    def parts(self) -> tuple[str, ...]:
        return PurePosixPath(self.folder).parts

    @property
    def labels(self) -> list[str]:
        """Folders that may name a period or a block."""
        return [part for part in self.parts if part not in PARTS_OF_A_CITY]

    @property
    def is_test(self) -> bool:
        return self.name == PREPARED[1] or "test" in self.parts


def matches(path: Path) -> bool:
    """Return True if there is a raw file, or a prepared one in a folder ``pose``.

    Not where only folders have these, and one is a scene of another format: they are scenes then,
    not blocks.
    """
    if is_raw(path / RAW):
        return True
    folders, _ = scan(path)
    if any((path / folder / part).is_dir() for folder in folders for part in OF_OTHER_SCENES):
        return False
    return any(
        file.name == RAW or "pose" in file.parts for files, _ in _walk(path) for file in files
    )


def is_raw(file: Path) -> bool:
    """Return True if a file with poses is a raw one, by its first bytes."""
    try:
        if not file.is_file():  # a pipe would never end
            return False
        with file.open("rb") as opened:
            return RAW_KEY.encode() in opened.read(65536)
    except OSError:
        return False


def read(path: Path, *, period_by: str | None = None) -> Scene:
    """Read a scene."""
    cameras = CameraTable()
    images: dict[str, PosedImage] = {}
    labels: dict[str, list[str]] = {}
    tests: set[str] = set()
    for file in _pose_files(path):
        for image in _read_file(path, file, cameras):
            _check_same(path, images.setdefault(image.name, image), image)
            labels.setdefault(image.name, file.labels)
            if file.is_test:
                tests.add(image.name)
    grouped = _group(path, labels, period_by)
    scene = transforms.make_scene(
        path,
        list(images.values()),
        grouped,
        tests or default_tests(grouped[0]),
        points=Points.empty(),
        rule="the files of test images" if tests else DEFAULT_RULE,
        format=NAME,
    )
    return replace(scene, world=WorldFrame("metre"))


def _check_same(path: Path, first: PosedImage, second: PosedImage) -> None:
    """Refuse two poses of an image: files may repeat it, as merged ones do, but must agree."""
    # Metres, or entries of a rotation: prepared files are rounded.
    if np.abs(first.cam_from_world - second.cam_from_world).max() > 0.01:
        raise SceneError(
            path / first.name,
            expected="the same pose in all pose files",
            found="two poses that differ by more than 0.01 m or 0.01 in the rotation",
            todo="remove the pose file that is wrong",
        )


def remarks(path: Path) -> list[str]:
    """List the content that does not become part of a scene."""
    found = ["the poses come without points, so the scene has none"]
    read = _pose_files(path)
    if left := [file for files, _ in _walk(path) for file in files if file not in read]:
        named = ", ".join(str(PurePosixPath(file.folder) / file.name) for file in left[:3])
        found.append(
            f"{len(left)} pose files are not read, as raw ones win over prepared ones and "
            f"train over train_dense: {named}{', ...' if len(left) > 3 else ''}"
        )
    return found


def _walk(path: Path) -> Iterator[tuple[list[PoseFile], str | None]]:
    """Every folder of a tree, in natural order: its pose files, and its name if it is orphaned.

    An orphan is a block with numbered images and no file of poses.
    """
    waiting, visited = [""], 0
    while waiting and visited < MAX_FOLDERS:
        folder, visited = waiting.pop(), visited + 1
        here = path / folder
        if is_raw(here / RAW):
            yield [PoseFile(folder, RAW)], None
            continue
        folders, images = scan(here)
        prepared = [PoseFile(folder, name) for name in PREPARED if (here / name).is_file()]
        numbered = any(re.fullmatch(r"[0-9]{4,}\.png", name) for name in images)
        yield prepared, folder if numbered else None
        if len(PurePosixPath(folder).parts) < MAX_DEPTH:
            below = sorted(folders, key=natural_key, reverse=True)
            waiting += [str(PurePosixPath(folder) / name) for name in below]


def _pose_files(path: Path) -> list[PoseFile]:
    """The files to read: raw ones if there are any; no ``train_dense`` beside ``train``."""
    walked = list(_walk(path))
    found = [file for files, _ in walked for file in files]
    orphans = [orphan for _, orphan in walked if orphan is not None]
    raw = [file for file in found if file.name == RAW]
    if not found or (orphans and len(raw) == len(found)):
        raise SceneError(
            path / orphans[0] if found else path,
            expected=f"{RAW} with {RAW_KEY} beside the images" if found else MARKS,
            found="none",
            todo="copy it again, or remove the block" if found else "choose another folder",
        )
    chosen = raw or found
    if any("train" in file.parts for file in chosen):
        chosen = [file for file in chosen if "train_dense" not in file.parts]
    return chosen


def _read_file(path: Path, file: PoseFile, cameras: CameraTable) -> list[PosedImage]:
    place = path / file.folder / file.name
    data = read_json_document(place)
    shared, images = transforms.shared_keys(data), list[PosedImage]()
    for i, frame in enumerate(transforms.read_frames(place, data)):
        where = f"{place}: frames[{i}]"
        if file.name == RAW:
            world_from_cam = transforms.matrix(where, frame.get("rot_mat"))
            world_from_cam[:3, :3] *= ROTATION_SCALE
            file_path: object = _raw_file_path(where, frame)
        else:
            world_from_cam = transforms.matrix(where, frame.get("transform_matrix"))
            world_from_cam[:3, 3] *= PREPARED_UNIT
            file_path = frame.get("file_path")
        name = transforms.image_name(where, path, file.folder, file_path)
        keys = transforms.frame_keys(shared, frame)
        if "w" not in keys or "h" not in keys:  # images of a block are of one size
            known = images[0].camera if images else None
            size = (known.width, known.height) if known else image_size(path / name)
            keys |= {"w": size[0], "h": size[1]}
        camera = cameras.camera(where, keys, path / name)
        pose = transforms.pose_from_opengl(where, world_from_cam)
        images.append(PosedImage(0, name, camera, pose))
    transforms.check_distinct(place, images)
    return images


def _raw_file_path(where: str, frame: dict[str, Any]) -> str:
    index = frame.get("frame_index")
    if type(index) is not int or not 0 <= index < 10**9:
        raise json_error(where, "a frame_index 0, 1, ...", repr(index)[:40])
    return f"{index:04d}.png"


def _group(path: Path, labels: dict[str, list[str]], by: str | None) -> Grouped:
    """Group images into periods by the folders of their files."""
    if by is None:
        by = "folder" if all(len(parts) >= 2 for parts in labels.values()) else "one"
    if by == "one":
        return dict.fromkeys(labels, 0), (Period(0, "0"),)
    if by != "folder":
        raise rule_error(by, PERIOD_BY)
    if not all(labels.values()):
        raise SceneError(
            path,
            expected="every block in a folder of its period",
            found="a block without one",
            todo="leave --period-by out, or give the folder above",
        )
    first = {name: parts[0] for name, parts in labels.items()}
    return group_labels(first, sorted(set(first.values()), key=natural_key))
