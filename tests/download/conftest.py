"""A dataset on a stand-in of the hub."""

import pytest
from hub_standin import serving

from chronoscene.download.catalogue import DATASETS


@pytest.fixture
def hub(monkeypatch):
    """Serves as ``HF_ENDPOINT`` what a test puts into its ``files``; tries again at once."""
    monkeypatch.setattr("huggingface_hub.file_download.time.sleep", lambda seconds: None)
    # What arrives is written in pieces of this size, 10 MB otherwise.
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1_000)
    with serving(DATASETS["chronoscene"].repo, {}) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server
