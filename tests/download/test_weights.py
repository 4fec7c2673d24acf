"""The files of LPIPS go where the metric looks for them."""

import hashlib
from dataclasses import replace

import pytest

from chronoscene.download import weights
from chronoscene.errors import DownloadError
from chronoscene.metrics.lpips_weights import candidate_files


@pytest.fixture
def served(hub, monkeypatch):
    """Both files, with other contents, on the stand-in."""
    hub.files = {file.path: file.path.encode() * 100 for file in weights.LPIPS_WEIGHTS}
    url = f"{hub.url}/datasets/{hub.repo}/resolve/{'0123456789abcdef' * 2}01234567/"
    files = [
        replace(
            file,
            url=url + file.path,
            size=len(hub.files[file.path]),
            checksum=hashlib.sha256(hub.files[file.path]).hexdigest(),
        )
        for file in weights.LPIPS_WEIGHTS
    ]
    monkeypatch.setattr(weights, "LPIPS_WEIGHTS", files)
    return hub


def test_files_are_where_the_metric_looks(served, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = weights.fetch_lpips_weights(None, report=lambda *step: None)
    assert folder == tmp_path / "hub" / "checkpoints"
    found = [path for path in candidate_files() if path.parent == folder]
    assert [path.read_bytes() for path in found] == list(served.files.values())


def test_damaged_weights_are_not_kept(served, tmp_path):
    served.damaged = set(served.files)
    with pytest.raises(DownloadError, match=r"'vgg16-397923af.pth', 'lpips-vgg-v0.1.pth'"):
        weights.fetch_lpips_weights(tmp_path, report=lambda *step: None)
    assert not list(tmp_path.iterdir())


def test_checksum_is_the_one_in_the_name_of_the_file():
    backbone = weights.LPIPS_WEIGHTS[0]
    assert backbone.path == f"vgg16-{backbone.checksum[:8]}.pth"
