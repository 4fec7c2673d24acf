"""GPS to metres, and which positions are plausible."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.geodesy import Georeference
from chronoscene.images.exif import ExifData
from chronoscene.io.wording import counted
from chronoscene.registration.photos.gps_priors import locate
from chronoscene.registration.photos.photo import Capture, Gps

PLACE = (51.5, 10.25)
METRES_PER_DEGREE = 111_320.0


def captures(
    offsets: np.ndarray,
    *,
    altitudes: list[float | None] | None = None,
    relative: list[float | None] | None = None,
    place: tuple[float, float] = PLACE,
) -> list[Capture]:
    """Captures at metres east and north of a place; NaN for one without a position."""
    found = []
    for i, (east, north) in enumerate(offsets.tolist()):
        latitude = place[0] + north / METRES_PER_DEGREE
        longitude = place[1] + east / (METRES_PER_DEGREE * np.cos(np.radians(place[0])))
        longitude = (longitude + 180) % 360 - 180
        gps = Gps(
            latitude,
            longitude,
            100.0 if altitudes is None else altitudes[i],
            None if relative is None else relative[i],
            (5.0, 5.0, 10.0),
        )
        has = np.isfinite(east)
        name = f"{i}.jpg"
        found.append(Capture(name, Path(name), 0, 64, 64, ExifData(), None, gps if has else None))
    return found


GRID = np.array([[20.0 * i, 15.0 * j] for i in range(5) for j in range(4)])


def test_a_grid_keeps_its_shape() -> None:
    found = locate(captures(GRID))
    assert found.georeference is not None
    assert found.plausible.all()
    shape = found.enu[:, :2] - found.enu[0, :2]
    np.testing.assert_allclose(shape, GRID - GRID[0], rtol=0.005, atol=0.01)


def test_the_date_line_tears_nothing() -> None:
    found = locate(captures(GRID, place=(10.0, 179.9997)))
    assert np.ptp(found.enu[:, 0]) == pytest.approx(80.0, rel=0.01)


def test_wildly_wrong_positions_are_named_and_not_used() -> None:
    offsets = GRID.copy()
    offsets[3] = [250_000.0, 0.0]
    found = locate(captures(offsets))
    assert found.plausible.tolist() == [i != 3 for i in range(20)]
    assert any(r.startswith("3.jpg: GPS is 2") for r in found.remarks)


@pytest.mark.parametrize(("size", "limit"), [(0.05, 200.0), (1.0, None), (10.0, None)])
def test_gross_errors_begin_at_twenty_median_distances_but_not_below_200_metres(
    size: float, limit: float | None
) -> None:
    offsets = size * GRID
    middle = np.median(offsets, axis=0)
    median = float(np.median(np.linalg.norm(offsets - middle, axis=1)))
    limit = limit or 20 * median
    for share, plausible in ((0.94, True), (1.06, False)):
        # Far to both sides, so that the median stays.
        moved = np.concatenate([offsets, middle + share * limit * np.array([[1, 0], [-1, 0]])])
        found = locate(captures(moved)).plausible
        assert found.tolist() == [True] * 20 + [plausible] * 2


def test_missing_positions_stay_missing() -> None:
    offsets = GRID.copy()
    offsets[5] = np.nan
    found = locate(captures(offsets))
    assert np.isnan(found.enu[5]).all()
    assert not found.plausible[5]
    assert found.plausible.sum() == 19


def test_one_fix_for_all_photos_is_no_frame() -> None:
    found = locate(captures(np.full((6, 2), 3.0)))
    assert found.georeference is None
    assert any("do not describe the motion" in r for r in found.remarks)


def test_too_few_positions_are_no_frame() -> None:
    offsets = np.full((6, 2), np.nan)
    offsets[:2] = 0.0
    assert locate(captures(offsets)).georeference is None
    offsets[:3] = [[0, 0], [100, 0], [50_000, 0]]
    found = locate(captures(offsets))
    assert found.georeference is None
    assert found.remarks[-1].startswith("2 of 6 photos have a plausible GPS position: too few")


def test_heights_are_of_one_kind() -> None:
    relative: list[float | None] = [60.0 + i for i in range(20)]
    mixed: list[float | None] = [None if i % 2 else 100.0 for i in range(20)]
    found = locate(captures(GRID, altitudes=mixed, relative=relative))
    assert found.georeference is not None
    assert found.georeference.height_kind == "relative"
    assert np.ptp(found.enu[:, 2]) == pytest.approx(19.0, abs=0.01)
    assert "heights are relative to take-off: 10 photos state no others" in found.remarks
    none = locate(captures(GRID, altitudes=[None] * 20))
    assert none.georeference is not None
    assert none.georeference.height_kind == "none"
    assert (none.sigma[:, 2] >= 100.0).all()


def test_few_missing_heights_follow_from_those_above_take_off() -> None:
    relative: list[float | None] = [60.0 + i for i in range(20)]
    stated: list[float | None] = [460.0 + i for i in range(20)]
    for count, kind in ((1, "as stated"), (4, "as stated"), (5, "relative")):
        few = [None if i < count else height for i, height in enumerate(stated)]
        found = locate(captures(GRID, altitudes=few, relative=relative))
        assert found.georeference is not None
        assert found.georeference.height_kind == kind
        remark = f"{counted(count, 'height')} above take-off made absolute by the other photos"
        assert (remark in found.remarks) == (kind == "as stated")
        heights = found.enu[:, 2] + found.georeference.height
        expected = relative if kind == "relative" else stated
        np.testing.assert_allclose(heights, np.array(expected, np.float64), atol=0.01)


def test_missing_heights_follow_from_the_take_off_of_their_period() -> None:
    relative: list[float | None] = [60.0] * 20
    stated = [460.0 if i < 10 else 490.0 for i in range(20)]
    few = [None if i in (0, 10) else height for i, height in enumerate(stated)]
    photos = captures(GRID, altitudes=few, relative=relative)
    found = locate([replace(c, period=i // 10) for i, c in enumerate(photos)])
    whole = locate(captures(GRID, altitudes=[*stated]), found.georeference)
    np.testing.assert_allclose(found.enu, whole.enu, atol=1e-6)


def test_a_given_frame_is_used() -> None:
    frame = Georeference(PLACE[0], PLACE[1], 0.0, "as stated")
    found = locate(captures(GRID), frame)
    assert found.georeference == frame
    np.testing.assert_allclose(found.enu[0, :2], GRID[0], atol=1e-3)
