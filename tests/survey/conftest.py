"""The scene of `surveyed`, with a folder of photos."""

import pytest
from surveyed import make_scene, write_photos


@pytest.fixture
def scene(tmp_path):
    root = tmp_path / "scene"
    root.mkdir()
    made = make_scene(root)
    write_photos(made)
    return made
