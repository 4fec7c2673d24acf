"""Addresses of compiled kernels."""

from __future__ import annotations

from typing import NamedTuple

from chronoscene.kernels.compilation import kernel
from chronoscene.kernels.memory import moved


class Places(NamedTuple):
    first: int
    second: int


@kernel
def _moved(places, count):  # type: ignore[no-untyped-def]
    return moved(places, count)


def test_named_addresses_are_moved_by_so_many_numbers() -> None:
    places = Places(1 << 40, 24)
    assert _moved(places, 3) == Places((1 << 40) + 12, 36)
    assert _moved(places, 0) == places
