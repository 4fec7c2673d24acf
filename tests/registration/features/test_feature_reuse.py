"""Photos that are added, removed or replaced: what still holds is not computed again."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import RegistrationError
from chronoscene.formats import read_scene
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.context import Context, Options
from chronoscene.registration.features import correspondences, feature_reuse
from chronoscene.registration.features.correspondences import Matched, find_matches
from chronoscene.registration.features.database import write_pairs
from chronoscene.registration.features.extraction import extract
from chronoscene.registration.features.matching import match
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.photos.inputs import gather
from chronoscene.registration.work_folder import TASKS, Stages, work_folder
from chronoscene.synth import SynthSettings, generate

SETTINGS = SynthSettings(
    periods=1, width=320, height=240, views=6, points=600, blocks=2, supersample=1
)

ALL = ["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"]


@dataclass
class Ran:
    """Work done by one run of features and matches."""

    carried: tuple[int, int] = (0, 0)
    """Photos and pairs."""
    computed: dict[str, int] = field(default_factory=dict)
    """Number of ``features`` (photos) and ``pairs`` that were left to do."""

    def report(self, what: str, done: int, total: int) -> None:
        self.computed.setdefault(what, total - done)


@dataclass
class Work:
    """A work folder."""

    folder: Path
    photos: Path
    threads: int = 1

    @property
    def database(self) -> Path:
        return self.folder / "features.db"

    def arguments(
        self, groups: Sequence[Sequence[str]], max_features: int = 1000
    ) -> dict[str, Any]:
        return {
            "database": str(self.database),
            "photos": str(self.photos),
            "groups": [
                {"names": sorted(names), "model": "SIMPLE_RADIAL", "params": None}
                for names in groups
            ],
            "max_image_size": 1600,
            "max_features": max_features,
            "threads": self.threads,
        }

    def extract(self, groups: Sequence[Sequence[str]], ran: Ran, max_features: int = 1000) -> int:
        self.folder.mkdir(exist_ok=True)
        return int(extract(self.arguments(groups, max_features), ran.report)["carried"])

    def match(self, pairs: Sequence[tuple[str, str]], ran: Ran) -> int:
        write_pairs(self.folder / "pairs.txt", pairs)
        arguments = {
            "database": str(self.database),
            "pairs": str(self.folder / "pairs.txt"),
            "scratch": str(self.folder),
            "threads": self.threads,
        }
        return int(match(arguments, ran.report)["carried"])

    def run(self, *groups: Sequence[str], max_features: int = 1000) -> Ran:
        """Features and matches of photos, in groups that share a camera."""
        ran = Ran()
        photos = self.extract(groups, ran, max_features)
        ran.carried = photos, self.match(every_pair(*groups), ran)
        return ran

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


def every_pair(*groups: Sequence[str]) -> list[tuple[str, str]]:
    return list(combinations(sorted(name for names in groups for name in names), 2))


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
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("generated")
    generate(root / "scene", SETTINGS)
    scene = read_scene(root / "scene")
    (root / "photos").mkdir()
    for name, frame in zip(ALL, scene.frames, strict=False):
        shutil.copyfile(scene.image_path(frame), root / "photos" / name)
    return root / "photos"


@pytest.fixture(scope="module")
def complete(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A work folder that has all photos, with one camera; not to be changed."""
    work = Work(tmp_path_factory.mktemp("complete"), photos)
    assert work.run(ALL) == Ran((0, 0), {"features": 6, "pairs": 15})
    content = work.content()
    verified = [key for key, value in content.items() if is_verified(key, value)]
    assert len(verified) >= 2
    return work.folder


@pytest.fixture
def work(complete: Path, photos: Path, tmp_path: Path) -> Work:
    """A copy of the work folder with all photos."""
    shutil.copytree(complete, tmp_path / "work")
    return Work(tmp_path / "work", photos)


