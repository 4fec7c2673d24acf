"""The copy of a database without the tracks that are held out."""

import errno
from pathlib import Path

import numpy as np
import pytest

from chronoscene.errors import DiskFullError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features import holdout
from chronoscene.registration.features.database import keypoints_of, verified_matches


@pytest.mark.parametrize(("left", "held"), [(15, 0), (16, 10)])
def test_a_pair_keeps_sixteen_matches(tmp_path: Path, left: int, held: int) -> None:
    """Tracks stay in the model whose absence would leave a pair with fewer."""
    count = left + 10
    rows = np.stack([np.arange(count)] * 2, axis=1).astype(np.uint32)
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = rows
    with pycolmap.Database.open(str(tmp_path / "a.db")) as database:
        camera = database.write_camera(pycolmap.Camera(model="PINHOLE", width=64, height=48))
        for i in (1, 2):
            image = pycolmap.Image(name=f"{i}.jpg", camera_id=camera, image_id=i)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(i, np.random.default_rng(i).uniform(0, 48, (count, 2)))
        database.write_two_view_geometry(1, 2, geometry)
    names, matches = verified_matches(str(tmp_path / "a.db"))
    tracks = holdout.build_tracks(matches, keypoints_of(str(tmp_path / "a.db")))
    found = holdout._filtered_copy(
        tmp_path / "a.db", tmp_path / "b.db", tracks, tracks.of(1, np.arange(10))
    )
    assert found.sum() == held and len(names) == 2
    kept = verified_matches(str(tmp_path / "b.db"))[1][1, 2]
    assert kept[:, 0].tolist() == [*range(held, count)]


def test_a_full_disk_leaves_no_journals(tmp_path, monkeypatch):
    def full(source: Path, target: Path) -> None:
        for suffix in ("", "-wal", "-shm"):
            Path(f"{target}{suffix}").touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(holdout, "copy_database", full)
    nothing = np.zeros(0, np.int64)
    tracks = holdout.Tracks(nothing, nothing, nothing, {}, nothing)
    with pytest.raises(DiskFullError):
        holdout._filtered_copy(tmp_path / "a.db", tmp_path / "b.db", tracks, nothing)
    assert not list(tmp_path.iterdir())
