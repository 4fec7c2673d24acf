"""Models of pycolmap in files."""

import resource
from pathlib import Path

import pytest

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.models import write_model


def test_a_model_that_a_full_disk_cut_short_is_not_taken(tmp_path: Path) -> None:
    """COLMAP itself does not notice; a limit on the size of files stands for the disk."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
    model = pycolmap.synthesize_dataset(options)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        with pytest.raises((IndexError, RuntimeError, ValueError)):
            write_model(model, tmp_path / "model", str(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not (tmp_path / "model").exists()
    write_model(model, tmp_path / "model", str(tmp_path))
    assert pycolmap.Reconstruction(tmp_path / "model").num_points3D() == model.num_points3D()
