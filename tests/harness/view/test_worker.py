"""The newest request of each viewer is drawn, small while it moves, and complete at rest."""

import threading
import time
from concurrent.futures import CancelledError

import pytest
from waiting import wait_for

from chronoscene.harness.view.worker import FULL, LEAST, SHARE, UPDATES, RenderWorker, Resolution

SIZE = (400, 400)


@pytest.fixture
def worker():
    made = RenderWorker()
    yield made
    made.stop()


def draw(resolution, fixed, per_pixel, *, moving=1, pictures=40):
    """Let a picture take so long, time and again; return how many pixels it has in the end."""
    for _ in range(pictures):
        seconds = fixed + per_pixel * resolution.pixels
        resolution.observe(resolution.pixels, seconds)
        resolution.adapt(seconds, moving)
    return resolution.pixels


@pytest.mark.parametrize("per_pixel", [1e-8, 3e-7, 1e-3])
def test_pictures_take_the_time_that_there_is(per_pixel):
    affordable = (SHARE / UPDATES - 0.004) / per_pixel
    expected = pytest.approx(min(max(affordable, LEAST), FULL), rel=0.05)
    assert draw(Resolution(), 0.004, per_pixel) == expected


@pytest.mark.parametrize("fixed", [0.1, 0.3])
def test_what_takes_its_time_anyway_is_not_drawn_in_tiny_pictures(fixed):
    """As models with 300,000 and a million anchors do."""
    assert draw(Resolution(), fixed, 1e-7) == pytest.approx(fixed / 3 / 1e-7, rel=0.05)


def test_another_model_is_found_out_after_a_rest():
    resolution = Resolution()
    draw(resolution, 0.3, 1e-7)
    resolution.rest()
    draw(resolution, 0.0, 3e-7)
    resolution.rest()
    assert draw(resolution, 0.0, 3e-7) == pytest.approx(SHARE / UPDATES / 3e-7, rel=0.1)


def test_two_that_move_share_the_time():
    alone, beside = draw(Resolution(), 0, 1e-6), draw(Resolution(), 0, 1e-6, moving=2)
    assert beside == pytest.approx(alone / 2, rel=0.05)


def test_one_slow_picture_changes_little():
    assert draw(Resolution(), 60.0, 0, pictures=1) == pytest.approx(0.6 * 320 * 240)


def test_the_worker_learns_what_takes_its_time_anyway(worker):
    pixels = []

    def decode(size):
        time.sleep(0.06)
        pixels.append(size)

    for number in range(1, 13):
        worker.request("a", decode, SIZE)
        wait_for(lambda number=number: len(pixels) >= number)
    assert pixels[2] < pixels[0] < pixels[11]


def test_stopping_tells_if_a_picture_goes_on(worker, monkeypatch):
    monkeypatch.setattr("chronoscene.harness.view.worker.PATIENCE", 0.05)
    begun, go = threading.Event(), threading.Event()
    worker.request("a", lambda pixels: begun.set() or go.wait(10), SIZE)
    assert begun.wait(10)
    assert not worker.stop()
    go.set()
    wait_for(worker.stop)


def test_only_the_newest_request_is_drawn(worker):
    begun, go, drawn = threading.Event(), threading.Event(), []

    def slow(pixels):
        begun.set()
        go.wait(5)

    worker.request("a", slow, SIZE)
    assert begun.wait(5)
    for number in range(10):
        worker.request("a", lambda pixels, number=number: drawn.append(number), (8, 8))
    go.set()
    wait_for(lambda: drawn)
    time.sleep(0.05)
    assert drawn == [9]


def test_a_picture_at_rest_becomes_complete_and_then_nothing_is_drawn(worker):
    pixels = []
    worker.request("a", pixels.append, SIZE)
    wait_for(lambda: pixels and pixels[-1] == 400 * 400)
    assert pixels == [320 * 240, 400 * 400]
    time.sleep(0.3)
    assert len(pixels) == 2


def test_a_small_canvas_is_complete_at_once(worker):
    pixels = []
    worker.request("a", pixels.append, (20, 10))
    wait_for(lambda: pixels)
    time.sleep(0.25)
    assert pixels == [200]


def test_viewers_take_turns(worker):
    order = []

    def draw(name, pixels):
        time.sleep(0.01)
        order.append(name)
        if len(order) < 20:
            ask(name)

    def ask(name):
        worker.request(name, lambda pixels: draw(name, pixels), SIZE)

    ask("a")
    ask("b")
    wait_for(lambda: len(order) >= 20)
    assert 8 <= order[:20].count("a") <= 12


def test_a_viewer_that_left_is_forgotten(worker):
    begun, go, drawn = threading.Event(), threading.Event(), []
    worker.request("b", lambda pixels: (begun.set(), go.wait(5)), (8, 8))
    assert begun.wait(5)
    worker.request("a", drawn.append, SIZE)
    worker.close("a")
    worker.close("unknown")
    go.set()
    time.sleep(0.1)
    assert not drawn and list(worker._seats) == ["b"]


def test_others_draw_between_pictures_and_not_after_the_end():
    worker, drawing, together = RenderWorker(), threading.Event(), []

    def picture(pixels):
        drawing.set()
        time.sleep(0.05)
        drawing.clear()

    worker.request("a", picture, SIZE)
    assert drawing.wait(5)
    worker.between(lambda: together.append(drawing.is_set()))
    assert together == [False]
    worker.stop()
    with pytest.raises(CancelledError):
        worker.between(lambda: None)
