"""The scene of `surveyed`, with a folder of photos."""

import pytest
from PIL import Image
from surveyed import make_scene


@pytest.fixture
def scene(tmp_path):
    root = tmp_path / "scene"
    root.mkdir()
    made = make_scene(root)
    for frame in made.frames:
        made.image_path(frame).parent.mkdir(exist_ok=True)
        Image.new("RGB", frame.camera.size).save(made.image_path(frame))
    return made
