"""Features and matches of some photos: what is stored is kept, unless it is of something else."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import RegistrationError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.context import Context, Options
from chronoscene.registration.features import correspondences, extraction
from chronoscene.registration.features.correspondences import Matched, find_matches
from chronoscene.registration.features.database import write_pairs
from chronoscene.registration.features.extraction import extract
from chronoscene.registration.features.matching import match
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.photos.inputs import gather
from chronoscene.registration.work_folder import TASKS, Stages, work_folder
from chronoscene.scene import Scene

ALL = ["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"]

Left = dict[str, int]
"""Number of ``features`` (photos) and ``pairs`` that a run found left to do."""


@dataclass
class Work:
    """A work folder."""

    folder: Path
    photos: Path
    threads: int = 1

    def run(self, names: Sequence[str] = ALL, max_features: int = 1000) -> Left:
        """Features and matches of photos of one camera."""
        left: Left = {}

        def report(what: str, done: int, total: int) -> None:
            left.setdefault(what, total - done)

        self.folder.mkdir(exist_ok=True)
        group = {"names": sorted(names), "model": "SIMPLE_RADIAL", "params": None}
        arguments = {
            "database": str(self.database),
            "photos": str(self.photos),
            "groups": [group],
            "max_image_size": 1600,
            "max_features": max_features,
            "threads": self.threads,
        }
        extract(arguments, report)
        self.match(list(combinations(sorted(names), 2)), report)
        return left

    def match(self, pairs: Sequence[tuple[str, str]], report: Callable[..., None]) -> None:
        arguments = {
            "database": str(self.database),
            "pairs": str(self.folder / "pairs.txt"),
            "threads": self.threads,
        }
        write_pairs(self.folder / "pairs.txt", pairs)
        match(arguments, report)

    @property
    def database(self) -> Path:
        return self.folder / "features.db"

    def content(self) -> dict[Any, Any]:
        """All that later stages read: of images by name, of pairs by names."""
        with pycolmap.Database.open(self.database) as opened:
            ids = {str(i.name): int(i.image_id) for i in opened.read_all_images()}
            found: dict[Any, Any] = {"ids": ids, "cameras": str(opened.read_all_cameras())}
            for name, i in ids.items():
                keypoints, descriptors = opened.read_keypoints(i), opened.read_descriptors(i)
                found[name] = keypoints.tobytes(), descriptors.data.tobytes()
            for a, b in combinations(sorted(ids), 2):
                if opened.exists_two_view_geometry(ids[a], ids[b]):
                    geometry = opened.read_two_view_geometry(ids[a], ids[b])
                    matches = opened.read_matches(ids[a], ids[b])
                    found[a, b] = matches.tobytes(), exactly(geometry)
        return found


def is_verified(key: Any, value: Any) -> bool:
    """Return True if an entry of the content is a pair with inliers."""
    return isinstance(key, tuple) and value[1][1] != b""


def exactly(geometry: Any) -> tuple[Any, ...]:
    """A geometry to the last bit, with the cameras that it suggests."""
    matrices = (geometry.F, geometry.E, geometry.H)
    return (
        geometry.config,
        geometry.inlier_matches.tobytes(),
        *(None if m is None else m.tobytes() for m in matrices),
        str((geometry.camera1, geometry.camera2)),
    )


@pytest.fixture(scope="module")
def photos(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first photos of the city."""
    root = tmp_path_factory.mktemp("photos")
    for name, frame in zip(ALL, truth.frames, strict=False):
        shutil.copyfile(truth.image_path(frame), root / name)
    return root


