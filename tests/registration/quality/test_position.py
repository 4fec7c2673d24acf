"""The verdict on the absolute position, on generated registrations whose truth is known."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from benchmarks.registration.generated import CaseSettings, Generated, generate_case
from chronoscene.arrays import Array
from chronoscene.geodesy import Georeference, read_reference_system
from chronoscene.registration.output import Inspection, as_scene, inspect_registration
from chronoscene.registration.quality.position import Position, judge_position
from chronoscene.registration.report.coordinates import omega_phi_kappa, write_coordinates
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import TieAlignment, align_with_tie_points
from chronoscene.registration.ties.tie_points import read_tie_points
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3, fit

UTM = read_reference_system("", "EPSG:32632")

FRAME = Georeference(51.0, 11.0, 200.0, "as stated")
"""Origin of the truth: two degrees east of the central meridian of `UTM`."""

PLACES = np.array(
    [[0, 0, 0], [25, 5, 8], [-20, 18, 3], [10, -24, 12], [-15, -12, 5], [18, 22, 1], [3, 9, 15],
     [-8, 4, 2.0]]
)  # fmt: skip
"""Surveyed points c0 to c7, metres. A pixel covers about 0.2 m."""


@pytest.fixture(scope="module")
def made() -> Generated:
    """Two periods in the frame of their GPS, which is that of the truth up to centimetres."""
    settings = CaseSettings(seed=9, points=600, views=8, gps_gross=0, gps_bias=0, gps_noise=0.5)
    return generate_case(settings)


def projected(enu: Array) -> Array:
    """East, north, height in UTM, by pyproj."""
    latitude, longitude, height = FRAME.to_geodetic(enu).T
    utm = pyproj.Proj("EPSG:32632")
    return np.column_stack([*utm(longitude, latitude), height])


def survey(
    path: Path,
    made: Generated,
    *,
    checks: Iterable[int] = (),
    off: Mapping[int, tuple[float, float, float]] | None = None,
    noise: float = 0.3,
    size: float = 1.0,
    points: int = 8,
) -> Path:
    """A file of clicks with coordinates in UTM; some points are check points, some are off."""
    rng = np.random.default_rng(0)
    world = projected(size * PLACES)
    rows = ["# crs: EPSG:32632", "point,image,x,y,X,Y,Z,role"]
    for k in range(points):
        xyz = ",".join(f"{c:.5f}" for c in world[k] + (off or {}).get(k, (0.0, 0.0, 0.0)))
        role = "check" if k in checks else ""
        for i in range(0, len(made.truth), 2):
            local = made.truth[i, :3, :3] @ PLACES[k] + made.truth[i, :3, 3]
            u, v = 400 * local[:2] / local[2] + [240, 180] + rng.normal(0, noise, 2)
            if 0 < u < 480 and 0 < v < 360:
                rows.append(f"c{k},{made.model.names[i]},{u:.5f},{v:.5f},{xyz},{role}")
    path.write_text("\n".join(rows) + "\n")
    return path


def judged(model: Registered, file: Path) -> tuple[TieAlignment, Position]:
    ties = align_with_tie_points(model, read_tie_points(file), output=UTM)
    return ties, judge_position(ties.model, ties)


def test_exact_control_and_check_points_pass(tmp_path: Path, made: Generated) -> None:
    ties, position = judged(made.model, survey(tmp_path / "s.csv", made, checks=(1, 3, 7)))
    assert position.level == "pass", position.text
    assert ties.controlled and not ties.replaced
    assert position.check is not None and position.control is not None
    assert (position.check.count, position.control.count) == (3, 5)
    assert position.check.horizontal < 0.2 and position.check.vertical < 0.2
    assert position.ground_pixel == pytest.approx(0.2, abs=0.1)
    assert position.scale_error is None and judge_position(made.model).scale_error is not None


@pytest.mark.parametrize("exchanged", [False, True])
def test_control_on_flat_ground_with_exchanged_axes_turns_the_model_over(
    tmp_path: Path, made: Generated, exchanged: bool
) -> None:
    rows = ["point,image,x,y,X,Y,Z"]
    for k, place in enumerate(PLACES * [1.0, 1.0, 0.0]):
        x, y, z = place[[1, 0, 2]] if exchanged else place
        for name, pose in zip(made.model.names, made.truth, strict=True):
            local = pose[:3, :3] @ place + pose[:3, 3]
            u, v = 400 * local[:2] / local[2] + [240, 180]
            if 0 < u < 480 and 0 < v < 360:
                rows.append(f"c{k},{name},{u},{v},{x},{y},{z}")
    (tmp_path / "s.csv").write_text("\n".join(rows))
    model = replace(made.model, georeference=None)
    ties = align_with_tie_points(model, read_tie_points(tmp_path / "s.csv"))
    position = judge_position(ties.model, ties)
    assert ties.controlled and position.control is not None and position.control.horizontal < 0.3
    assert ("look up from below" in position.text) == exchanged
    assert ("order east, north, height" in position.todo[0]) == exchanged


def test_control_alone_is_optimistic(tmp_path: Path, made: Generated) -> None:
    _, position = judged(made.model, survey(tmp_path / "s.csv", made))
    assert position.level == "doubtful"
    assert "no check points" in position.text and "RMSE of 8" in position.text
    assert "role check" in position.todo[0]


@pytest.mark.parametrize(("metres", "level"), [(1.0, "doubtful"), (3.0, "fail")])
def test_control_that_is_off_in_height(
    tmp_path: Path, made: Generated, metres: float, level: str
) -> None:
    off = dict.fromkeys((0, 2, 4, 5, 6), (0.0, 0.0, metres))
    file = survey(tmp_path / "s.csv", made, checks=(1, 3, 7), off=off)
    ties, position = judged(made.model, file)
    assert position.level == level
    assert position.check is not None and position.control is not None
    assert position.check.vertical == pytest.approx(metres, abs=0.15)
    assert position.check.horizontal < 0.3
    assert position.control.vertical < 0.15
    assert [f.check for f in position.objections] == ["vertical"]
    errors = {r.name: r.error for r in ties.residuals}
    assert errors["c1"] is not None and errors["c1"][2] == pytest.approx(metres, abs=0.2)


@pytest.mark.parametrize(("metres", "said"), [(47.3, True), (-47.3, True), (3.0, False)])
def test_another_system_of_heights_than_that_of_gps_is_named(
    tmp_path: Path, made: Generated, metres: float, said: bool
) -> None:
    off = dict.fromkeys(range(8), (0.0, 0.0, metres))
    file = survey(tmp_path / "s.csv", made, checks=(1, 3, 7), off=off)
    ties, position = judged(made.model, file)
    assert position.level == "pass" and position.text.startswith("Check points")
    assert ("those of GPS" in position.text) == said
    if said:
        found = re.search(r"are (\S+) m (above|below) those of GPS", position.text)
        assert found is not None and float(found[1]) == pytest.approx(abs(metres), abs=0.5)
        assert found[2] == ("above" if metres > 0 else "below")
    # Without heights, GPS says nothing about them.
    latitude, longitude, _ = FRAME.to_geodetic(ties.model.gps_enu).T
    flat = FRAME.to_enu(latitude, longitude, np.zeros(len(latitude)))
    assert "those of GPS" not in judge_position(replace(ties.model, gps_enu=flat), ties).text


def test_a_wrong_control_point_is_named_and_left_out(tmp_path: Path, made: Generated) -> None:
    file = survey(tmp_path / "s.csv", made, checks=(1,), off={4: (2.0, 0.0, 0.0)})
    ties, position = judged(made.model, file)
    assert position.level == "doubtful"
    assert "control point c4" in [f.place for f in position.objections]
    assert [r.name for r in ties.residuals if r.role == "control" and not r.used] == ["c4"]
    assert position.control is not None and position.control.horizontal < 0.2


def test_a_wrong_one_of_five_control_points_is_named(tmp_path: Path, made: Generated) -> None:
    """Too few to leave it out, but enough to tell which it is."""
    file = survey(tmp_path / "s.csv", made, off={3: (6.0, 0.0, 0.0)}, points=5)
    _, position = judged(made.model, file)
    named = [o for o in position.objections if o.check == "contradiction"]
    assert len(named) == 1 and "c3 is " in named[0].found
    good = survey(tmp_path / "t.csv", made, points=5)
    assert not [o for o in judged(made.model, good)[1].objections if o.check == "contradiction"]


def test_check_points_only_measure(tmp_path: Path, made: Generated) -> None:
    file = survey(tmp_path / "s.csv", made, checks=range(8))
    ties, position = judged(made.model, file)
    assert ties.model is made.model and not ties.controlled
    assert position.level == "pass" and position.control is None
    assert position.check is not None and position.check.count == 8
    moved = replace(
        made.model, cam_from_world=Sim3(1.0, np.eye(3), np.array([3.0, 0, 0])).apply_to_pose(
            made.model.cam_from_world
        ),
    )  # fmt: skip
    assert judged(moved, file)[1].level == "fail"
    lost = replace(made.model, georeference=None, gps_enu=np.full_like(made.model.gps_enu, np.nan))
    ties, position = judged(lost, file)
    assert position.level == "not checked" and not any(r.error for r in ties.residuals)


@pytest.mark.parametrize(("count", "kind"), [(8, "as stated"), (2, "relative")])
def test_heights_are_those_of_the_control_that_a_model_was_moved_to(
    tmp_path: Path, made: Generated, count: int, kind: str
) -> None:
    frame = replace(FRAME, height_kind="relative")
    file = survey(tmp_path / "s.csv", made, points=count)
    ties, _ = judged(replace(made.model, georeference=frame), file)
    assert ties.model.georeference == replace(frame, height_kind=kind)


def test_two_control_points_are_check_points(tmp_path: Path, made: Generated) -> None:
    _, position = judged(made.model, survey(tmp_path / "s.csv", made, points=2))
    assert position.check is not None and position.check.count == 2
    assert position.level == "doubtful" and position.objections[0].check == "points"


def test_gps_and_nothing(made: Generated) -> None:
    position = judge_position(made.model)
    assert position.level == "doubtful" and position.gps is not None
    assert position.gps.horizontal == pytest.approx(0.5 * np.sqrt(2), rel=0.4)
    assert f"{position.gps.horizontal:.3g} m horizontal" in position.text
    nowhere = judge_position(replace(made.model, georeference=None))
    assert nowhere.level == "not checked" and "no ground control" in nowhere.text
    unused = np.zeros(len(made.model.names), bool)
    extended = judge_position(replace(made.model, gps_used=unused, route="frozen"))
    assert extended.level == "not checked" and "the scene that it extends" in extended.text


def test_control_far_from_gps_is_in_another_system(tmp_path: Path, made: Generated) -> None:
    file = survey(tmp_path / "s.csv", made, checks=(1, 3, 7))
    file.write_text(file.read_text().replace("EPSG:32632", "EPSG:32633"))
    _, position = judged(made.model, file)
    assert position.level == "fail" and position.objections[0].check == "gps"
    assert position.check is not None and position.check.horizontal < 0.5
    assert position.text.startswith("The surveyed points and GPS contradict each other")


@pytest.fixture(scope="module")
def far(made: Generated, tmp_path_factory: pytest.TempPathFactory) -> tuple[TieAlignment, float]:
    """Exact poses of a scene of a kilometre in a frame of their own, moved to control in UTM."""
    size, move = 20.0, Sim3(0.3, np.eye(3)[[1, 2, 0]], np.array([4.0, 5.0, 6.0]))
    model = replace(
        made.model,
        cam_from_world=move.apply_to_pose(made.truth),
        points=move.apply(made.model.points),
        georeference=None,
    )
    file = tmp_path_factory.mktemp("far") / "s.csv"
    survey(file, made, checks=(1, 3, 7), noise=0.0, size=size)
    return align_with_tie_points(model, read_tie_points(file), output=UTM), size


def test_a_projection_is_not_taken_for_a_rigid_frame(far: tuple[TieAlignment, float]) -> None:
    ties, size = far
    errors = np.array([r.error for r in ties.residuals])
    assert np.abs(errors).max() < 1e-3
    rigid = fit(size * PLACES, projected(size * PLACES))
    assert rigid is not None
    naive = rigid.apply(size * PLACES) - projected(size * PLACES)
    assert np.abs(naive).max() > 0.01  # scale of heights, curvature


def test_cameras_and_points_come_in_the_reference_system(
    far: tuple[TieAlignment, float], made: Generated, tmp_path: Path
) -> None:
    ties, size = far
    scene = as_scene(ties.model, "far")
    write_coordinates(tmp_path, scene, ties.model.georeference, UTM)
    with (tmp_path / "cameras.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["image"] for r in rows] == list(made.model.names)
    centres = np.array([[float(r[c]) for c in "ENh"] for r in rows])
    expected = projected(size * camera_centre(made.truth))
    np.testing.assert_allclose(centres, expected, atol=2e-3)
    # Angles: of the truth, turned by the convergence of the grid about the vertical.
    turn = pyproj.Proj("EPSG:32632").get_factors(FRAME.longitude, FRAME.latitude)
    assert turn.meridian_convergence > 1.5
    grid = Rotation.from_euler("z", turn.meridian_convergence, degrees=True)
    image = Rotation.from_matrix(np.swapaxes(made.truth[:, :3, :3], 1, 2) @ np.diag([1, -1, -1]))
    angles = np.array([[float(r[c]) for c in ("omega", "phi", "kappa")] for r in rows])
    found = Rotation.from_euler("XYZ", angles, degrees=True)
    assert np.degrees((found.inv() * grid * image).magnitude()).max() < 0.03
    vertex = PlyData.read(tmp_path / "points.ply")
    assert vertex.comments == ["crs EPSG:32632"]
    points = np.column_stack([vertex["vertex"][c] for c in "xyz"])
    assert points.dtype == np.float64
    np.testing.assert_allclose(UTM.to_local(ties.model.georeference, points), ties.model.points,
                               atol=1e-6)  # fmt: skip
    laspy = pytest.importorskip("laspy")
    cloud = laspy.read(tmp_path / "points.laz")
    np.testing.assert_allclose(cloud.xyz, points, atol=1e-4)
    assert cloud.header.parse_crs() == pyproj.CRS("EPSG:32632")
    data = json.loads((tmp_path / "georeference.json").read_text())
    linear = data["output"]
    world = camera_centre(ties.model.cam_from_world)
    approximate = world @ np.array(linear["matrix"]).T + linear["offset"]
    gap = np.linalg.norm(approximate - expected, axis=1)
    assert 0.01 < gap.max() < linear["largest_error"] + 1e-3
    # Of UTM in feet the error is the same in metres.
    feet = read_reference_system("", "+proj=utm +zone=32 +ellps=WGS84 +units=us-ft")
    write_coordinates(tmp_path, scene, ties.model.georeference, feet)
    again = json.loads((tmp_path / "georeference.json").read_text())["output"]
    assert again["largest_error"] == pytest.approx(linear["largest_error"], rel=1e-3)


def test_a_photo_straight_down_with_its_top_north_has_no_angles() -> None:
    down = np.diag([1.0, -1.0, -1.0])[None]
    np.testing.assert_allclose(omega_phi_kappa(down, np.eye(3)[None]), 0, atol=1e-12)
    east = down @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # its top shows east
    np.testing.assert_allclose(omega_phi_kappa(east, np.eye(3)[None]), [[0, 0, -90]], atol=1e-9)


def inspected(
    folder: Path, made: Generated, **settings: Mapping[int, tuple[float, ...]]
) -> Inspection:
    file = survey(folder / "s.csv", made, checks=(1, 3, 7), **settings)
    points = read_tie_points(file)
    ties = align_with_tie_points(made.model, points, output=UTM)
    return inspect_registration(ties.model, folder, page=True, ties=ties, tie_points=points)


def test_control_and_clicks_that_take_no_part_are_named(tmp_path: Path, made: Generated) -> None:
    file = survey(tmp_path / "s.csv", made, checks=(1, 2, 3, 4, 6, 7))
    file.write_text(file.read_text() + "g0,2016/typo.jpg,1,2,,,,\n")
    points = read_tie_points(file)
    ties = align_with_tie_points(made.model, points, output=UTM)
    lines = inspect_registration(ties.model, tmp_path, ties=ties).summary.splitlines()
    assert "  tie points: 2016/typo.jpg: has clicks, but there is no such photo" in lines
    few = "2 control points can be placed; three that are not collinear are needed"
    assert f"  tie points: {few}" in lines


def test_both_verdicts_are_in_terminal_json_and_page(tmp_path: Path, made: Generated) -> None:
    off = dict.fromkeys((0, 2, 4, 5, 6), (0.0, 0.0, 3.0))
    found = inspected(tmp_path, made, off=off)
    assert found.verdict.level != "fail" and found.position.level == "fail" and found.failed
    first, *rest = found.summary.splitlines()
    assert first.startswith(f"alignment of the periods: {found.verdict.level}")
    assert any(line.startswith("absolute position: fail. The model does not lie") for line in rest)
    assert found.position.check is not None
    assert f"  check points: {found.position.check.text}" in rest
    assert any(line.startswith("  control points, which the model was fitted to") for line in rest)
    data = json.loads((tmp_path / "registration.json").read_text())
    assert data["absolute_position"]["verdict"] == "fail"
    assert data["absolute_position"]["check_points"]["vertical"] == found.position.check.vertical
    page = (tmp_path / "registration.html").read_text()
    assert 'Absolute position: <span class="badge fail">Fail</span>' in page
    with (tmp_path / "control.csv").open() as file:
        rows = {r["point"]: r for r in csv.DictReader(file)}
    assert rows["c1"]["role"] == "check" and rows["c0"]["used"] == "1"
    assert float(rows["c1"]["error_h"]) == pytest.approx(3.0, abs=0.2)
    expected = [float(rows["c1"][c]) for c in "ENh"]
    np.testing.assert_allclose(expected, projected(PLACES)[1], atol=1e-3)
