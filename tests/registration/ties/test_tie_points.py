"""Files of tie points, and what they do to a registration."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration.generated import CaseSettings, Generated, generate_case, pose_errors
from chronoscene.errors import SceneError
from chronoscene.registration.output import as_scene
from chronoscene.registration.photos.inputs import plain_names
from chronoscene.registration.quality.certificate import certify
from chronoscene.registration.quality.verdict import judge
from chronoscene.registration.ties.residuals import with_tie_tracks
from chronoscene.registration.ties.tie_alignment import align_with_tie_points, move_periods
from chronoscene.registration.ties.tie_points import TiePoints, by_photo, read_tie_points
from chronoscene.scene import WorldFrame
from chronoscene.scene.similarity import Sim3

CORNERS = np.array(
    [[0, 0, 0], [25, 5, 8], [-20, 18, 3], [10, -24, 12], [-15, -12, 5], [18, 22, 1], [3, 9, 15.0]]
)
"""Places in the world that were clicked, metres."""


def read(tmp_path: Path, text: str, name: str = "ties.csv") -> TiePoints:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return read_tie_points(path)


def clicks(
    made: Generated, *, noise: float = 0.5, each: int = 4, control: bool = False, count: int = 7
) -> str:
    """Rows of a CSV: every corner in some images of every period."""
    rng = np.random.default_rng(0)
    rows = ["point,image,x,y" + (",X,Y,Z" if control else "")]
    model = made.model
    for number, xyz in enumerate(CORNERS[:count]):
        for period in range(model.num_periods):
            seen = 0
            for i in np.flatnonzero(model.periods == period)[::2]:
                local = made.truth[i, :3, :3] @ xyz + made.truth[i, :3, 3]
                u, v = 400 * local[:2] / local[2] + [240, 180] + rng.normal(0, noise, 2)
                if 0 < u < 480 and 0 < v < 360 and seen < each:
                    seen += 1
                    world = ",".join(str(c) for c in xyz) if control else ""
                    rows.append(f"c{number},{model.names[i]},{u},{v}" + (f",{world}" * control))
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def apart() -> Generated:
    """Two periods without a match between them, the second far from where it belongs."""
    return generate_case(CaseSettings(ties=0, by_gps=True, seed=8, rotation=20, shift=30))


def errors(made: Generated, poses: np.ndarray) -> tuple[float, float]:
    periods = made.model.periods
    rotation, centre = pose_errors(poses, made.truth, periods == 0)
    return float(np.median(rotation[periods == 1])), float(np.median(centre[periods == 1]))


def test_csv_with_and_without_a_header(tmp_path: Path) -> None:
    for text in (
        "p1,a.jpg,1.5,2\np1,b.jpg,3,4\np2,a.jpg,5,6,100,200,50\n",
        "# corners\npoint id,image,x,y,X,Y,Z\np1,a.jpg,1.5,2,,,\n"
        "p1,b.jpg,3,4,,,\n\np2,a.jpg,5,6,100,200,50\n",
        "X,image,y,x,point,Y,Z\n,a.jpg,2,1.5,p1,,\n,b.jpg,4,3,p1,,\n100,a.jpg,6,5,p2,200,50\n",
    ):
        found = read(tmp_path, text)
        assert [p.name for p in found.points] == ["p1", "p2"]
        assert [(c.image, c.x, c.y) for c in found.points[0].clicks] == [
            ("a.jpg", 1.5, 2.0), ("b.jpg", 3.0, 4.0),
        ]  # fmt: skip
        assert found.points[0].world is None
        assert found.points[1].world == (100.0, 200.0, 50.0)
        assert found.crs is None


def test_points_are_in_natural_order(tmp_path: Path) -> None:
    text = "point,image,x,y\n" + "".join(f"GCP {n},a.jpg,{n},5\n" for n in (10, 2, 1))
    assert [point.name for point in read(tmp_path, text).points] == ["GCP 1", "GCP 2", "GCP 10"]


def test_a_point_without_a_click_may_come_first(tmp_path: Path) -> None:
    found = read(tmp_path, "g0,,,,100,200,50\ng1,a.jpg,1,2,110,200,50\n").points
    assert [(p.name, len(p.clicks), p.role) for p in found] == [
        ("g0", 0, "control"), ("g1", 1, "control"),
    ]  # fmt: skip


def test_odm_list(tmp_path: Path) -> None:
    text = (
        "WGS84 UTM 32N\n"
        "544256.7 5320919.9 5 3044 2622 IMG_0525.jpg corner\n"
        "544257.7 5320920.9 6 30 26 IMG_0526.jpg\n"
        "544256.7\t5320919.9\t5\t304\t262\tmy photo.jpg\tcorner\n"
    )
    found = read(tmp_path, text, "gcp_list.txt")
    assert found.crs is not None and found.crs.text == "EPSG:32632"
    assert [p.name for p in found.points] == ["544257.7 5320920.9", "corner"]
    assert [c.image for c in found.points[1].clicks] == ["IMG_0525.jpg", "my photo.jpg"]
    assert found.points[1].world == (544256.7, 5320919.9, 5.0)
    assert {p.role for p in found.points} == {"control"}
    checked = read(tmp_path, text.replace("corner", "CHK-corner"), "checked.txt")
    assert checked.names("check") == {"CHK-corner"}
    half = read_tie_points(tmp_path / "gcp_list.txt", scale=0.5)
    assert half.points[1].clicks[0].x == 1522.0


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("p,a.jpg,1\n", 1, "header"),
        ("point,image,x,y\np,a.jpg,1,2\np,b.jpg,1\n", 3, "3 fields"),
        ("point,image,x,y\np,a.jpg,one,2\n", 2, "'one'"),
        ("point,image,x,y\np,a.jpg,nan,2\n", 2, "'nan'"),
        ("p,a.jpg,1,2\n,b.jpg,1,2\n", 2, "a point id and an image"),
        ("p,a.jpg,1,2\np,a.jpg,5,6\n", 2, "line 1"),
        ("p,a.jpg,1,2,3,4\n", 1, "three world coordinates"),
        ("point,image,x,y\np,a.jpg,812,5,334,0\n", 2, "expected 4 fields, found 6"),
        ("p,a.jpg,8,5,3,0,6,5,4,0,5,0\n", 1, "decimals with a point"),
        ("point;image;x;y\np;a.jpg;8,5;3,0\n", 1, "fields by commas, and write decimals with a"),
        ("p;a.jpg;8,5;3,0\n", 1, "separate the fields by commas"),
        ("p;a.jpg;8,5;3,0;6,5;4,0;5,0\n", 1, "separate the fields by commas"),
        ("point,image,x,y\np;a.jpg;8,5;3,0\n", 2, "separate the fields by commas"),
        ('p,a.jpg,1,2\np,b.jpg,"8,5",3\n', 2, "found '8,5'; write decimals with a point"),
        ("EPSG:32632\n544256,7 2 3 4 5 a.jpg\n", 2, "'544256,7'; write decimals with a point"),
        ("# CRS EPSG:999999\np,a.jpg,1,2\n", 1, "PROJ"),
        ("point,image,u,v,x,y,z\np,a.jpg,1,2,3,4,5\n", 1, "found u and x"),
        ("point,image,x,y,lon,lat,easting\np,a.jpg,1,2,3,4,5\n", 1, "found lon and easting"),
        ("p,a.jpg,1,2,3,4,5\np,b.jpg,1,2,3,4,6\n", 2, "same world coordinates"),
        ("image,x,y\na.jpg,1,2\n", 1, "no point"),
        ("point\timage\tx\ty\np\ta.jpg\t1\t2\n", 1, "separate the fields by commas"),
        ("point,image,x,y,R,Hochwert,Hoehe\np,a.jpg,1,2,3,4,5\n", 1, "known: R, Hochw"),
        ("point,image,x,y,X,Y,Z,role\np,a.jpg,1,2,3,4,5,guess\n", 2, "'guess'"),
        ("point,image,x,y,X,Y,Z,role\np,a.jpg,1,2,,,,check\n", 2, "coordinates of the check"),
        ("p,a.jpg,1,2,3,4,5,check\np,b.jpg,1,2,3,4,5,control\n", 2, "control after check"),
        ("p,a.jpg,1,2,3,4,5,,1,1,1\np,b.jpg,1,2,3,4,5,,1,1,2\n", 2, "the same accuracies"),
        ("EPSG:32632\n1 2 3 4\n", 2, "4 fields"),
        ("EPSG:32632\n1 2 3 4 z a.jpg\n", 2, "'z'"),
        ("# crs: EPSG:999999\np,a.jpg,1,2\n", 1, "PROJ"),
        ("+proj=nonsense\n1 2 3 4 5 a.jpg\n", 1, "PROJ"),
        ("WGS84 UTM 99N\n1 2 3 4 5 a.jpg\n", 1, "PROJ"),
    ],
)
def test_wrong_lines_are_named(tmp_path: Path, text: str, line: int, words: str) -> None:
    with pytest.raises(SceneError) as caught:
        read(tmp_path, text)
    assert caught.value.place.endswith(f":{line}")
    assert words in str(caught.value)


@pytest.mark.parametrize("text", ["", "\n\n", "point,image,x,y\n", "EPSG:32632\n"])
def test_files_without_clicks(tmp_path: Path, text: str) -> None:
    with pytest.raises(SceneError, match="tie points"):
        read(tmp_path, text)


def test_other_columns_do_not_count(tmp_path: Path) -> None:
    for names, values in (("by,seen,blurred", "me,3,4"), ("X,Y,Z,dX,dY,dZ", "3,4,5,6,7,8")):
        (point,) = read(tmp_path, f"point,image,x,y,{names}\np,a.jpg,1,2,{values}\n").points
        assert point.world == ((3.0, 4.0, 5.0) if "X" in names else None)


@pytest.mark.parametrize("line", ["# crs: EPSG:32632", "#CRS EPSG:32632", "# EPSG:32632"])
def test_a_comment_names_the_reference_system(tmp_path: Path, line: str) -> None:
    crs = read(tmp_path, f"# measured in May\n{line}\np,a.jpg,1,2,3,4,5\n").crs
    assert crs is not None and crs.text == "EPSG:32632"


def test_a_role_may_stand_before_the_coordinates(tmp_path: Path) -> None:
    lines = ["p,a.jpg,1,2,,,,check", "p,b.jpg,1,2,3,4,5,"]
    for order in (lines, lines[::-1]):
        (point,) = read(tmp_path, "\n".join(["point,image,x,y,X,Y,Z,role", *order])).points
        assert (point.role, point.world) == ("check", (3.0, 4.0, 5.0))


def test_empty_fields_at_the_end_of_a_line_do_not_count(tmp_path: Path) -> None:
    (point,) = read(tmp_path, "point,image,x,y\np,a.jpg,1,2,,\n").points
    assert point.clicks[0].y == 2.0


def test_commas_that_spreadsheets_add_do_not_count(tmp_path: Path) -> None:
    text = "# crs: EPSG:32632,,,,,,\npoint,image,x,y,E,N,h\n,,,,,,\np,a.jpg,1,2,3,4,5\n , ,,,,,\n"
    found = read(tmp_path, text)
    assert found.crs is not None
    assert (found.crs.text, found.points[0].world) == ("EPSG:32632", (3.0, 4.0, 5.0))
    with pytest.raises(SceneError, match=r"ties.csv: expected tie points, found an empty"):
        read(tmp_path, ",,,\n")


def test_usual_names_of_world_coordinates(tmp_path: Path) -> None:
    for names in (
        "Easting,Northing,Elevation",
        "lon,lat,height",
        "east,north,up",
        "E,N,H",
        "e,n,h",
    ):
        crs = "# crs: EPSG:4326\n" if "lon" in names else ""
        (point,) = read(tmp_path, f"{crs}point,image,x,y,{names}\np,a.jpg,1,2,3,4,5\n").points
        assert point.world == (3.0, 4.0, 5.0)


def test_degrees_are_not_read_as_metres(tmp_path: Path) -> None:
    text = "point,image,x,y,Latitude,Longitude,height\np,a.jpg,1,2,48.1,11.5,510\n"
    expected = "expected a reference system in degrees for Longitude and Latitude, found"
    with pytest.raises(SceneError, match=rf"ties.csv:1: {expected} none; write .* EPSG:4326"):
        read(tmp_path, text)
    with pytest.raises(SceneError, match=rf"ties.csv:2: {expected} EPSG:32632; .* call .* E, N"):
        read(tmp_path, f"# crs: EPSG:32632\n{text}")
    (point,) = read(tmp_path, f"# crs: EPSG:4326\n{text}").points
    assert point.world == (11.5, 48.1, 510.0)
    (point,) = read(tmp_path, "point,image,x,y,lon,lat,X,Y,Z\np,a.jpg,1,2,11,48,3,4,5\n").points
    assert point.world == (3.0, 4.0, 5.0)  # the others are not used


@pytest.mark.parametrize(
    "header", ["u,v,X,Y,Z", "im_x,im_y,X,Y,Z", "Col,Row,X,Y,Z", "x,y,X,Y,Z", "U,V,East,North,Up"]
)
def test_world_coordinates_beside_every_name_of_pixels(tmp_path: Path, header: str) -> None:
    names, values = [*header.split(","), "point", "image"], ["1", "2", "3", "4", "5", "p", "a.jpg"]
    for order in (range(7), (2, 3, 4, 0, 1, 5, 6)):
        lines = (",".join(row[i] for i in order) for row in (names, values))
        (point,) = read(tmp_path, "\n".join(lines)).points
        assert (point.clicks[0].x, point.clicks[0].y, point.world) == (1.0, 2.0, (3.0, 4.0, 5.0))
    assert read(tmp_path, "Point,Image,X,Y\np,a.jpg,1,2\n").points[0].clicks[0].y == 2.0


def unread(names: Sequence[str]) -> dict[str, None]:
    """Photos of unknown sizes."""
    return dict.fromkeys(names)


def images(points: TiePoints, names: Sequence[str]) -> list[str]:
    return [c.image for p in by_photo(points, unread(names)).points for c in p.clicks]


def test_images_may_have_their_names_of_before_registration(tmp_path: Path) -> None:
    points = read(tmp_path, "p,2016/a b.jpg,1,2\np,c d.tif,1,2\n")
    before, after = ["2016/a b.jpg", "2016/c d.tif"], ["2016/a_b.jpg", "2016/c_d.tif.png"]
    for names in (before, after):
        assert images(points, names) == names
    assert images(read(tmp_path, "p,2016/a_b.jpg,1,2\np,c_d.tif.png,1,2\n"), before) == before


def test_a_name_with_blanks_that_may_be_either_of_two_photos(tmp_path: Path) -> None:
    names = plain_names(["a_b.jpg", "a b.jpg"])
    points = read(tmp_path, "p,a b.jpg,1,2\n")
    with pytest.raises(SceneError, match=r"'a b.jpg', which fits a_b.jpg and a_b_2.jpg; .* scene"):
        by_photo(points, unread(names))
    assert images(read(tmp_path, "p,a_b.jpg,1,2\np,a_b_2.jpg,1,2\n"), names) == names


def test_images_are_found_by_the_end_of_their_path(tmp_path: Path) -> None:
    names = ("2016/a.jpg", "2016/b_c.jpg", "2018/b_c.jpg", "2018/d.jpg")
    points = read(tmp_path, "p,a.jpg,1,2\np,2018/b c.jpg,1,2\np,zz.jpg,1,2\n")
    assert images(points, names) == ["2016/a.jpg", "2018/b_c.jpg", "zz.jpg"]
    with pytest.raises(SceneError, match=r"ties.csv:1: .*2016/b_c.jpg and 2018/b_c.jpg"):
        by_photo(read(tmp_path, "p,b_c.jpg,1,2\n"), unread(names))
    with pytest.raises(SceneError, match=r"names of photos, such as 2016/a.jpg, found other.jpg"):
        by_photo(read(tmp_path, "p,other.jpg,1,2\n"), unread(names))


def test_images_are_found_by_names_in_another_unicode_form(tmp_path: Path) -> None:
    names = [unicodedata.normalize("NFD", n) for n in ("höhe.jpg", "Süd/höhe.jpg", "Süd/b ü.tif")]
    text = unicodedata.normalize("NFC", "p,höhe.jpg,1,2\np,Süd/höhe.jpg,1,2\np,b ü.tif,1,2\n")
    assert images(read(tmp_path, text), names) == names
    new = [re.sub(r"\s", "_", names[2]) + ".png"]
    assert images(read(tmp_path, text), new)[2:] == new


def test_a_failed_alignment_is_replaced(tmp_path: Path, apart: Generated) -> None:
    assert errors(apart, apart.model.cam_from_world)[0] > 10
    found = align_with_tie_points(apart.model, read(tmp_path, clicks(apart)))
    assert found.replaced and not found.controlled
    rotation, centre = errors(apart, found.model.cam_from_world)
    assert rotation < 0.15
    assert centre < 0.3
    assert not found.outliers
    assert all(r.click_consistency is not None and r.click_consistency < 2 for r in found.residuals)
    assert all(r.between_periods is not None and r.between_periods < 0.6 for r in found.residuals)
    # Points moved with their periods: they still fit their images.
    before, after = certify(apart.model).periods, certify(found.model).periods
    for a, b in zip(before, after, strict=True):
        assert b.error == pytest.approx(a.error, rel=0.05)


def test_clicks_alone_are_doubtful_not_passed(tmp_path: Path, apart: Generated) -> None:
    ties = read(tmp_path, clicks(apart))
    found = align_with_tie_points(apart.model, ties)
    verdict = judge(certify(with_tie_tracks(found.model, ties)))
    assert verdict.level == "doubtful"
    assert judge(certify(apart.model)).level == "fail"


def test_a_good_alignment_is_kept(tmp_path: Path) -> None:
    made = generate_case(CaseSettings(seed=9, ties=500))
    ties = read(tmp_path, clicks(made))
    found = align_with_tie_points(made.model, ties)
    assert not found.replaced
    assert found.model is made.model
    forced = align_with_tie_points(made.model, ties, mode="replace")
    assert forced.replaced


def test_a_wrong_click_is_named_and_does_no_harm(tmp_path: Path, apart: Generated) -> None:
    rows = clicks(apart).splitlines()
    wrong = next(i for i, row in enumerate(rows) if row.startswith("c3,"))
    fields = rows[wrong].split(",")
    fields[2] = str(min(470.0, float(fields[2]) + 90) if float(fields[2]) < 300 else 20.0)
    rows[wrong] = ",".join(fields)
    found = align_with_tie_points(apart.model, read(tmp_path, "\n".join(rows)))
    assert "c3" in found.outliers
    assert errors(apart, found.model.cam_from_world)[0] < 0.3
    bad = next(r for r in found.residuals if r.name == "c3")
    assert bad.note


def test_a_point_that_moved_is_left_out(tmp_path: Path, apart: Generated) -> None:
    """One corner was clicked on something that stands elsewhere at the second date."""
    ties = read(tmp_path, clicks(apart))
    moved = replace(apart, truth=apart.truth.copy())
    second = apart.model.periods == 1
    moved.truth[second, :3, 3] += moved.truth[second, :3, :3] @ [4.0, 3.0, 0.0]
    other = read(tmp_path, clicks(moved), "other.csv")
    points = tuple(
        o if p.name == "c1" else p for p, o in zip(ties.points, other.points, strict=True)
    )
    found = align_with_tie_points(apart.model, replace(ties, points=points))
    assert "c1" in found.outliers
    assert any("without c1" in r for r in found.remarks)
    assert errors(apart, found.model.cam_from_world)[1] < 0.4


def test_too_few_points_say_what_is_needed(tmp_path: Path, apart: Generated) -> None:
    with pytest.raises(SceneError, match=r"three points or more.*found 2 such points"):
        align_with_tie_points(apart.model, read(tmp_path, clicks(apart, count=2)))
    with pytest.raises(SceneError, match=r"found 0 such points"):
        align_with_tie_points(apart.model, read(tmp_path, clicks(apart, each=1)))


def test_ground_control_moves_the_model(tmp_path: Path) -> None:
    made = generate_case(CaseSettings(seed=9, ties=500, gps_noise=None))
    move = Sim3(0.2, np.eye(3)[[1, 2, 0]], np.array([4.0, 5.0, 6.0]))
    model = replace(
        made.model,
        cam_from_world=move.apply_to_pose(made.model.cam_from_world),
        points=move.apply(made.model.points),
    )
    found = align_with_tie_points(model, read(tmp_path, clicks(made, control=True)))
    assert found.controlled and not found.replaced
    assert (model.unit, found.model.unit) == ("unknown", "metre")
    assert as_scene(found.model, "site").world == WorldFrame("metre")
    from chronoscene.scene.geometry import camera_centre

    gap = camera_centre(found.model.cam_from_world) - camera_centre(made.truth)
    assert np.linalg.norm(gap, axis=1).max() < 0.5
    assert all(r.used and r.error is not None for r in found.residuals)
    assert np.abs([r.error for r in found.residuals]).max() < 0.6


def test_control_in_utm_goes_through_the_georeference(tmp_path: Path) -> None:
    import pyproj

    made = generate_case(CaseSettings(seed=9, ties=500))
    frame = made.model.georeference
    assert frame is not None
    geodetic = frame.to_geodetic(CORNERS)
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    east, north = utm.transform(geodetic[:, 1], geodetic[:, 0])
    rows = ["WGS84 UTM 32N"]
    for line in clicks(made).splitlines()[1:]:
        name, image, x, y = line.split(",")
        k = int(name[1:])
        rows.append(f"{east[k]:.4f} {north[k]:.4f} {geodetic[k, 2]:.4f} {x} {y} {image} {name}")
    ties = read(tmp_path, "\n".join(rows), "gcp_list.txt")
    for name, xyz in ties.located(frame).items():
        np.testing.assert_allclose(xyz, CORNERS[int(name[1:])], atol=1e-3)
    assert align_with_tie_points(made.model, ties).controlled
    assert not ties.located(None)


def test_clicks_outside_the_photo(tmp_path: Path) -> None:
    sizes = {"2016/a.jpg": (480, 360), "2016/b.jpg": None}
    points = read(tmp_path, "p,a.jpg,480,360\np,b.jpg,4800,20\n")
    assert by_photo(points, sizes).images == set(sizes)
    with pytest.raises(SceneError, match=r"ties.csv:2: expected a pixel of 2016/a.jpg \(480 x 360"):
        by_photo(read(tmp_path, "p,b.jpg,1,2\np,a.jpg,4800,20\n"), sizes)


def test_two_clicks_in_one_photo(tmp_path: Path) -> None:
    points = read(tmp_path, "p,a.jpg,1,2\np,2016/a.jpg,1,2\n")
    with pytest.raises(SceneError, match=r"ties.csv:2: expected one click of point 'p'.* line 1"):
        by_photo(points, unread(["2016/a.jpg"]))


def test_tie_points_become_points_of_the_model(tmp_path: Path) -> None:
    made = generate_case(CaseSettings(seed=9, ties=500))
    ties = read(tmp_path, clicks(made))
    grown = with_tie_tracks(made.model, ties)
    assert len(grown.points) == len(made.model.points) + 7
    assert grown.track_start[-1] == len(grown.track_image) == len(grown.track_xy)
    np.testing.assert_allclose(grown.points[-7:], CORNERS, atol=0.5)


def test_moving_periods_splits_common_points() -> None:
    made = generate_case(CaseSettings(seed=9, ties=500, noise=1e-6, outliers=0.0))
    model = replace(made.model, cam_from_world=made.truth)
    move = Sim3(1.5, np.eye(3)[[2, 0, 1]], np.array([1.0, 2.0, 3.0]))
    moved = move_periods(model, {1: move})
    point = np.repeat(np.arange(len(moved.points)), np.diff(moved.track_start))
    low = np.minimum.reduceat(moved.periods[moved.track_image], moved.track_start[:-1])
    assert (moved.periods[moved.track_image] == low[point]).all()
    assert certify(moved).periods[1].error == pytest.approx(0, abs=1e-3)


def test_roles_of_points(tmp_path: Path) -> None:
    rows = "a,x.jpg,1,2,3,4,5,\nb,x.jpg,1,2,3,4,5,Check\nb,y.jpg,1,2,,,,\nc,x.jpg,1,2\n"
    for head in ("", "point,image,x,y,X,Y,Z,role\n"):
        found = read(tmp_path, head + rows)
        assert [p.role for p in found.points] == ["control", "check", "tie"]


def test_points_that_no_two_periods_share_do_not_move_them(tmp_path: Path) -> None:
    """Targets are laid out anew at each date."""
    made = generate_case(CaseSettings(seed=9, ties=500))
    rows = clicks(made, control=True).splitlines()
    of = [r for r in rows[1:] if (",t0/" in r) == (int(r[1]) % 2 == 0)]
    found = align_with_tie_points(made.model, read(tmp_path, "\n".join([rows[0], *of])))
    assert not found.replaced and found.controlled


def test_accuracies_and_points_that_no_photo_shows(tmp_path: Path) -> None:
    points = read(
        tmp_path,
        "point,image,x,y,X,Y,Z,role,sX,sY,sZ\n"
        "a,1.jpg,10,20,1,2,3,,0.01,0.02,0.05\n"
        "b,,,,4,5,6,check,,,\n"
        "c,1.jpg,30,20,,,,,,,\n",
    )
    found = {p.name: p for p in points.points}
    assert found["a"].sigma == (0.01, 0.02, 0.05) and found["b"].sigma is None
    assert list(points.sigmas()) == ["a"]
    assert found["b"].clicks == () and found["b"].role == "check"
    for row, message in (
        ("a,1.jpg,1,2,1,2,3,,0.1,,", "three accuracies"),
        ("a,1.jpg,1,2,1,2,3,,0,1,1", "accuracies above 0"),
        ("a,,,,,,,", "a point id and an image"),
    ):
        with pytest.raises(SceneError, match=message):
            read(tmp_path, f"point,image,x,y,X,Y,Z,role,sX,sY,sZ\n{row}\n")


def test_all_points_with_two_places_are_named(tmp_path: Path) -> None:
    rows = ["a,1.jpg,1,2,1,2,3", "a,2.jpg,1,2,1,2,4", "b,1.jpg,5,2,1,2,3", "b,2.jpg,1,2,0,2,3"]
    with pytest.raises(SceneError, match=r"a \(line 3\), b \(line 5\)"):
        read(tmp_path, "point,image,x,y,X,Y,Z\n" + "\n".join(rows))