@pytest.fixture(scope="module")
def from_scratch(
    complete: Path, photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., dict[Any, Any]]:
    """Content of a database of some of the photos that nothing was reused in."""
    known: dict[Any, Any] = {(tuple(ALL),): Work(complete, photos).content()}

    def content(*groups: Sequence[str]) -> dict[Any, Any]:
        key = tuple(tuple(names) for names in groups)
        if key not in known:
            work = Work(tmp_path_factory.mktemp("scratch") / "work", photos)
            work.run(*groups)
            known[key] = work.content()
        return known[key]

    return content


@pytest.fixture
def check(photos: Path, tmp_path: Path, from_scratch: Callable[..., Any]) -> Callable[..., None]:
    """Compares a work folder with one from scratch."""

    def same_as_from_scratch(work: Work, *groups: Sequence[str]) -> None:
        if work.photos == photos:
            expected = from_scratch(*groups)
        else:
            scratch = Work(tmp_path / "scratch", work.photos)
            scratch.run(*groups)
            expected = scratch.content()
        assert work.content() == expected
        left = sorted(p.name for p in work.folder.iterdir())
        assert left == ["features.db", "features.json", "pairs.txt"]

    return same_as_from_scratch


@pytest.mark.slow
def test_the_number_of_threads_changes_nothing(
    photos: Path, tmp_path: Path, check: Callable[..., None]
) -> None:
    work = Work(tmp_path / "work", photos, threads=3)
    work.run(ALL)
    check(work, ALL)


@pytest.mark.slow
def test_nothing_of_another_extractor_is_reused(
    photos: Path, tmp_path: Path, check: Callable[..., None]
) -> None:
    """A work folder of an earlier version, which had COLMAP's features, is continued with ours."""
    work = Work(tmp_path / "work", photos)
    work.extract([ALL[:4]], Ran())
    record = json.loads((work.folder / "features.json").read_text())
    record["settings"]["method"] = 1
    del record["settings"]["opencv"]
    (work.folder / "features.json").write_text(json.dumps(record))
    work.database.unlink()
    pycolmap.Database.open(work.database).close()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    pycolmap.extract_features(work.database, photos, ALL[:4], extraction_options=options)
    matches = pycolmap.FeatureMatchingOptions()
    matches.use_gpu, matches.num_threads = False, 1
    pycolmap.match_exhaustive(work.database, matches)
    assert work.run(ALL) == Ran((0, 0), {"features": 6, "pairs": 15})
    check(work, ALL)


@pytest.mark.parametrize("added", ["0.jpg", "3.jpg"])
def test_only_a_photo_that_is_added_is_computed(
    added: str, photos: Path, tmp_path: Path, check: Callable[..., None]
) -> None:
    work = Work(tmp_path / "work", photos)
    work.run([name for name in ALL if name != added])
    assert work.run(ALL) == Ran((5, 10), {"features": 1, "pairs": 5})
    check(work, ALL)


@pytest.mark.parametrize("removed", ["0.jpg", "3.jpg"])
def test_nothing_is_computed_when_a_photo_is_removed(
    removed: str, work: Work, check: Callable[..., None]
) -> None:
    left = [name for name in ALL if name != removed]
    assert work.run(left) == Ran((5, 10), {"features": 0, "pairs": 0})
    check(work, left)


@pytest.mark.parametrize(
    ("before", "after", "carried"),
    [
        # Pairs within a group share a camera as before, others do not any more.
        ([ALL[:4]], [ALL[:1], ALL[1:4]], 3),
        # The order of the ids turns between groups.
        ([ALL[:2], ALL[2:4]], [ALL[2:4], ALL[:2]], 2),
    ],
)
def test_pairs_of_other_cameras_are_matched_anew(
    before: list[list[str]],
    after: list[list[str]],
    carried: int,
    photos: Path,
    tmp_path: Path,
    check: Callable[..., None],
) -> None:
    work = Work(tmp_path / "work", photos)
    work.run(*before)
    assert work.run(*after) == Ran((4, carried), {"features": 0, "pairs": 6 - carried})
    check(work, *after)


