"""The same work on several scenes, in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

from chronoscene.errors import ChronoSceneError
from chronoscene.threads import available_threads

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
    function: Callable[[Item], Result], items: Sequence[Item], *, workers: int | None = None
) -> Iterator[Result]:
    """Results in the order of the items, each as soon as it and those before it are there.

    Args:
        function: At the top level of a module, or a ``partial`` of such a function.
        items: What to give it.
        workers: Processes; None for one per processor. With one, or one item, none is started.

    Raises:
        ChronoSceneError: What the function raised on the first item that it failed on.
    """
    workers = min(workers or available_threads(), len(items))
    if workers <= 1:
        yield from map(function, items)
        return
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        try:
            for outcome in pool.map(partial(_attempt, function), items):
                if isinstance(outcome, _Failure):
                    raise outcome.error()
                yield outcome
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _attempt(function: Callable[[Item], Result], item: Item) -> Result | _Failure:
    try:
        return function(item)
    except ChronoSceneError as error:
        return _Failure(type(error), error.place, error.expected, error.found, error.todo)
