"""The same work on several scenes, in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

from chronoscene.errors import ChronoSceneError
from chronoscene.io.files import stoppable
from chronoscene.kernels.threads import available_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class _Failure:
    """An error on its way between processes: exceptions with keyword arguments cannot travel."""

    kind: type[ChronoSceneError]
    place: str
    expected: str
    found: str
    todo: str

    def error(self) -> ChronoSceneError:
        return self.kind(self.place, expected=self.expected, found=self.found, todo=self.todo)


def map_parallel(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    lost: Callable[[Item], Result] | None = None,
) -> Iterator[Result]:
    """Results in the order of the items, each as soon as it and those before it are there.

    A process that dies (killed for its memory, or by a fault in a library) ends the others, too;
    then each item that is left gets a process of its own, and only the one at fault is lost.

    Args:
        function: At the top level of a module, or a ``partial`` of such a function.
        items: What to give it.
        workers: Processes; None for one per processor. With one, or one item, none is started.
        lost: The result for an item whose process died; None to raise an error.

    Raises:
        ChronoSceneError: What the function raised on the first item that it failed on.
    """
    workers = min(workers or available_threads(), len(items))
    if workers <= 1:
        yield from map(function, items)
        return
    done = 0
    try:
        for result in _pooled(function, items, workers):
            yield result
            done += 1
    except BrokenProcessPool:
        for item in items[done:]:
            yield _alone(function, item, lost)


def _pooled(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        try:
            for outcome in pool.map(partial(_attempt, function), items):
                if isinstance(outcome, _Failure):
                    raise outcome.error()
                yield outcome
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _alone(
    function: Callable[[Item], Result], item: Item, lost: Callable[[Item], Result] | None
) -> Result:
    try:
        (result,) = _pooled(function, [item], 1)
    except BrokenProcessPool as error:
        if lost is not None:
            return lost(item)
        raise ChronoSceneError(
            item,
            expected="work that ends",
            found="a process that died",
            todo="it may have run out of memory: close other programs, or give it less at a time",
        ) from error
    return result


def _attempt(function: Callable[[Item], Result], item: Item) -> Result | _Failure:
    try:
        with stoppable():  # temporary files go when the process is asked to end
            return function(item)
    except ChronoSceneError as error:
        return _Failure(type(error), error.place, error.expected, error.found, error.todo)