def test_cameras_that_a_geometry_suggests_have_the_new_ids(photos: Path, tmp_path: Path) -> None:
    """COLMAP stores the fitted focal length with a geometry if none is known."""
    work = Work(tmp_path / "work", photos)
    work.run(ALL[:1], ALL[1:4])
    with pycolmap.Database.open(work.database) as opened:
        camera = opened.read_camera(2)
        geometry = opened.read_two_view_geometry(2, 3)
        camera.params = [123.0, 160.0, 120.0, 0.0]
        geometry.camera1 = geometry.camera2 = camera
        opened.update_two_view_geometry(2, 3, geometry)
    assert work.run(ALL[1:4]).carried == (3, 3)
    with pycolmap.Database.open(work.database) as opened:
        carried = opened.read_two_view_geometry(1, 2)
    for suggested in (carried.camera1, carried.camera2):
        assert suggested is not None
        assert (suggested.camera_id, suggested.params[0]) == (1, 123.0)


def test_a_photo_with_other_content_is_computed_anew(
    work: Work, tmp_path: Path, check: Callable[..., None]
) -> None:
    shutil.copytree(work.photos, tmp_path / "photos")
    work.photos = tmp_path / "photos"
    shutil.copyfile(work.photos / "4.jpg", work.photos / "2.jpg")
    (work.photos / "4.jpg").unlink()
    names = [name for name in ALL if name != "4.jpg"]
    # The new 2.jpg is the old 4.jpg: its features are known, and its pairs with 0, 1 and 5. The
    # pair with 3 had the other order.
    assert work.run(names) == Ran((5, 9), {"features": 0, "pairs": 1})
    check(work, names)
    shutil.copyfile(work.photos / "1.jpg", work.photos / "5.jpg")
    with (work.photos / "5.jpg").open("ab") as file:
        file.write(b"other content")
    assert work.run(names) == Ran((4, 6), {"features": 1, "pairs": 4})


def test_photos_may_be_links_under_other_names(
    work: Work, tmp_path: Path, check: Callable[..., None]
) -> None:
    originals, work.photos = work.photos, tmp_path / "photos"
    names = [f"2016/photo-{name}" for name in ALL]
    (work.photos / "2016").mkdir(parents=True)
    for name, original in zip(names, ALL, strict=True):
        (work.photos / name).symlink_to(originals / original)
    assert work.run(names) == Ran((6, 15), {"features": 0, "pairs": 0})
    check(work, names)


def test_photos_that_swap_names_are_matched_anew(
    photos: Path, tmp_path: Path, check: Callable[..., None]
) -> None:
    """The order of their names turns, whatever becomes of their ids."""
    work = Work(tmp_path / "work", photos)
    work.run(["0.jpg"], ["1.jpg"])
    work.photos = tmp_path / "photos"
    work.photos.mkdir()
    shutil.copyfile(photos / "0.jpg", work.photos / "1.jpg")
    shutil.copyfile(photos / "1.jpg", work.photos / "0.jpg")
    assert work.run(["1.jpg"], ["0.jpg"]) == Ran((2, 0), {"features": 0, "pairs": 1})
    check(work, ["1.jpg"], ["0.jpg"])


def test_nothing_is_reused_with_other_settings(work: Work) -> None:
    ran = work.run(ALL, max_features=500)
    assert ran == Ran((0, 0), {"features": 6, "pairs": 15})
    assert work.run(ALL, max_features=500).computed == {"features": 0, "pairs": 0}


