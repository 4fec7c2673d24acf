"""Two photos a date with known cameras, placed by control points: generated, with truth."""

import json
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.registration.generated import CaseSettings, generate_case
from chronoscene.errors import ConfigError, SceneError
from chronoscene.geodesy import Georeference
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.context import Options
from chronoscene.registration.control import route
from chronoscene.registration.control.resection import poses_of
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.photos.known_cameras import known_groups, read_cameras
from chronoscene.registration.pipeline import run
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_points import read_tie_points
from chronoscene.scene import Frame, Scene
from chronoscene.scene.geometry import camera_centre

LABELS = ("2016", "2023")
CONTROL, CLICK_PIXELS, SURVEY = 7, 0.5, 0.02


@dataclass
class Few:
    """Files of a few photos."""

    captures: Path
    cameras: Path
    points: Path
    truth: dict[str, np.ndarray]
    """``cam_from_world`` by name."""


@pytest.fixture(scope="module")
def few(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Few:
    """The first and third photo of each date, calibrated at twice their size."""
    root = tmp_path_factory.mktemp("few")
    chosen = [
        next(i for i, f in enumerate(truth.frames) if f.name == f"p{period}_{number:04}.jpg")
        for period in (0, 1)
        for number in (0, 2)
    ]
    known = {}
    for i in chosen:
        frame = truth.frames[i]
        name = f"{LABELS[frame.period]}/{frame.name}"
        (root / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "photos" / name).symlink_to(truth.image_path(frame))
        known[name] = frame.cam_from_world
    camera = truth.frames[0].camera
    params = " ".join(repr(2 * p) for p in camera.params)
    line = f"*/p?_*.jpg {camera.model} {2 * camera.width} {2 * camera.height} {params}\n"
    (root / "cameras.txt").write_text("# known\n" + line)
    write_control(truth, chosen, root / "points.csv")
    return Few(root / "photos", root / "cameras.txt", root / "points.csv", known)


def write_control(truth: Scene, chosen: list[int], path: Path) -> None:
    """Points inside all of these photos, seen or hidden, spread over the scene, with noise."""
    rng = np.random.default_rng(2)
    points = truth.points
    lines, taken = ["point,image,x,y,X,Y,Z,role,sX,sY,sZ\n"], list[np.ndarray]()
    for i in rng.permutation(len(points)):
        places = [projected(truth.frames[k], points.xyz[i]) for k in chosen]
        apart = [np.linalg.norm(points.xyz[i] - other) for other in taken]
        if any(place is None for place in places) or min(apart, default=99.0) < 3.0:
            continue
        world = points.xyz[i] + rng.normal(0, SURVEY, 3)
        for k, place in zip(chosen, places, strict=True):
            frame = truth.frames[k]
            x, y = place + rng.normal(0, CLICK_PIXELS, 2)
            where = f"{LABELS[frame.period]}/{frame.name},{x:.3f},{y:.3f}"
            at = ",".join(f"{v:.4f}" for v in world)
            lines.append(f"g{len(taken)},{where},{at},control,{SURVEY},{SURVEY},{SURVEY}\n")
        taken.append(points.xyz[i])
        if len(taken) == CONTROL:
            break
    assert len(taken) == CONTROL
    path.write_text("".join(lines))


def projected(frame: Frame, point: np.ndarray) -> np.ndarray | None:
    """Pixel of a world point, None outside of the photo."""
    local = frame.cam_from_world[:3, :3] @ point + frame.cam_from_world[:3, 3]
    place = (frame.camera.K @ local)[:2] / local[2]
    inside = local[2] > 0 and (place > 0).all()
    inside &= bool((place < [frame.camera.width, frame.camera.height]).all())
    return place if inside else None


def registered(few: Few, out: Path, points: Path) -> tuple[Registered, Inspection]:
    found: list[Inspection] = []
    options = Options(
        route="resection", cameras=few.cameras, tie_points=points, threads=1, max_features=1000,
        overwrite=True,
    )  # fmt: skip
    return run(read_captures(few.captures), out, options, inspected=found.append), found[0]


@pytest.mark.slow
def test_few_photos_are_placed_and_say_how_well(few: Few, tmp_path: Path) -> None:
    model, found = registered(few, tmp_path / "out", few.points)
    assert set(model.names) == set(few.truth)
    assert model.resection is not None
    for name, pose in zip(model.names, model.cam_from_world, strict=True):
        centre, turn = map(np.array, model.resection.deviations[name])
        error = camera_centre(pose) - camera_centre(few.truth[name])
        assert (np.abs(error) < 4 * centre).all()
        assert np.linalg.norm(error) < 1.0
        turned = pose[:3, :3].T @ few.truth[name][:3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
        assert angle < 4 * np.linalg.norm(turn)
        assert np.linalg.norm(turn) < 3.0
    left = model.resection.left_out
    assert len(left) == CONTROL
    for both in left.values():
        assert both is not None
        assert (np.abs(both[0]) < 4 * np.array(both[1])).all()
    assert found.verdict.level == "doubtful"  # nothing measures the dates against each other
    assert "known to" in found.position.text
    assert found.position.level != "fail"
    certificate = json.loads((tmp_path / "out/registration.json").read_text())
    assert set(certificate["resection"]["deviations"]) == set(few.truth)

    wrong = tmp_path / "wrong.csv"  # one point is 3 m off: it is named, with the same work folder
    lines = [line.split(",") for line in few.points.read_text().splitlines()]
    for cells in (c for c in lines if c[0] == "g2"):
        cells[4] = str(float(cells[4]) + 3)
    wrong.write_text("\n".join(map(",".join, lines)))
    _, found = registered(few, tmp_path / "out", wrong)
    assert found.position.level == "fail"
    assert found.position.objections[0].place in ("control point g2", "control points")
    assert any(o.place == "control point g2" for o in found.position.objections)


def test_gps_is_compared_in_the_frame_of_the_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = generate_case(CaseSettings(seed=9, points=60, views=4, gps_gross=0)).model
    gps = Georeference(51.0, 11.0, 200.0, "as stated")
    where = gps.to_geodetic(model.gps_enu)
    rows = [f"g{i},a.jpg,1,2,{x},51.002,350" for i, x in enumerate((11.0, 11.001, 11.002))]
    file = tmp_path / "points.csv"
    file.write_text("\n".join(["# crs: EPSG:4326", "point,image,x,y,X,Y,Z", *rows]))
    found: Any = model, {"deviations": {}, "left_out": {}}
    monkeypatch.setattr(route, "resected", lambda *_: found)
    inputs: Any = SimpleNamespace(periods={}, georeference=gps)
    nothing: Any = None
    placed, _ = route.resect_photos(inputs, nothing, read_tie_points(file), None, nothing)
    assert placed.georeference == Georeference(51.002, 11.001, 350.0, "as stated")
    np.testing.assert_allclose(placed.georeference.to_geodetic(placed.gps_enu), where, atol=1e-6)


def test_what_the_route_needs_is_said(few: Few, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--cameras"):
        options = Options(route="resection", tie_points=few.points)
        run(read_captures(few.captures), tmp_path / "out", options)


def test_three_points_leave_several_poses_and_four_leave_one() -> None:
    camera = pycolmap.Camera(model="PINHOLE", width=800, height=600, params=[700, 700, 400, 300])
    world = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [3, 3, 1.0]])
    pose = np.column_stack([np.diag([1.0, -1.0, -1.0]), [-1.0, 1.5, 9.0]])
    local = world @ pose[:, :3].T + pose[:, 3]
    pixels = np.array([camera.img_from_cam(p) for p in local])
    several = poses_of(camera, world[:3], pixels[:3])
    assert len(several) > 1
    assert min(np.abs(found - pose).max() for found in several) < 1e-6
    (one,) = poses_of(camera, world, pixels)
    assert np.abs(one - pose).max() < 1e-6
    assert poses_of(camera, world[:2], pixels[:2]) == []


@pytest.mark.parametrize(
    "line",
    ["* OPENCV 100 100 1 2 3", "* NONE 9 9 1 1 1 1", "* PINHOLE x 9 1 1 1 1", "* PINHOLE", ""],
)
def test_cameras_that_are_none_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / "c.txt").write_text(line)
    with pytest.raises(SceneError, match=r"c\.txt"):
        read_cameras(tmp_path / "c.txt")


