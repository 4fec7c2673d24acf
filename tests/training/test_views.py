"""Order of the views, and sizes of their photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.harness.train import painted_balls
from chronoscene.methods import SparseDepths, TrainingView
from chronoscene.training import views
from chronoscene.training.views import (
    AHEAD,
    PhotoSizes,
    PhotosOnDevice,
    ViewSampler,
    coarse_view,
    downscale_image,
    downscale_view,
    with_halved_photos,
)


@given(st.integers(1, 40), st.integers(0, 2**32), st.integers(1, 4))
def test_every_pool_holds_every_view_once(count, seed, pools):
    sampler = ViewSampler(count, seed)
    for _ in range(pools):
        assert sorted(sampler.next() for _ in range(count)) == list(range(count))


@given(st.integers(1, 20), st.integers(0, 100), st.integers(0, 60))
def test_a_resumed_sampler_continues_the_order(count, seed, done):
    whole = ViewSampler(count, seed)
    expected = [whole.next() for _ in range(done + 15)][done:]
    resumed = ViewSampler(count, seed)
    resumed.drawn = done
    assert [resumed.next() for _ in range(15)] == expected


@given(st.integers(1, 100), st.integers(0, 100), st.integers(0, 250))
def test_each_draw_says_what_the_next_ones_will_be(count, seed, done):
    """Up to one pass ahead, also where a new pool begins and where a training goes on."""
    said = []
    sampler = ViewSampler(count, seed, said.append)
    sampler.drawn = done
    drawn = [sampler.next() for _ in range(3 * AHEAD)]
    for i in range(AHEAD):
        assert said[i] == drawn[i : i + min(1 + AHEAD, count)]
    assert len(sampler._pools) <= 2


def test_the_order_depends_on_the_seed_and_changes_between_pools():
    orders = []
    for seed in (0, 1):
        sampler = ViewSampler(50, seed)
        orders += [[sampler.next() for _ in range(50)] for _ in range(2)]
    assert len({tuple(order) for order in orders}) == 4


def test_no_views_is_an_error():
    with pytest.raises(ValueError, match="at least 1"):
        ViewSampler(0, 0)


def view(width: int, height: int) -> TrainingView:
    K = np.array([[50.0, 0.0, 0.5 * width], [0.0, 60.0, 0.4 * height], [0.0, 0.0, 1.0]])
    return TrainingView(K, width, height, np.eye(4), "a.jpg", 0)


def test_auto_is_one_view_up_to_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {}
    for threads in (1, 2, 3, 4, 7, 8, 64):
        monkeypatch.setattr(views, "num_workers", lambda: threads)  # noqa: B023
        found[threads] = views.count_views("auto")
        assert views.count_views(5) == 5
    assert found == {1: 1, 2: 1, 3: 1, 4: 2, 7: 3, 8: 4, 64: 4}


@pytest.mark.parametrize(("total", "most"), [(10, 1), (10, 3), (12, 3), (1_000, 4), (999_999, 7)])
def test_steps_of_several_views_end_where_the_training_does(total: int, most: int) -> None:
    index, seen = 0, []
    while index < total:
        seen.append(views.views_of_step(most, index, index / total))
        index += seen[-1]
    assert index == total and set(seen[:-1]) <= {most}


@pytest.mark.parametrize("count", [1, 3, 4])
def test_what_is_due_at_an_interval_is_due_once(count: int) -> None:
    due = [index for index in range(0, 60, count) if views.is_due(index, count, 10)]
    ends = [10 * (i + 1) for i in range(6)]
    assert len(due) == 6
    assert all(index < end <= index + count for index, end in zip(due, ends, strict=True))


@pytest.mark.parametrize(("size", "factor"), [((8, 6), 2), ((9, 7), 2), ((10, 10), 4), ((3, 1), 2)])
def test_sizes_agree(size: tuple[int, int], factor: int) -> None:
    small = downscale_view(view(*size), factor)
    image = downscale_image(np.zeros((size[1], size[0], 3), np.uint8), factor)
    assert image.shape == (small.height, small.width, 3)


def test_a_pixel_is_the_rounded_mean_of_its_square() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (7, 9, 3)).astype(np.uint8)
    small = downscale_image(image, 2)
    mean = image[4:6, 2:4].astype(float).mean(axis=(0, 1))
    np.testing.assert_allclose(small[2, 1], mean, atol=0.5)


def test_a_point_lands_at_the_same_place() -> None:
    """The centre of a square of pixels is the centre of the pixel that stands for it."""
    original = view(8, 6)
    small = downscale_view(original, 2)
    point = np.linalg.inv(original.K) @ [5.0, 3.0, 1.0]  # corner of pixels (4, 2) and (5, 3)
    np.testing.assert_allclose(small.K @ point, [2.5, 1.5, 1.0])
    np.testing.assert_array_equal(original.K[0], [50.0, 0.0, 4.0])


def test_large_photos_are_halved_with_their_masks_and_depths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(views, "HALVED_PIXELS", 7 * 5)
    rng = np.random.default_rng(0)
    photos = [rng.integers(0, 256, (h, w, 3)).astype(np.uint8) for h, w in ((5, 7), (4, 6))]
    mask = np.ones((5, 7), bool)
    mask[1, 2] = mask[4, 0] = False  # the last row and column fill no pixel
    depths = SparseDepths(
        np.array([0, 8, 9, 6, 34]), np.array([5.0, 4.0, 3.0, 2.0, 1.0], np.float32)
    )
    whole = replace(
        painted_balls.make_training_set(1),
        views=(view(7, 5), view(6, 4)),
        load_image=lambda i: photos[i],
        load_mask=lambda i: None if i else mask,
        load_depths=lambda i: depths,
    )
    small = with_halved_photos(whole)
    assert [(v.width, v.height) for v in small.views] == [(3, 2), (6, 4)]
    np.testing.assert_array_equal(small.load_image(0), downscale_image(photos[0], 2))
    np.testing.assert_array_equal(small.load_mask(0), [[True, False, True], [True, True, True]])
    found = small.load_depths(0)
    np.testing.assert_array_equal(found.pixels, [0, 1])
    np.testing.assert_array_equal(found.depths, [4.0, 3.0])
    assert small.load_image(1) is photos[1] and small.load_mask(1) is None
    assert small.load_depths(1) is depths and small.views[1] is whole.views[1]

    sizes = PhotoSizes(whole, 0.25)
    changes = [sizes.change(progress) for progress in (0.0, 0.24, 0.25, 1.0)]
    assert [None if c is None else c.views[0].width for c in changes] == [3, None, 7, None]
    assert changes[2] is whole and PhotoSizes(whole, 0.0).change(0.0) is None
    monkeypatch.setattr(views, "HALVED_PIXELS", 7 * 5 + 1)
    assert with_halved_photos(whole) is whole


@pytest.mark.parametrize(
    ("size", "factor"), [((48, 36), 1), ((640, 479), 1), ((640, 480), 2), ((1201, 901), 3)]
)
def test_coarse_views_keep_pixels_enough(size: tuple[int, int], factor: int) -> None:
    small = coarse_view(view(*size))
    assert (small.width, small.height) == (size[0] // factor, size[1] // factor)


def test_a_gpu_keeps_the_photos_and_masks_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    photos, masks, loaded = np.zeros((3, 10, 20, 3), np.uint8), np.ones((3, 10, 20), bool), []

    class Three:
        def load_image(self, number: int) -> np.ndarray:
            loaded.append(("photo", number))
            return photos[number]

        def load_mask(self, number: int) -> np.ndarray | None:
            loaded.append(("mask", number))
            return masks[number] if number else None

    room = int(2.5 * photos[0].nbytes / views.SHARE_OF_GPU)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (room, 2 * room))
    monkeypatch.setattr(views, "to_device", lambda array, device: torch.from_numpy(array))
    kept = PhotosOnDevice(Three(), torch.device("cuda"))  # type: ignore[arg-type]
    for number in (0, 1, 2, 0, 1, 2):
        assert kept.photo(number).shape == (10, 20, 3)
    assert loaded == [("photo", n) for n in (0, 1, 2, 2)]
    loaded.clear()
    assert kept.mask(0) is None and kept.mask(1) is kept.mask(1)
    assert loaded == [("mask", 0), ("mask", 1)]
    loaded.clear()
    none = PhotosOnDevice(Three(), torch.device("cpu"))  # type: ignore[arg-type]
    assert none.photo(0) is not none.photo(0) and none.mask(1) is not none.mask(1)
    assert len(loaded) == 4