def test_a_photo_whose_mask_changes_gets_new_features(work: Work) -> None:
    def draw(covered: int) -> None:
        mask = np.full((240, 320), 255, np.uint8)
        mask[:covered] = 0
        place = work.photos.parent / "masks" / f"{ALL[2]}.png"
        place.parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(place)

    work.photos = Path(shutil.copytree(work.photos, work.folder / "photos"))
    for covered in (60, 120):
        draw(covered)
        assert work.run(ALL) == Ran((5, 10), {"features": 1, "pairs": 5})
        with pycolmap.Database.open(work.database) as opened:
            image = opened.read_image_with_name(ALL[2])
            assert opened.read_keypoints(image.image_id)[:, 1].min() > covered - 1
    assert work.run(ALL).computed == {"features": 0, "pairs": 0}


def test_nothing_is_reused_from_another_pycolmap(
    work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pycolmap, "__version__", "0.0")
    assert work.run(ALL).carried == (0, 0)


@pytest.mark.parametrize("damage", ["database", "record"])
def test_a_damaged_database_is_of_no_use(
    damage: str, work: Work, check: Callable[..., None]
) -> None:
    path = work.database if damage == "database" else work.database.with_suffix(".json")
    path.write_bytes(b"no such thing" * 1000)
    assert work.run(ALL[:3]) == Ran((0, 0), {"features": 3, "pairs": 3})
    check(work, ALL[:3])


def test_pairs_that_are_listed_no_more_are_dropped(work: Work) -> None:
    verified = [key for key, value in work.content().items() if is_verified(key, value)]
    pairs = [pair for pair in every_pair(ALL) if pair not in verified[::2]]
    work.match(pairs, Ran())
    content = work.content()
    assert [key for key, value in content.items() if is_verified(key, value)] == verified[1::2]


class Killed(BaseException):
    """No handler of errors sees this one."""