def test_cameras_of_names_in_another_unicode_form(tmp_path: Path) -> None:
    name = unicodedata.normalize("NFD", "Süd/ä.jpg")
    (tmp_path / name).parent.mkdir()
    Image.effect_noise((100, 80), 60).save(tmp_path / name)
    (tmp_path / "c.txt").write_text("x/Süd/*.jpg PINHOLE 9 9 1 1 1 1\n", encoding="utf-8")
    (photo,) = read_captures(tmp_path).images
    with pytest.raises(SceneError, match="found none"):
        known_groups(tmp_path / "c.txt", [photo])
    (tmp_path / "c.txt").write_text("Süd/*.jpg PINHOLE 100 80 90 90 50 40\n", encoding="utf-8")
    (group,) = known_groups(tmp_path / "c.txt", [photo])
    assert group["names"] == [name]


def test_cameras_are_scaled_and_must_fit(few: Few, tmp_path: Path, truth: Scene) -> None:
    photos = read_captures(few.captures).images
    (group,) = known_groups(few.cameras, photos)
    assert len(group["names"]) == 4
    np.testing.assert_allclose(group["params"], truth.frames[0].camera.params)
    for text, found in (
        ("*/a.jpg PINHOLE 400 300 1 1 1 1", "found none"),
        ("* PINHOLE 400 400 1 1 1 1", "of another shape"),
    ):
        (tmp_path / "c.txt").write_text(text)
        with pytest.raises(SceneError, match=found):
            known_groups(tmp_path / "c.txt", photos)
