"""The command: its files, its summary, and one error for each kind of bad input."""

import csv
import errno
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from surveyed import ToyRun, make_scene

from chronoscene.cli import cli
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as scene_format
from chronoscene.geodesy import Georeference
from chronoscene.scene import WorldFrame
from chronoscene.survey import difference, products
from chronoscene.survey.map_frame import map_frame
from chronoscene.survey.uncertainty import UNKNOWN

PLACE = Georeference(46.5, 11.35, 300.0, "as stated")


@pytest.fixture
def site(scene, tmp_path, monkeypatch):
    """Folder of a run of the toy, and the toy; the scene is where `scene` says."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text("{}")
    toy = ToyRun(replace(scene, world=WorldFrame("metre", PLACE.crs)), noise=0.01)
    monkeypatch.setattr("chronoscene.cli.runs.survey.open_run", lambda *args, **options: toy)
    return run, toy


def survey(*arguments):
    return CliRunner().invoke(cli, ["survey", *map(str, arguments)])


def test_a_model_that_was_not_held_to_the_points_says_so(site, tmp_path):
    run, toy = site
    toy.config.depth_weight = 0.0
    result = survey(run, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: the model was not held to the sparse points" in result.output
    toy.config.depth_weight = 0.1
    assert "note" not in survey(run, "--out", tmp_path / "held").output


def test_heights_are_of_the_kind_that_a_registration_states(scene, tmp_path):
    scene = replace(scene, world=WorldFrame("metre", PLACE.crs))
    made = products.Survey(tmp_path, scene, map_frame(scene, None))
    assert made.coordinates()["heights"] == "as in the scene; no geoid is applied"
    (scene.root / "georeference.json").write_text('{"height_kind": "relative"}')
    assert made.coordinates()["heights"] == "relative; no geoid is applied"


def test_all_products_of_a_run(site, tmp_path):
    run, _ = site
    pit = PLACE.to_geodetic(np.array([[x, y, 0.0] for x, y in ((1, -2), (7, -2), (7, 5), (1, 5))]))
    ring = [[lon, lat] for lat, lon, _ in pit[[0, 1, 2, 3, 0]]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"name": "box"}, "geometry": shape}
    (tmp_path / "area.json").write_text(json.dumps(feature))
    out = tmp_path / "out"
    result = survey(run, "--out", out, "--area", tmp_path / "area.json")
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == {
        "difference_0_1.png", "difference_0_1.tif", "m3c2_0_1.laz", "survey.json", "volumes.csv",
        *(f"{kind}_{label}" for kind in ("orthophoto", "surface") for label in
          ("before_0.tif", "after_1.tif")), "points_before_0.laz", "points_after_1.laz",
    }  # fmt: skip
    summary = json.loads((out / "survey.json").read_text())
    assert summary["coordinates"]["crs"] == "EPSG:32632"
    with open(out / "volumes.csv", newline="") as file:
        whole, box = csv.DictReader(file)
    assert (whole["polygon"], box["polygon"]) == ("whole area", "box")
    for row in (whole, box):
        assert float(row["fill_m3"]) == pytest.approx(60, rel=0.1)
        assert float(row["cut_m3"]) == pytest.approx(0, abs=0.5)
    assert float(box["area_m2"]) == pytest.approx(42, rel=0.1)
    assert "before → after" in result.stdout and "EPSG:32632" in result.stdout
    heights = summary["periods"][0]["sparse_points"]
    assert f"heights minus {heights['count']} sparse points: median " in result.stdout
    assert "note" not in summary
    with rasterio.open(out / "surface_after_1.tif") as file:
        assert file.crs.to_epsg() == 32632
        from pyproj import Transformer

        to = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
        for place, height in (((4.0, 1.5), 303.0), ((-4.0, 1.5), 300.0), ((4.0, -3.0), 300.0)):
            lat, lon, _ = PLACE.to_geodetic(np.array([[*place, 0.0]]))[0]
            found = next(file.sample([to.transform(lon, lat)]))
            assert found[0] == pytest.approx(height, abs=0.05) and found[2] >= 2
    cloud = laspy.read(out / "points_after_1.laz")
    assert (np.asarray(cloud["period"]) == 1).all() and len(cloud) > 500
    assert np.asarray(cloud.z).max() == pytest.approx(303, abs=0.05)


def test_intervals_without_the_error_of_the_alignment_are_named(site, tmp_path, monkeypatch):
    arguments = (site[0], "--resolution", "1", "--out")
    assert "alignment" not in survey(*arguments, tmp_path / "known").stderr
    monkeypatch.setattr(difference, "find_registration", lambda *_: UNKNOWN)
    result = survey(*arguments, tmp_path / "unknown")
    assert "before → after: error of the alignment unknown, and left out: there is" in result.stderr


def test_a_system_of_another_region_is_remarked_on(site, tmp_path):
    result = survey(site[0], "--out", tmp_path / "out", "--resolution", "1", "--crs", "EPSG:32633")
    (remark,) = json.loads((tmp_path / "out/survey.json").read_text())["coordinates"]["remarks"]
    assert "outside of the area of EPSG:32633" in remark and f"note: {remark}" in result.stderr


def test_two_runs_give_equal_files(site, tmp_path):
    run, _ = site
    for name in "ab":
        assert survey(run, "--out", tmp_path / name, "--resolution", "1").exit_code == 0
    for path in sorted((tmp_path / "a").iterdir()):
        if path.suffix != ".laz":  # their header has the day
            assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path


def test_a_pair_that_is_named_twice_is_compared_once(site, tmp_path):
    run, _ = site
    twice = ("--between", "0", "1", "--between", "after", "before")
    assert survey(run, "--out", tmp_path / "out", "--resolution", "1", *twice).exit_code == 0
    summary = json.loads((tmp_path / "out/survey.json").read_text())
    assert not summary["coordinates"]["remarks"]
    assert [pair["periods"] for pair in summary["pairs"]] == [[0, 1]]
    assert len((tmp_path / "out/volumes.csv").read_text().splitlines()) == 2


def test_one_period_has_no_volumes(site, tmp_path):
    run, toy = site
    frames = toy.found.frames[:16]
    points = replace(toy.found.points, track_frame=toy.found.points.track_frame % 16)
    toy.num_periods = 1
    toy.found = replace(toy.found, frames=frames, points=points, periods=toy.found.periods[:1])
    assert survey(run, "--out", tmp_path / "out", "--resolution", "1").exit_code == 0
    with open(tmp_path / "out/volumes.csv", newline="") as file:
        rows = csv.DictReader(file)
        assert not list(rows) and rows.fieldnames[:3] == ["a", "b", "polygon"]


def test_a_scene_without_a_model_has_points_alone(tmp_path):
    scene = scene_format.write(make_scene(tmp_path), tmp_path / "site", image_source="none")
    result = survey(scene, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert {p.suffix for p in (tmp_path / "out").iterdir()} == {".laz", ".json"}
    assert "too few for surfaces" in result.stderr and "need a finished run" in result.stderr
    assert "local metres" in result.stdout
    for option in ("--resolution", "--area"):
        value = "1" if option == "--resolution" else scene / "sparse/world.json"
        again = survey(scene, "--out", tmp_path / "again", option, value)
        assert f"{option}: expected a finished run" in str(again.exception)
    again = survey(site, "--out", tmp_path / "again", "--device", "cpu")
    assert "--device: expected no such option for a scene without a model" in str(again.exception)


@pytest.mark.parametrize("kind", ["run", "scene"])
def test_points_that_are_not_finite_are_left_out(site, tmp_path, kind):
    run, toy = site
    toy.found.points.xyz[:3] = [np.nan, np.inf, 0.0]
    source = run
    if kind == "scene":
        source = scene_format.write(toy.found, tmp_path / "site", image_source="none")
    result = survey(source, "--out", tmp_path / "out", *(["--resolution", "1"] * (kind == "run")))
    assert result.exit_code == 0, result.output
    if kind == "scene":
        periods = json.loads((tmp_path / "out/survey.json").read_text())["periods"]
        assert sum(p["points"] for p in periods) == len(toy.found.points) - 3


@pytest.mark.parametrize("copies", [1, 3])
def test_distances_between_dense_sparse_points(tmp_path, copies):
    """The points of each period lie in a plane of their own, 0.5 m apart in a quarter of it."""
    made = make_scene(tmp_path)
    east, north = np.meshgrid(np.arange(40) / 4, np.arange(40) / 4)
    planes = [np.stack([east, north, np.full_like(east, 0.0)], axis=-1).reshape(-1, 3)] * 2
    planes[1] = planes[1] + [0, 0, 0.5] * ((planes[1] > 5)[:, :2].all(axis=1)[:, None])
    rng = np.random.default_rng(0)
    planes = [np.repeat(p + rng.normal(0, 1e-3, p.shape), copies, axis=0) for p in planes]
    count = len(planes[0])
    points = replace(
        made.points,
        ids=np.arange(1, 2 * count + 1),
        xyz=np.concatenate(planes),
        rgb=np.zeros((2 * count, 3), np.uint8),
        error=np.zeros(2 * count),
        track_start=2 * np.arange(2 * count + 1),
        track_frame=np.repeat([0, 16], 2 * count).astype(np.int32) + np.tile([0, 5], 2 * count),
        track_xy=np.ones((4 * count, 2)),
    )
    site = scene_format.write(replace(made, points=points), tmp_path / "s", image_source="none")
    result = survey(site, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    read = laspy.read(tmp_path / "out/m3c2_0_1.laz")
    moved = (read.x > 6) & (read.y > 6)
    np.testing.assert_allclose(np.asarray(read["m3c2_distance"])[moved], 0.5, atol=0.01)
    assert (np.asarray(read["significant"]) == 1)[moved].all() and not read["significant"][0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--between", "0", "7"), "--between 0 7: expected two periods of the scene, found an unk"),
        (("--between", "after", "1"), "found the same one twice; choose among 0 .before., 1"),
        (("--crs", "nonsense"), "that PROJ knows"),
        (("--resolution", "1e-4"), "at most 20,000,000 cells"),
    ],
)
def test_bad_options(site, tmp_path, arguments, message):
    run, _ = site
    result = survey(run, "--out", tmp_path / "out", *arguments)
    assert isinstance(result.exception, ChronoSceneError)
    assert result.exception.args and not (tmp_path / "out").exists()
    with pytest.raises(ChronoSceneError, match=message):
        raise result.exception


def test_places_that_cannot_be_written(site, tmp_path):
    run, toy = site
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").touch()
    result = survey(run, "--out", tmp_path / "used")
    assert "expected a new or empty folder" in str(result.exception)
    result = survey(run, "--out", toy.found.root / "out")
    assert "expected a place outside the scene" in str(result.exception)


def test_a_run_that_does_not_know_the_periods(site, tmp_path):
    run, toy = site
    toy.distinguishes_periods = False
    result = survey(run, "--out", tmp_path / "out")
    assert "a run whose models know the periods, found Toy under strategy pooled" in str(
        result.exception
    )


def test_a_scene_without_metres(site, tmp_path):
    run, toy = site
    toy.found = replace(toy.found, world=WorldFrame())
    result = survey(run, "--out", tmp_path / "out")
    assert "expected a scene in metres" in str(result.exception)


def test_a_full_disk_leaves_nothing(site, tmp_path, monkeypatch):
    run, _ = site
    write = Path.write_bytes

    def full(path, data):
        if path.suffix == ".laz":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    result = survey(run, "--out", tmp_path / "out")
    assert "expected space for what is written there" in str(result.exception)
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ChronoSceneError, match=r"package laspy, found .*chronoscene\[survey\]"):
        products.check_packages()