class Countdown:
    """Lets calls through until one is its last."""

    def __init__(self, patch: pytest.MonkeyPatch, calls: int) -> None:
        self.left, self.patch = calls, patch

    def watch(self, owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def called(*args: Any, **options: Any) -> Any:
            self.left -= 1
            if self.left == 0:
                raise Killed
            return original(*args, **options)

        self.patch.setattr(owner, name, called)


@pytest.mark.parametrize("begun", [False, True])
def test_a_kill_between_any_two_changes_of_files_loses_nothing(
    begun: bool,
    work: Work,
    tmp_path: Path,
    check: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if begun:  # an old database is there still
        with monkeypatch.context() as patch:
            patch.setattr(feature_reuse, "_remove", lambda database: None)
            work.extract([ALL[1:]], Ran())
        assert (work.folder / "features-old.db").exists()
    kills = 0
    while True:
        copy = Work(tmp_path / f"copy-{kills}", work.photos)
        shutil.copytree(work.folder, copy.folder)
        with monkeypatch.context() as patch:
            countdown = Countdown(patch, kills + 1)
            countdown.watch(Path, "unlink")
            countdown.watch(Path, "replace")
            try:
                copy.run(ALL[2:])
            except Killed:
                kills += 1
            else:
                break
        for partial in copy.folder.glob(".*"):
            partial.unlink()
        # Reused, or in the new database already.
        assert set(copy.run(ALL[2:]).computed.values()) == {0}
    assert kills >= 6
    check(copy, ALL[2:])


@pytest.mark.parametrize("step", ["write_keypoints", "write_descriptors", "write_matches"])
@pytest.mark.parametrize("calls", [1, 3])
def test_a_kill_within_a_copy_loses_nothing(
    step: str, calls: int, work: Work, check: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        Countdown(patch, calls).watch(pycolmap.Database, step)
        with pytest.raises(Killed):
            work.run(ALL[1:])
    assert work.run(ALL[1:]) == Ran((5, 10), {"features": 0, "pairs": 0})
    check(work, ALL[1:])


KILLED = """
import json, os, signal, sys
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.extraction import extract

write, calls = pycolmap.Database.write_two_view_geometry, []

def kill(*arguments):
    calls.append(arguments)
    if len(calls) == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return write(*arguments)

pycolmap.Database.write_two_view_geometry = kill
extract(json.loads(sys.argv[1]), lambda *progress: None)
"""


def test_a_process_that_is_killed_while_it_copies(work: Work, check: Callable[..., None]) -> None:
    command = [sys.executable, "-c", KILLED, json.dumps(work.arguments([ALL[1:]]))]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert work.run(ALL[1:]) == Ran((5, 10), {"features": 0, "pairs": 0})
    check(work, ALL[1:])


def test_the_database_of_a_process_that_was_killed_is_set_aside_whole(
    work: Work, tmp_path: Path, check: Callable[..., None]
) -> None:
    first = Work(tmp_path / "first", work.photos)
    code = (
        "import os, signal, sys; from chronoscene.io.pycolmap import pycolmap\n"
        "opened = pycolmap.Database.open(sys.argv[1])\n"
        "a, b = sorted(i.image_id for i in opened.read_all_images())[-2:]\n"
        "opened.delete_matches(a, b); opened.delete_two_view_geometry(a, b)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    first.run(ALL[:5])
    subprocess.run([sys.executable, "-c", code, str(first.database)], check=False)
    assert Path(f"{first.database}-wal").stat().st_size > 0
    assert first.run(ALL) == Ran((5, 9), {"features": 1, "pairs": 6})
    check(first, ALL)


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


def matched(captures: Path, seed: int = 0) -> tuple[Matched, dict[str, list[str]], Ran]:
    """The stages up to the matches, as the command does them, and their remarks."""
    work, ran = captures.with_name("captures.work"), Ran()
    options = Options(threads=1, max_features=1000, seed=seed)
    with work_folder(work) as lock:
        context = Context(work, Stages(work), options, ran.report, lock)
        found = find_matches(
            gather(read_captures(captures / "periods.csv"), None, context), context
        )
    return found, {entry["stage"]: entry["remarks"] for entry in context.stages.log}, ran


@pytest.mark.slow
def test_another_way_to_compute_features_does_the_stage_again(
    captures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table(captures, "2016", "2016", "2023", "2023")
    assert "features" in matched(captures)[2].computed
    assert "features" not in matched(captures)[2].computed
    monkeypatch.setattr(correspondences, "METHOD", "another")
    assert "features" in matched(captures)[2].computed


@pytest.mark.slow
def test_the_command_goes_on_from_the_run_before(
    captures: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table(captures, "2016", "2016", "2023", "2023")
    first, remarks, _ = matched(captures)
    assert "reused" not in str(remarks)
    assert remarks["matches"][0] == "6 pairs (6 exhaustive), 4 across periods"

    write_table(captures, "2016", "2023", "2023", "2023")
    moved, remarks, ran = matched(captures)
    assert (ran.computed.get("features"), ran.computed["pairs"]) == (None, 0)
    assert remarks["matches"][0] == "6 pairs (6 exhaustive), 3 across periods"
    assert moved.partners == first.partners

    shutil.copyfile(photos / ALL[4], captures / ALL[4])
    write_table(captures, "2016", "2023", "2023", "2023", "2016")
    more, remarks, _ = matched(captures)
    verified = remarks["matches"][1]
    assert remarks["features"][1:] == ["4 of 5 photos: features reused from an earlier run"]
    assert remarks["matches"][2] == "6 of 10 pairs: matches reused from an earlier run"
    assert moved.keypoints.items() <= more.keypoints.items()

    # A photo goes, and comes back after a kill: then the record of the stage speaks of matches
    # that the database has no more.
    write_table(captures, "2016", "2023", "2023", "2023")
    with monkeypatch.context() as patch:
        patch.setitem(TASKS, "matches", "no_such_module:killed")
        with pytest.raises(RegistrationError, match="no_such_module"):
            matched(captures)
    write_table(captures, "2016", "2023", "2023", "2023", "2016")
    again, remarks, ran = matched(captures, seed=1)
    reused = "6 of 10 pairs: matches reused from an earlier run"
    assert remarks["matches"][1:3] == [verified, reused]
    assert ran.computed["pairs"] == 4
    assert again.partners == more.partners
