"""Features of generated photos in the forms of hloc and COLMAP."""

from itertools import combinations
from pathlib import Path

import h5py
import numpy as np
import pytest

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.given.image_features import nearest
from chronoscene.registration.features.given.tasks import ImageFeatures
from chronoscene.registration.features.sift import sift_features
from chronoscene.scene import Scene

LABELS = ("2016", "2023")


@pytest.fixture(scope="session")
def captures(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of photos for each date."""
    root = tmp_path_factory.mktemp("given") / "captures"
    for frame in (f for f in truth.frames if int(f.name[-8:-4]) < 4):
        target = root / LABELS[frame.period] / frame.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(truth.image_path(frame))
    return root


@pytest.fixture(scope="session")
def features(captures: Path) -> dict[str, ImageFeatures]:
    """Features of each photo as a learned extractor gives them: positions, and floats."""
    found = {}
    mix = np.linalg.qr(np.random.default_rng(0).normal(size=(128, 128)))[0].astype(np.float32)
    for path in sorted(captures.rglob("*.jpg")):
        keypoints, descriptors = sift_features(path, None, max_image_size=400, max_features=1000)
        _, first = np.unique(keypoints[:, :2], axis=0, return_index=True)
        unit = descriptors[first].astype(np.float32) / 512
        name = path.relative_to(captures).as_posix()
        found[name] = ImageFeatures(keypoints[first, :2], unit @ mix, (400, 300))
    return found


Pairs = dict[tuple[str, str], np.ndarray]


@pytest.fixture(scope="session")
def pairs(features: dict[str, ImageFeatures]) -> Pairs:
    """Matches of each pair of photos, as a file has them."""
    found = {
        (a, b): nearest(features[a], features[b]).astype(np.int64)
        for a, b in combinations(sorted(features), 2)
    }
    return {pair: rows for pair, rows in found.items() if len(rows) > 15}


@pytest.fixture(scope="session")
def hloc(
    features: dict[str, ImageFeatures], pairs: Pairs, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """``features.h5`` and ``matches.h5``; every second pair is stored the other way round."""
    folder = tmp_path_factory.mktemp("hloc")
    with h5py.File(folder / "features.h5", "w", libver="latest") as file:
        for name, found in features.items():
            group = file.create_group(name)
            group.create_dataset("keypoints", data=found.keypoints - np.float32(0.5))
            group["keypoints"].attrs["uncertainty"] = 1.0
            group.create_dataset("descriptors", data=found.descriptors.T)
            group.create_dataset("scores", data=np.ones(len(found.keypoints), np.float16))
            group.create_dataset("image_size", data=np.array([400, 300]))
    with h5py.File(folder / "matches.h5", "w", libver="latest") as file:
        for number, ((a, b), rows) in enumerate(pairs.items()):
            if number % 2:
                a, b, rows = b, a, rows[:, ::-1]
            to = np.full(len(features[a].keypoints), -1, np.int16)
            to[rows[:, 0]] = rows[:, 1]
            group = file.create_group("/".join(n.replace("/", "-") for n in (a, b)))
            group.create_dataset("matches0", data=to)
            group.create_dataset("matching_scores0", data=np.ones(len(to), np.float16))
    return folder / "features.h5", folder / "matches.h5"


@pytest.fixture(scope="session")
def database(
    features: dict[str, ImageFeatures],
    pairs: Pairs,
    captures: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A database of COLMAP with the same, in which some pairs have verified matches only."""
    path = tmp_path_factory.mktemp("colmap") / "database.db"
    with pycolmap.Database.open(str(path)):
        pass
    pycolmap.import_images(str(path), str(captures), pycolmap.CameraMode.SINGLE, sorted(features))
    with pycolmap.Database.open(str(path)) as opened:
        ids = {str(i.name): int(i.image_id) for i in opened.read_all_images()}
        for name, found in features.items():
            kind = pycolmap.FeatureExtractorType.ALIKED_N16ROT
            opened.write_keypoints(ids[name], found.keypoints)
            data = found.descriptors.view(np.uint8)
            opened.write_descriptors(ids[name], pycolmap.FeatureDescriptors(kind, data))
        for number, ((a, b), rows) in enumerate(pairs.items()):
            if number % 5:
                opened.write_matches(ids[a], ids[b], rows.astype(np.uint32))
            else:
                geometry = pycolmap.TwoViewGeometry()
                geometry.inlier_matches = rows.astype(np.uint32)
                opened.write_two_view_geometry(ids[a], ids[b], geometry)
    return path
