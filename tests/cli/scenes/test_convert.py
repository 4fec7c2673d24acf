"""chronoscene convert: what it prints and how it fails."""

import csv
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner
from command_line import invoke, refused, succeed
from fresh_process import loaded_by

from chronoscene.cli import cli
from chronoscene.errors import ConfigError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene
from chronoscene.geodesy import Georeference, read_reference_system
from chronoscene.io.documents import read_json_document
from chronoscene.scene import WorldFrame
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.splits import split_hash

run = partial(invoke, "convert")


def test_says_what_was_converted(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    result = run(folder, tmp_path / "out", "--to", "nerfstudio")
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0] == (
        f"{tmp_path / 'out'}: nerfstudio from chronoscene, 4 images, 1 camera, 30 points, 2 periods"
    )
    assert lines[1:3] == ["  period 0: 1 train, 1 test", "  period 1: 1 train, 1 test"]
    assert split_hash(read_scene(folder)) in lines[3]
    assert result.stderr == (
        f"read {folder}\nimages: 1 of 4\n"
        "note: nerfstudio cannot store the observations of points, their ids and errors\n"
    )
    assert read_scene(tmp_path / "out").format == "nerfstudio"


def test_the_split_is_that_of_the_scene_that_was_written(make_scene_folder, tmp_path):
    result = run(make_scene_folder(), tmp_path / "out", "--to", "cl-splats")
    scene = read_scene(tmp_path / "out")
    assert "split: every 8th image of all in name order" in result.stdout
    assert split_hash(scene) in result.stdout and "  period 1: 2 train, 0 test" in result.stdout


@pytest.mark.parametrize(("kind", "is_link"), [("hard", False), ("sym", True)])
def test_links(make_scene_folder, tmp_path, kind, is_link):
    folder = make_scene_folder()
    assert run(folder, tmp_path / "out", "--link", kind).exit_code == 0
    image = tmp_path / "out/images/a/0001.png"
    assert image.samefile(folder / "images/a/0001.png") and image.is_symlink() == is_link


def test_options_of_the_source(make_scene_folder, tmp_path):
    folder = make_scene_folder({"a.png": 0, "b.png": 0})
    (folder / "sparse/split.txt").unlink()
    table = tmp_path / "periods.csv"
    table.write_text("file,period\na.png,2016\nb.png,2023\n")
    options = ["--dataset-format", "colmap-folders", "--period-by", f"table:{table}"]
    result = run(folder, tmp_path / "out", *options)
    assert "  period 1 (2023): 0 train, 1 test" in result.stdout
    assert [p.date for p in read_scene(tmp_path / "out").periods] == ["2016", "2023"]


