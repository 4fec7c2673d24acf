"""Features of the user in the whole command: they survive whole, and are named."""

import hashlib
import shutil
import unicodedata
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from chronoscene.errors import ConfigError, RegistrationError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.context import Context, Options
from chronoscene.registration.features.correspondences import Matched, find_matches
from chronoscene.registration.features.given.image_features import ImageFeatures
from chronoscene.registration.features.given.source import find_sources, match_names
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.photos.inputs import gather
from chronoscene.registration.work_folder import Stages, work_folder


def matched(captures: Path, work: Path, **options: Any) -> tuple[Matched, list[dict[str, Any]]]:
    """Features and matches alone, and the log."""
    with work_folder(work) as lock:
        context = Context(work, Stages(work), Options(threads=1, **options), None, lock)
        found = find_matches(gather(read_captures(captures), None, context), context)
        return found, context.stages.log


def stored(work: Path) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], set[tuple[int, int]]]]:
    """Keypoints and matches in the database of a work folder."""
    with pycolmap.Database.open(str(work / "features.db")) as opened:
        names = {int(i.image_id): str(i.name) for i in opened.read_all_images()}
        keypoints = {n: np.asarray(opened.read_keypoints(i)) for i, n in names.items()}
        found = {}
        for pair_id, rows in zip(*opened.read_all_matches(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            found[names[a], names[b]] = set(map(tuple, rows.tolist()))
    return keypoints, found


@pytest.mark.parametrize("form", ["hloc", "colmap"])
def test_features_and_matches_survive_whole(
    form: str,
    captures: Path,
    features: dict[str, ImageFeatures],
    pairs: dict[tuple[str, str], np.ndarray],
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    if form == "hloc":
        first, second = request.getfixturevalue("hloc")
        options = {"features": str(first), "matches": str(second)}
        files = [first, second]
    else:
        files = [request.getfixturevalue("database")]
        options = {"features": str(files[0])}
    before = [hashlib.sha256(f.read_bytes()).hexdigest() for f in files]
    found, _ = matched(captures, tmp_path / "work", **options)
    keypoints, matches = stored(tmp_path / "work")
    for name, given in features.items():
        np.testing.assert_allclose(keypoints[name], given.keypoints, atol=1e-4)
    assert matches == {pair: set(map(tuple, rows.tolist())) for pair, rows in pairs.items()}
    assert found.pairs_across["0-1"] >= 1
    assert all(digest[:12] in found.made_by for digest in before)
    assert [hashlib.sha256(f.read_bytes()).hexdigest() for f in files] == before
    assert len(list(files[0].parent.iterdir())) == len(files)  # nothing appeared beside them


@pytest.mark.slow
def test_a_changed_file_runs_again_what_depends_on_it(
    captures: Path, hloc: tuple[Path, Path], tmp_path: Path
) -> None:
    files = [shutil.copy(path, tmp_path) for path in hloc]
    options = dict(zip(("features", "matches"), map(str, files), strict=True))
    matched(captures, tmp_path / "work", **options)
    _, log = matched(captures, tmp_path / "work", **options)
    assert [s["stage"] for s in log if s["from_an_earlier_run"]] == [
        "photos",
        "features",
        "matches",
    ]
    with h5py.File(files[1], "r+") as file:
        group = file[next(iter(file))]
        rows = group[next(iter(group))]["matches0"]
        removed = int((rows[()] != -1).sum())
        rows[:] = -1
    before = sum(map(len, stored(tmp_path / "work")[1].values()))
    _, log = matched(captures, tmp_path / "work", **options)
    assert "matches" not in [s["stage"] for s in log if s["from_an_earlier_run"]]
    assert removed and sum(map(len, stored(tmp_path / "work")[1].values())) == before - removed


@pytest.mark.slow
def test_a_photo_that_a_file_lacks_is_not_extracted_again(
    captures: Path, hloc: tuple[Path, Path], features: dict[str, ImageFeatures], tmp_path: Path
) -> None:
    path = Path(shutil.copy(hloc[0], tmp_path))
    lost = sorted(features)[0]
    with h5py.File(path, "r+") as file:
        del file[lost]
    found, log = matched(captures, tmp_path / "work", features=str(path))
    assert found.keypoints[lost] == 0
    assert found.absent == {lost}
    assert any(f"{lost}: not in the file" in r for s in log for r in s["remarks"])
    assert found.pairs_across["0-1"] >= 1  # matched by their descriptors


class _Entry:
    """An entry point of a package."""

    class dist:  # noqa: N801
        name, version = "learned", "1.2"

    def __init__(self, name: str, value: Any) -> None:
        self.name, self.value = name, value

    def load(self) -> Any:
        return self.value


def test_installed_extractors_and_matchers(
    captures: Path, features: dict[str, ImageFeatures], monkeypatch: pytest.MonkeyPatch
) -> None:
    from chronoscene.registration.features.given import source, tasks

    def extract(path: Path, mask: Path | None) -> tuple[np.ndarray, np.ndarray]:
        found = features[path.relative_to(captures).as_posix()]
        return found.keypoints, found.descriptors

    groups = {
        "chronoscene.extractors": [_Entry("mine", extract)],
        "chronoscene.matchers": [_Entry("pairs", lambda a, b: [[0, 3], [1, 2], [1, 2]])],
    }
    monkeypatch.setattr(source, "entry_points", lambda group: groups[group])
    given = find_sources("mine", "pairs")
    assert given is not None and source.describe(given).startswith("features of mine (learned 1.2)")
    name = sorted(features)[0]
    read, _, _ = tasks.extractor(given, captures, sorted(features))
    assert read(captures / name, None)[1].dtype == np.float32
    both = [features[n] for n in sorted(features)[:2]]
    assert tasks.matcher(given)(*both).tolist() == [[0, 3], [1, 2]]
    with pytest.raises(ConfigError, match=r"an installed plug-in \(mine\), found 'other'"):
        find_sources("other", None)


def test_matches_without_features_are_refused(hloc: tuple[Path, Path]) -> None:
    with pytest.raises(ConfigError, match="--matches: expected the features"):
        find_sources(None, str(hloc[1]))


def test_names_fit_by_their_end() -> None:
    photos = ["2016/a.jpg", "2016/b.tif.png", "2023/c_d.jpg"]
    found = match_names("f", photos, ["images/2016/a.jpg", "b.tif", "2023/c d.jpg", "z.jpg"])
    assert found == dict(zip(photos, ["images/2016/a.jpg", "b.tif", "2023/c d.jpg"], strict=True))
    form = partial(unicodedata.normalize, "NFD")
    assert match_names("f", [form("Süd/ä.jpg")], ["ä.jpg"]) == {form("Süd/ä.jpg"): "ä.jpg"}
    with pytest.raises(RegistrationError, match=r"fits 2016/a\.jpg and 2023/a\.jpg"):
        match_names("f", ["2016/a.jpg", "2023/a.jpg"], ["a.jpg"])
    with pytest.raises(RegistrationError, match="found none of them"):
        match_names("f", photos, ["q.jpg"])
