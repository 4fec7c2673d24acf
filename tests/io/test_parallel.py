"""The same work in several processes."""

from __future__ import annotations

import os
import signal

import pytest

from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.io.parallel import map_parallel


def process_of(item: int) -> tuple[int, int]:
    return item, os.getpid()


def fail_on_two(item: int) -> int:
    if item == 2:
        raise SceneError("place", expected="one", found="two", todo="count again")
    return item


def test_results_come_in_order_from_other_processes():
    results = list(map_parallel(process_of, [3, 1, 2], workers=2))
    assert [item for item, _ in results] == [3, 1, 2]
    assert os.getpid() not in {pid for _, pid in results}


def test_one_item_stays_in_this_process():
    assert list(map_parallel(process_of, [5], workers=4)) == [(5, os.getpid())]
    assert list(map_parallel(process_of, [])) == []


def test_an_error_keeps_its_kind_and_words_on_its_way():
    with pytest.raises(SceneError, match="place: expected one, found two; count again") as caught:
        list(map_parallel(fail_on_two, [1, 2, 3], workers=2))
    assert (caught.value.place, caught.value.todo) == ("place", "count again")


def die_on_two(item: int) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)  # as a system does that is out of memory
    return 10 * item


def test_a_process_that_dies_loses_its_item_only():
    found = list(map_parallel(die_on_two, [1, 2, 3, 4], workers=2, lost=lambda item: -item))
    assert found == [10, -2, 30, 40]


def test_a_process_that_dies_is_an_error_in_one_line():
    with pytest.raises(ChronoSceneError, match="2: expected work that ends, found a process that"):
        list(map_parallel(die_on_two, [1, 2, 3], workers=2))