def test_coordinates_in_a_reference_system(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    with pytest.raises(ConfigError, match="expected a georeferenced scene"):
        run(folder, tmp_path / "none", "--crs", "EPSG:32632")
    frame = Georeference(51.0, 11.0, 200.0, "as stated")
    world = {"unit": "metre", "crs": frame.crs, "offset": [0.0, 0.0, 0.0]}
    (folder / "sparse/world.json").write_text(json.dumps(world))
    (folder / "georeference.json").write_text('{"height_kind": "relative"}')
    assert run(folder, tmp_path / "out", "--crs", "EPSG:32632").exit_code == 0
    written = json.loads((tmp_path / "out/georeference.json").read_text())
    assert written["height_kind"] == "relative"
    rows = list(csv.DictReader((tmp_path / "out/cameras.csv").open()))
    scene = read_scene(folder)
    assert [r["image"] for r in rows] == [f.name for f in scene.frames]
    places = np.array([[float(r[c]) for c in "ENh"] for r in rows])
    centres = camera_centre(scene.frame_poses)
    utm = read_reference_system("", "EPSG:32632")
    np.testing.assert_allclose(utm.to_local(frame, places), centres, atol=1e-3)
    assert (tmp_path / "out/points.ply").is_file()
    (tmp_path / "out/certificate.json").touch()
    again = run(tmp_path / "out", tmp_path / "again", "--crs", "EPSG:32633")
    assert "not part of the format, and not converted: certificate.json\n" in again.stderr
    without = run(tmp_path / "out", tmp_path / "without", "--to", "nerfstudio")
    assert "not converted: cameras.csv, certificate.json, georeference.json" in without.stderr


def test_records_of_a_registration_go_along(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    for name in ("georeference.json", "registration.json", "other.json"):
        (folder / name).write_text("{}")
    result = run(folder, tmp_path / "out")
    assert "not converted: other.json\n" in result.stderr
    assert {path.name for path in (tmp_path / "out").glob("*.json")} == {
        "georeference.json", "registration.json",
    }  # fmt: skip


def test_coordinates_need_no_second_reading(make_scene_folder, tmp_path, monkeypatch):
    folder = make_scene_folder()
    world = {"crs": Georeference(51.0, 11.0, 200.0, "as stated").crs}
    (folder / "sparse/world.json").write_text(json.dumps(world))
    original, read = our_format.read, []
    monkeypatch.setattr(our_format, "read", lambda *a, **k: read.append(a[0]) or original(*a, **k))
    result = run(folder, tmp_path / "out", "--crs", "EPSG:32632")
    assert read == [folder, tmp_path / "out"]
    assert "outside of the area" not in result.stderr


def test_a_system_of_another_region_is_remarked_on(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    world = {"crs": Georeference(51.0, 11.0, 200.0, "as stated").crs}
    (folder / "sparse/world.json").write_text(json.dumps(world))
    result = run(folder, tmp_path / "out", "--crs", "EPSG:2193")
    assert "note: the scene is at 51.0000 north, 11.0000 east, outside of the area" in result.stderr


def test_points_that_are_not_finite_have_no_coordinates(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    scene.points.xyz[0] = np.nan
    world = WorldFrame("metre", Georeference(51.0, 11.0, 200.0, "as stated").crs)
    our_format.write(replace(scene, world=world), tmp_path / "nan", image_source="copy")
    assert run(tmp_path / "nan", tmp_path / "out", "--crs", "EPSG:32632").exit_code == 0
    record = read_json_document(tmp_path / "out/georeference.json")
    assert 0 <= record["output"]["largest_error"] < 1
    assert b"element vertex 29\n" in (tmp_path / "out/points.ply").read_bytes()


def test_coordinates_are_of_the_images_that_were_written(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    world = {"crs": Georeference(51.0, 11.0, 200.0, "as stated").crs}
    (folder / "sparse/world.json").write_text(json.dumps(world))
    assert run(folder, tmp_path / "out", "--to", "wat", "--crs", "EPSG:32632").exit_code == 0
    rows = list(csv.DictReader((tmp_path / "out/cameras.csv").open()))
    new = read_scene(tmp_path / "out", format="wat")
    assert [r["image"] for r in rows] == [f.name for f in new.frames]
    assert all((tmp_path / "out/images" / r["image"]).is_file() for r in rows)
    assert rows[0]["image"] != read_scene(folder).frames[0].name


@pytest.mark.parametrize(
    "world",
    [
        {"crs": "EPSG:32632", "offset": [640000, 5650000, 200]},
        {"crs": Georeference(51.0, 11.0, 200.0, "as stated").crs, "offset": [10, 0, 0]},
    ],
)
def test_coordinates_are_not_written_without_the_offset(make_scene_folder, tmp_path, world):
    folder = make_scene_folder()
    (folder / "sparse/world.json").write_text(json.dumps(world))
    with pytest.raises(
        ConfigError, match="the local frame of register, without an offset"
    ) as error:
        run(folder, tmp_path / "out", "--crs", "EPSG:32632")
    assert f"{world['crs']} with the offset" in str(error.value)
    assert not (tmp_path / "out").exists()


def test_help_lists_formats_and_groupings():
    text = " ".join(run("--help").stdout.split())
    for word in ("cl-splats", "neusc: year, month, day, gap:DAYS, count:N", "--link", "table:FILE"):
        assert word in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/absent", "{tmp}/out"], "expected a scene folder, found nothing"),
        (["{scene}", "{scene}/out"], "OUT {scene}/out: expected a place outside the scene"),
        (["{scene}", "{tmp}"], "expected a new or empty folder"),
        (["{scene}", "{tmp}/out", "--period-by", "year"], "--period-by: expected no such option"),
    ],
)
def test_errors_are_one_line(make_scene_folder, tmp_path, arguments, message):
    scene = make_scene_folder()
    words = [a.format(tmp=tmp_path, scene=scene) for a in arguments]
    error = refused("convert", *words)
    assert message.format(scene=scene) in error.splitlines()[-1]
    assert error.count("\n") <= 2  # after "read SRC"


def test_dataset_commands_do_not_need_torch():
    names = ", ".join(
        f"chronoscene.cli.scenes.{name}" for name in ("convert", "split", "undistort")
    )
    assert not loaded_by(f"import {names}") & {"torch", "pandas"}


def test_labels_that_the_output_cannot_encode(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    (folder / "sparse/periods.json").write_text('[{"id": 0, "label": "früher"}, {"id": 1}]')
    result = CliRunner(charset="ascii").invoke(cli, ["convert", str(folder), str(tmp_path / "o")])
    assert result.exit_code == 0 and "fr\\xfcher" in result.stdout


@pytest.mark.parametrize("command", ["convert", "split", "stats", "undistort", "validate"])
def test_every_command_reads_colmap_projects_alike(make_scene_folder, tmp_path, command):
    """With the model where nerfstudio leaves it, and periods that a table names."""
    folder = make_scene_folder({"a.png": 0, "b.png": 0, "c.png": 0, "d.png": 0})
    (folder / "sparse/split.txt").unlink()
    (folder / "sparse").rename(tmp_path / "sparse")
    (folder / "colmap").mkdir()
    (tmp_path / "sparse").rename(folder / "colmap/sparse")
    table = tmp_path / "periods.csv"
    table.write_text("file,period\na.png,2016\nb.png,2023\nc.png,2016\nd.png,2023\n")
    out = [] if command in ("stats", "validate") else [str(tmp_path / "out")]
    result = CliRunner().invoke(cli, [command, str(folder), *out])
    assert result.exit_code != 0
    assert "--period-by year, month or day" in f"{result.output}{result.exception}"
    rule = ["--dataset-format", "colmap-folders", "--period-by", f"table:{table}"]
    result = succeed(command, folder, *out, *rule)
    assert "the model is read from colmap/sparse/0, the images from images" in result.output
