"""Change maps of a small run, scored by masks that tests paint; the command ``changes``."""

import csv
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import plyfile
import pytest
from command_line import invoke
from PIL import Image

from chronoscene.errors import ConfigError, SceneError
from chronoscene.harness.use.change_scores import changes_csv, changes_table, map_run
from chronoscene.harness.use.changes import GEOMETRY, usual_pairs
from chronoscene.harness.use.trained_run import open_run
from chronoscene.images import truth
from chronoscene.scene.cameras import project_points


@pytest.fixture
def run(trained):
    return open_run(trained["chronogs"])


@pytest.fixture
def scene(run, tmp_path):
    """That of the run, with a truth: in each test view, what is left of the middle has changed."""
    scene = run.scene()
    root = shutil.copytree(scene.root, tmp_path / scene.root.name)
    for frame in scene.select(split="test"):
        place = root / "gt" / truth.truth_place("change", frame.name, 1 - frame.period)
        place.parent.mkdir(parents=True, exist_ok=True)
        changes = np.zeros((16, 24), np.uint8)
        changes[:, :12] = truth.GEOMETRY
        changes[:, 12:15] = truth.APPEARANCE
        Image.fromarray(changes).save(place)
    return run.scene(root)


def test_a_run_is_scored(run, scene):
    ((made, scores),) = map_run(run, scene, [(0, 1)])
    assert len(made.xyz) > 100
    assert set(scores) == {
        f"{name}_{metric}_{kind}"
        for name in ("map", "image")
        for metric in ("ap", "f1")
        for kind in ("geometry", "appearance")
    }
    assert all(0 <= value <= 1 for value in scores.values())
    table = changes_table([(made, scores), (made, {})], {"0": "may", "1": "june"}, "title")
    assert [line[:2] for line in table.rows] == [["may", "june"]] * 2
    assert table.rows[0][7] == f"{scores['map_ap_geometry']:.3f}"
    assert table.rows[1][7:] == ["-"] * 8
    head, *lines = changes_csv([(made, scores), (made, {})]).splitlines()
    assert head.startswith("from,to,places,unknown,appearance,gone,new,map_ap_geometry,image_ap_g")
    assert lines[0].split(",")[:3] == ["0", "1", str(len(made.xyz))]
    assert lines[1].endswith("," * 8)


def masked(scene, first, split="test"):
    """The scene with masks that ignore the columns before the first."""
    masks = {}
    for frame in scene.select(split=split):
        masks[frame.name] = scene.root / f"{frame.name.replace('/', '_')}.mask{first}.png"
        kept = np.zeros((16, 24), np.uint8)
        kept[:, first:] = 255
        Image.fromarray(kept).save(masks[frame.name])
    return replace(scene, masks=masks)


def test_masked_pixels_do_not_count(run, scene):
    ((_, scores),) = map_run(run, masked(scene, 12), [(0, 1)])
    assert {key.split("_")[2] for key in scores} == {"appearance"}  # geometry is left of it
    ((_, scores),) = map_run(run, masked(scene, 24), [(0, 1)])
    assert scores == {}


def test_cameras_see_nothing_where_masks_ignore_their_photos(run, scene):
    scene = masked(scene, 12, "train")
    ((made, _),) = map_run(run, scene, [(0, 1)])
    sights = []
    for period in (0, 1):
        columns = [
            project_points(f.camera, made.xyz @ pose[:3, :3].T + pose[:3, 3])[:, 0]
            for f in scene.select(split="train", period=period)
            for pose in (f.cam_from_world,)
        ]
        sights.append(np.nanmax(columns, axis=0) >= 12)
    own, other = np.where(made.later, sights[::-1], sights)
    assert own.all() and other[made.known].all() and not made.known.all()
    ((whole, _),) = map_run(run, run.scene(), [(0, 1)])
    assert made.known.sum() < whole.known.sum()


def test_a_scene_without_truth(run):
    ((_, scores),) = map_run(run, run.scene(), [(0, 1)])
    assert scores == {}


