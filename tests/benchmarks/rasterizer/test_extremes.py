"""Table of errors at the rasterizer's extremes."""

import pytest

from benchmarks.rasterizer import extremes


def test_an_extreme_that_is_drawn_has_a_row_of_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = next(extreme for extreme in extremes.extremes.EXTREMES if extreme.compared)
    monkeypatch.setattr(extremes.extremes, "EXTREMES", [drawn])
    *_, row = extremes.measured().splitlines()
    name, *numbers = (cell.strip() for cell in row.strip("|").split("|"))
    assert name == drawn.name
    assert all(0 <= float(number) < 1e-4 for number in numbers[:-1])
