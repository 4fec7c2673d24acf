"""Calls in several threads."""

from __future__ import annotations

import threading
import time

import numba
import pytest

from chronoscene.kernels import side_by_side as module
from chronoscene.kernels.runtime import available_threads, set_threads
from chronoscene.kernels.side_by_side import side_by_side
from chronoscene.kernels.thread_pool import launch


def look(item: int) -> tuple[int, int, int]:
    time.sleep(0.02)  # so that one thread does not do it all
    return item, threading.get_ident(), numba.get_num_threads()


def test_items_have_threads_that_share_those_of_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    if available_threads() < 2:
        pytest.skip("one processor only")
    monkeypatch.setattr(module, "_may_share", lambda: True)
    set_threads(2)
    found = side_by_side(look, [3, 1, 2])
    assert [item for item, _, _ in found] == [3, 1, 2]
    assert len({thread for _, thread, _ in found}) == 2
    assert {threads for _, _, threads in found} == {1}
    assert threading.get_ident() not in {thread for _, thread, _ in found}
    assert numba.get_num_threads() == 2


@pytest.mark.parametrize(("threads", "share", "items"), [(1, True, 3), (2, False, 3), (2, True, 1)])
def test_otherwise_the_caller_does_it(
    threads: int, share: bool, items: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_may_share", lambda: share)
    threads = set_threads(threads)
    found = side_by_side(look, range(items))
    assert found == [(item, threading.get_ident(), threads) for item in range(items)]


def test_each_thread_has_helpers_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two calls on four threads run kernels on two each, at the same time."""
    if available_threads() < 2:
        pytest.skip("one processor only")
    monkeypatch.setattr(module, "_may_share", lambda: True)
    monkeypatch.setattr(module, "num_workers", lambda: 4)
    meeting = threading.Barrier(4, timeout=30)

    def kernel(worker: int, control: object) -> None:
        meeting.wait()

    side_by_side(lambda item: launch(kernel, 2), [0, 1])
    threads = threading.active_count()
    side_by_side(lambda item: launch(kernel, 2), [0, 1])
    assert threading.active_count() == threads  # the helpers stay


def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_may_share", lambda: True)
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda item: 1 // item, [1, 0, 2])
