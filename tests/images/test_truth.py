"""Where the files of the truth lie, and change masks at the size of the evaluation."""

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import ImageError
from chronoscene.images.truth import (
    APPEARANCE,
    GEOMETRY,
    UNCHANGED,
    changed_at_all,
    check_distinct,
    load_changes,
    load_depth,
    load_other,
    truth_place,
)


def save(folder, view, other, values):
    path = folder / truth_place("change", view, other)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(values, np.uint8)).save(path)
    return path


def test_places():
    assert truth_place("change", "a/x.1.jpg", 2) == "change/a/x.1__p2.png"
    assert truth_place("cross_rgb", "x.jpg", 10) == "cross_rgb/x__p10.jpg"
    assert truth_place("depth", "x.jpg") == "depth/x.npz"


def test_views_that_share_their_files_are_refused(tmp_path):
    check_distinct(tmp_path / "none", ["a/x.jpg", "a/x.png"])
    check_distinct(tmp_path, ["a/x.jpg", "b/x.jpg", "a/y.jpg"])
    with pytest.raises(ImageError, match=r"found a/x\.jpg and a/x\.png, which share their files"):
        check_distinct(tmp_path, ["a/x.jpg", "b/x.jpg", "a/x.png"])


def test_values_of_users(tmp_path):
    path = save(tmp_path, "x.png", 1, [[0, 127, 255, 1]])
    expected = [[UNCHANGED, APPEARANCE, GEOMETRY, GEOMETRY]]
    assert load_changes(path, (4, 1), 1600).tolist() == expected


def test_what_is_resized_is_unchanged_where_no_change_comes_in(tmp_path):
    """Sixteen columns become eight; the bicubic filter reaches four of the sixteen to each side."""
    values = np.zeros((6, 16), np.uint8)
    values[:, 12:] = APPEARANCE
    values[:, 15] = GEOMETRY
    path = save(tmp_path, "x.png", 1, values)
    found = load_changes(path, (8, 3), 8)
    assert found.tolist() == [[0, 0, 0, 0, 127, 127, 255, 255]] * 3


def test_a_pixel_changed_if_it_differs_from_at_least_one_other_period(tmp_path):
    save(tmp_path, "a/x.png", 0, [[0, 255, 0, 0]])
    save(tmp_path, "a/x.png", 2, [[0, 0, 127, 0]])
    found = changed_at_all(tmp_path, "a/x.png", (0, 2), (4, 1), 1600)
    assert found.tolist() == [[False, True, True, False]]
    assert changed_at_all(tmp_path, "a/y.png", (0, 2), (4, 1), 1600) is None
    with pytest.raises(ImageError, match=r"x__p3\.png: expected an image, found nothing"):
        changed_at_all(tmp_path, "a/x.png", (0, 2, 3), (4, 1), 1600)


def test_a_mask_of_another_size(tmp_path):
    path = save(tmp_path, "x.png", 1, np.zeros((4, 6)))
    with pytest.raises(ImageError, match="evaluated at 8 x 3, found 6 x 4"):
        load_changes(path, (8, 3), 8)
    Image.fromarray(np.zeros((3, 8, 3), np.uint8)).save(path)
    with pytest.raises(ImageError, match="one channel of 8 bits"):
        load_changes(path, (8, 3), 8)


def test_what_is_not_known_and_what_is_damaged(tmp_path):
    assert load_other(tmp_path, "x.jpg", 1, (4, 1)) is None
    assert load_depth(tmp_path, "x.jpg", None) is load_depth(tmp_path, "x.jpg", 1) is None
    path = tmp_path / "cross_depth/x__p1.npz"
    path.parent.mkdir()
    np.savez(path, depth=np.full((2, 3), 7, np.float32))
    np.testing.assert_array_equal(load_depth(tmp_path, "x.jpg", 1), np.full((2, 3), 7.0))
    np.savez(path, other=np.ones(3))
    for _ in range(2):
        with pytest.raises(ImageError, match=r"x__p1\.npz: expected an array named depth"):
            load_depth(tmp_path, "x.jpg", 1)
        path.write_bytes(path.read_bytes()[:50])