def test_a_model_for_each_period(trained):
    run = open_run(trained["4dgs"])
    assert run.record.sharing is None and "sharing" in run.record.absent
    ((made, _),) = map_run(run, run.scene(), [(0, 1)])
    assert made.later.any()
    assert not made.later.all()


def test_models_that_cannot_be_compared(run):
    pooled = replace(run, record=run.record.model_copy(update={"strategy": "pooled"}))
    with pytest.raises(ConfigError, match="expected models that know the periods, found one that"):
        next(map_run(pooled, run.scene(), [(0, 1)]))
    flat = replace(run, spec=replace(run.spec, outputs=("rgb",)))
    with pytest.raises(ConfigError, match="expected a method that renders depth, found one that"):
        next(map_run(flat, run.scene(), [(0, 1)]))


changes = partial(invoke, "changes")


def test_the_command_writes_a_folder(run, scene, tmp_path):
    result = changes(run.folder, "--scene", scene.root, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "ring: chronogs joint fast iterations=12 seed 0" in result.stdout
    blocks = run.record.sharing.blocks
    assert sum(blocks) == run.record.primitives and "sharing" not in run.record.absent
    assert f"of its {sum(blocks):,} anchors" in result.stdout
    out = {path.name for path in (tmp_path / "out").iterdir()}
    assert out == {"changes.csv", "changes.png", "changes_0_1.ply"}
    (row,) = csv.DictReader((tmp_path / "out/changes.csv").open())
    vertex = plyfile.PlyData.read(tmp_path / "out/changes_0_1.ply")["vertex"]
    assert len(vertex) == int(row["places"])
    assert np.mean(vertex["known"] == 0) == float(row["unknown"])
    changed = (vertex["geometry"] >= GEOMETRY) & (vertex["known"] == 1)
    gone = changed & (vertex["period"] == 0)
    assert gone.sum() / (vertex["period"] == 0).sum() == pytest.approx(float(row["gone"]))
    colors = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)
    assert (colors[gone] == (181, 18, 27)).all()
    assert (colors[vertex["known"] == 0] == (140, 140, 140)).all()
    again = changes(run.folder, "--out", tmp_path / "again", *("--between", "autumn", 0) * 2)
    assert len((tmp_path / "again/changes.csv").read_text().splitlines()) == 2
    assert "not scored: no change masks of test views" in again.stderr
    clouds = [tmp_path / name / "changes_0_1.ply" for name in ("out", "again")]
    assert clouds[0].read_bytes() == clouds[1].read_bytes()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("0", "spring"), "--between 0 spring: expected two periods .*, found the same one twice"),
        (("0", "0.5"), "found an unknown one"),
        (("0", "2"), "found an unknown one; choose among 0 .spring., 1"),
    ],
)
def test_what_is_no_pair_of_periods(run, tmp_path, names, message):
    with pytest.raises(ConfigError, match=message):
        changes(run.folder, "--out", tmp_path / "out", "--between", *names)
    assert not (tmp_path / "out").exists()


def test_places_that_are_refused(run, scene, tmp_path):
    with pytest.raises(ConfigError, match=r"--out .*: expected a place outside the scene"):
        changes(run.folder, "--scene", scene.root, "--out", scene.root / "out")
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").touch()
    with pytest.raises(
        SceneError, match="expected a new or empty folder, found one that is not empty"
    ):
        changes(run.folder, "--scene", scene.root, "--out", tmp_path / "used")


def test_pairs_unless_the_user_chooses():
    assert usual_pairs(1) == []
    assert usual_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    assert usual_pairs(40) == [(period, period + 1) for period in range(39)]


def test_a_run_of_one_period(run, monkeypatch, tmp_path):
    record = run.record.model_copy(update={"period_labels": {"0": "spring"}})
    monkeypatch.setattr(
        "chronoscene.cli.runs.changes.open_run",
        lambda *args, **options: replace(run, record=record),
    )
    with pytest.raises(ConfigError, match="expected a run of two periods or more, found one"):
        changes(run.folder, "--out", tmp_path / "out")
