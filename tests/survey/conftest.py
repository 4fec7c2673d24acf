"""The scene of `surveyed`, with a folder."""

import pytest
from surveyed import make_scene


@pytest.fixture
def scene(tmp_path):
    root = tmp_path / "scene"
    root.mkdir()
    return make_scene(root)
