"""Files appear complete or not at all."""

import pytest

from chronoscene.errors import ConfigError
from chronoscene.io.staging import check_outside, replacing, write_text_atomic


def test_text_is_utf8_with_plain_line_ends(tmp_path):
    path = tmp_path / "a.txt"
    write_text_atomic(path, "früher\nspäter\n")
    assert path.read_bytes() == "früher\nspäter\n".encode()
    write_text_atomic(path, "new\n")
    assert path.read_bytes() == b"new\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_block_that_fails_leaves_the_old_file_alone(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), replacing(path) as partial:
        partial.write_text("half")
        assert path.read_text() == "old"
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_put_in_place_leaves_nothing(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError):
        write_text_atomic(tmp_path / "folder", "text")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]
    with pytest.raises(FileNotFoundError):
        write_text_atomic(tmp_path / "absent" / "a.txt", "text")


def test_what_a_scene_links_to_is_inside_of_it(tmp_path):
    scene, photos = tmp_path / "scene", tmp_path / "photos"
    scene.mkdir()
    photos.mkdir()
    (scene / "images").symlink_to(photos)
    check_outside(tmp_path / "out", [scene])
    for place in (scene, scene / "out", photos, photos / "new" / "out"):
        with pytest.raises(ConfigError, match="expected a place outside the scene, found one in"):
            check_outside(place, [scene])
