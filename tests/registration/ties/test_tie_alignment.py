"""Tie points in the pipeline."""

from pathlib import Path

import numpy as np
import pytest

from chronoscene.registration.ties.tie_alignment import control_frame
from chronoscene.registration.ties.tie_points import read_tie_points


def test_ground_control_gives_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        "+proj=utm +zone=11 +datum=WGS84 +units=m +no_defs\n"
        "500000.0 3811000.0 12.0 10 20 a.jpg one\n"
        "500100.0 3811000.0 14.0 30 20 a.jpg two\n"
        "500050.0 3811100.0 13.0 30 40 b.jpg three\n"
    )
    points = read_tie_points(path)
    frame = control_frame(points)
    assert frame is not None
    assert frame.longitude == pytest.approx(-117.0 + 50 / 92_500, abs=2e-5)
    placed = points.located(frame)
    assert np.abs(np.stack(list(placed.values()))).max() < 110.0
    # The scale of UTM is 0.9996 at the meridian of its zone.
    between = np.linalg.norm(placed["one"][:2] - placed["two"][:2])
    assert between == pytest.approx(100.0 / 0.9996, abs=0.01)


def test_control_on_both_sides_of_the_antimeridian(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    rows = [f"p{i},a.jpg,1,2,{x},-16.8,10" for i, x in enumerate((179.999, -179.999, 179.9996))]
    path.write_text("\n".join(["# crs: EPSG:4326", "point,image,x,y,X,Y,Z", *rows, ""]))
    points = read_tie_points(path)
    frame = control_frame(points)
    assert frame is not None and frame.longitude == 179.9996
    assert np.abs(np.stack(list(points.located(frame).values()))).max() < 200.0


def test_points_without_a_reference_system_give_none(tmp_path: Path) -> None:
    path = tmp_path / "ties.csv"
    path.write_text("point,image,x,y,X,Y,Z\none,a.jpg,1,2,3,4,5\n")
    assert control_frame(read_tie_points(path)) is None