@pytest.fixture(scope="module")
def complete(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Work:
    """A work folder that has all photos; not to be changed."""
    work = Work(tmp_path_factory.mktemp("complete"), photos)
    assert work.run() == {"features": 6, "pairs": 15}
    assert sum(is_verified(*item) for item in work.content().items()) >= 2
    return work


@pytest.fixture
def work(complete: Work, tmp_path: Path) -> Work:
    """A copy of the work folder with all photos, and of these."""
    shutil.copytree(complete.folder, tmp_path / "work")
    return Work(tmp_path / "work", Path(shutil.copytree(complete.photos, tmp_path / "photos")))


def test_nothing_is_computed_twice(work: Work) -> None:
    assert work.run() == {"features": 0, "pairs": 0}


@pytest.mark.slow
def test_the_number_of_threads_changes_nothing(complete: Work, tmp_path: Path) -> None:
    work = Work(tmp_path / "work", complete.photos, threads=3)
    work.run()
    assert work.content() == complete.content()


def test_a_run_that_was_killed_goes_on(
    complete: Work, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, stored = Work(tmp_path / "work", complete.photos), []

    def store_some(database: str, name: str, features: Any) -> None:
        if len(stored) == 4:
            raise KeyboardInterrupt
        stored.append(name)
        original(database, name, features)

    original = extraction.store_features
    with monkeypatch.context() as patch:
        patch.setattr(extraction, "store_features", store_some)
        with pytest.raises(KeyboardInterrupt):
            work.run()
    assert work.run() == {"features": 2, "pairs": 15}
    assert work.content() == complete.content()


@pytest.mark.parametrize(
    "before", [pytest.param(ALL[1:], marks=pytest.mark.slow), [*ALL[:3], *ALL[4:]]]
)
def test_other_photos_are_begun_anew(before: list[str], complete: Work, tmp_path: Path) -> None:
    work = Work(tmp_path / "work", complete.photos)
    work.run(before)
    assert work.run() == {"features": 6, "pairs": 15}
    assert work.content() == complete.content()


def test_photos_with_other_content_are_begun_anew(work: Work) -> None:
    shutil.copyfile(work.photos / "4.jpg", work.photos / "2.jpg")
    assert work.run() == {"features": 6, "pairs": 15}


def test_photos_may_be_links(work: Work, tmp_path: Path) -> None:
    originals, work.photos = work.photos, tmp_path / "linked"
    work.photos.mkdir()
    for name in ALL:
        (work.photos / name).symlink_to(originals / name)
    assert work.run() == {"features": 0, "pairs": 0}


def test_nothing_is_kept_with_other_settings(work: Work) -> None:
    assert work.run(max_features=500) == {"features": 6, "pairs": 15}
    assert work.run(max_features=500) == {"features": 0, "pairs": 0}


@pytest.mark.parametrize("where", ["features", "pycolmap"])
def test_nothing_of_another_version_is_kept(
    where: str, work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner, name = (extraction, "METHOD") if where == "features" else (pycolmap, "__version__")
    monkeypatch.setattr(owner, name, "0.0")
    assert work.run() == {"features": 6, "pairs": 15}


def test_photos_whose_mask_changes_get_new_features(work: Work) -> None:
    for covered in (60, 120):
        mask = np.full((300, 400), 255, np.uint8)
        mask[:covered] = 0
        place = work.photos.parent / "masks" / f"{ALL[2]}.png"
        place.parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(place)
        assert work.run() == {"features": 6, "pairs": 15}
        with pycolmap.Database.open(work.database) as opened:
            image = opened.read_image_with_name(ALL[2])
            assert opened.read_keypoints(image.image_id)[:, 1].min() > covered - 1
    assert work.run() == {"features": 0, "pairs": 0}


def test_a_database_without_its_record_is_of_no_use(work: Work, complete: Work) -> None:
    work.database.write_bytes(b"no such thing" * 1000)
    work.database.with_suffix(".json").write_bytes(b"no such thing" * 1000)
    assert work.run() == {"features": 6, "pairs": 15}
    assert work.content() == complete.content()


def test_pairs_that_are_listed_no_more_are_dropped(work: Work) -> None:
    verified = [key for key, value in work.content().items() if is_verified(key, value)]
    pairs = [pair for pair in combinations(ALL, 2) if pair not in verified[::2]]
    work.match(pairs, lambda *progress: None)
    content = work.content()
    assert [key for key, value in content.items() if is_verified(key, value)] == verified[1::2]


@pytest.fixture
def captures(photos: Path, tmp_path: Path) -> Path:
    """A folder of four photos."""
    shutil.copytree(photos, tmp_path / "captures")
    for name in ALL[4:]:
        (tmp_path / "captures" / name).unlink()
    return tmp_path / "captures"


def write_table(folder: Path, *periods: str) -> None:
    rows = [f"{name},{period}" for name, period in zip(ALL, periods, strict=False)]
    (folder / "periods.csv").write_text("\n".join(["image,period", *rows]) + "\n")


def matched(captures: Path, seed: int = 0) -> tuple[Matched, dict[str, list[str]], Left]:
    """The stages up to the matches, as the command does them, and their remarks."""
    work, left = captures.with_name("captures.work"), Left()

    def report(what: str, done: int, total: int) -> None:
        left.setdefault(what, total - done)

    options = Options(threads=1, max_features=1000, seed=seed)
    with work_folder(work) as lock:
        context = Context(work, Stages(work), options, report, lock)
        found = find_matches(
            gather(read_captures(captures / "periods.csv"), None, context), context
        )
    return found, {entry["stage"]: entry["remarks"] for entry in context.stages.log}, left


@pytest.mark.slow
def test_another_way_to_compute_features_does_the_stage_again(
    captures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table(captures, "2016", "2016", "2023", "2023")
    assert "features" in matched(captures)[2]
    assert "features" not in matched(captures)[2]
    monkeypatch.setattr(correspondences, "METHOD", "another")
    assert "features" in matched(captures)[2]


@pytest.mark.slow
def test_the_command_goes_on_from_the_run_before(
    captures: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table(captures, "2016", "2016", "2023", "2023")
    first, remarks, _ = matched(captures)
    assert remarks["matches"][0] == "6 pairs (6 exhaustive), 4 across periods"

    write_table(captures, "2016", "2023", "2023", "2023")
    moved, remarks, left = matched(captures)
    assert (left.get("features"), left["pairs"]) == (None, 0)
    assert remarks["matches"][0] == "6 pairs (6 exhaustive), 3 across periods"
    assert moved.partners == first.partners

    shutil.copyfile(photos / ALL[4], captures / ALL[4])
    write_table(captures, "2016", "2023", "2023", "2023", "2016")
    more, remarks, _ = matched(captures)
    verified = remarks["matches"][1]
    assert moved.keypoints.items() <= more.keypoints.items()

    # A photo goes, and comes back after a kill: then the record of the stage speaks of matches
    # that the database has no more.
    write_table(captures, "2016", "2023", "2023", "2023")
    with monkeypatch.context() as patch:
        patch.setitem(TASKS, "matches", "no_such_module:killed")
        with pytest.raises(RegistrationError, match="no_such_module"):
            matched(captures)
    write_table(captures, "2016", "2023", "2023", "2023", "2016")
    again, remarks, left = matched(captures, seed=1)
    assert remarks["matches"][1] == verified
    assert left["pairs"] == 10
    assert again.partners == more.partners
