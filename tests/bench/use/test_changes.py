"""Constructed scenes whose changes are known: a box, a patch of another colour, another light."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import plyfile
import pytest
from click.testing import CliRunner
from PIL import Image

from chronoscene.bench.use.cameras import Viewpoint
from chronoscene.bench.use.changes import (
    CLASSES,
    GEOMETRY,
    back_project,
    changes_csv,
    changes_table,
    map_changes,
    map_run,
    unexplained,
)
from chronoscene.bench.use.trained_run import open_run
from chronoscene.cli import cli
from chronoscene.cli.runs.changes import usual_pairs
from chronoscene.errors import ConfigError, SceneError
from chronoscene.images import truth
from chronoscene.methods import Prediction
from chronoscene.scene import Camera
from chronoscene.scene.geometry import camera_centre, look_at

CAMERA = Camera(1, "PINHOLE", 64, 48, (50.0, 50.0, 31.0, 25.0))
LOW, HIGH = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0])  # The box
GROUND, PATCH = np.array([0.5, 0.4, 0.3]), np.array([0.2, 0.3, 0.6])


def viewpoints(period, centres):
    up = np.array([0.0, 1.0, 0.0])
    poses = [look_at(np.array(c), np.array([*c[:2], 0]), up=up) for c in centres]
    return [Viewpoint("", CAMERA, pose, period) for pose in poses]


ROUND = [(x, y, 10.0) for x in (-4.0, 0.0, 4.0) for y in (-4.0, 0.0, 4.0)]
BOTH = viewpoints(0, ROUND) + viewpoints(1, ROUND)


def renderer(*, boxes=(), patches=(), lights=(1.0, 1.0)):
    """Renders the plane z = 0, with a box, a patch and a light at some periods."""

    def render(camera, cam_from_world, period):
        centre = camera_centre(cam_from_world)
        viewpoint = Viewpoint("", camera, cam_from_world, period)
        rays = back_project(np.ones((camera.height, camera.width)), viewpoint) - centre
        depth = -centre[2] / rays[:, 2]
        if period in boxes:
            with np.errstate(divide="ignore"):
                limits = (np.stack([LOW, HIGH]) - centre)[:, None] / rays
            enter, leave = limits.min(axis=0).max(axis=1), limits.max(axis=0).min(axis=1)
            depth = np.where(enter < leave, enter, depth)
        xyz = centre + depth[:, None] * rays
        in_patch = (np.abs(xyz[:, :2] - (3, 3)) < 1).all(axis=1) & (period in patches)
        rgb = np.where(in_patch[:, None], PATCH, GROUND) * lights[period]
        shape = camera.height, camera.width
        return Prediction(rgb.reshape(*shape, 3).astype(np.float32), depth=depth.reshape(shape))

    return render


def named(made, name):
    return made.classes == CLASSES.index(name)


def beside_box(xyz):
    """Farther from the box than pixels are large."""
    return (np.abs(xyz[:, :2]) > 1.5).any(axis=1)


@pytest.mark.parametrize("period", [0, 1])
def test_a_box_of_one_period(period):
    made = map_changes(renderer(boxes=[period]), BOTH, (0, 1))
    kind, other = ("new", "gone") if period else ("gone", "new")
    top = np.isclose(made.xyz[:, 2], 2)
    assert top.sum() > 100
    assert named(made, kind)[top].all()
    assert (made.later[top] == period).all()
    assert not named(made, other).any()
    far = beside_box(made.xyz)
    assert (made.geometry[far] == 0).all()
    assert not named(made, "appearance").any()
    under = (np.abs(made.xyz[:, :2]) < 0.3).all(axis=1) & (made.xyz[:, 2] < 0.1)
    assert under.any()  # nobody sees at the other period what is there
    assert named(made, "unknown")[under].all()


def test_the_score_is_the_change_of_depth_at_the_usual_distance():
    straight = viewpoints(0, [(0.0, 0.0, 10.0)] * 15) + viewpoints(1, [(0.0, 0.0, 10.0)] * 15)
    made = map_changes(renderer(boxes=[1]), straight, (0, 1))
    top = np.isclose(made.xyz[:, 2], 2)
    np.testing.assert_allclose(made.geometry[top], 10 * (1 / 8 - 1 / 10) * 30 / 35)


def test_periods_that_are_the_same():
    made = map_changes(renderer(boxes=[0, 1], patches=[0, 1]), BOTH, (0, 1))
    assert (made.geometry == 0).all()
    assert made.appearance.max() < 1e-6
    assert made.shares() == dict.fromkeys(CLASSES[1:], 0)


def test_a_change_of_colour_alone():
    made = map_changes(renderer(boxes=[0, 1], patches=[1]), BOTH, (0, 1))
    assert (made.geometry == 0).all()
    inside = (np.abs(made.xyz[:, :2] - (3, 3)) < 0.8).all(axis=1)
    outside = (np.abs(made.xyz[:, :2] - (3, 3)) > 1.2).any(axis=1)
    assert named(made, "appearance")[inside].all()
    assert named(made, "unchanged")[outside].all()


def test_a_change_of_light_is_none():
    lights = (1.0, np.array([0.9, 0.6, 0.3]))
    made = map_changes(renderer(patches=[0, 1], lights=lights), BOTH, (0, 1))
    assert named(made, "unchanged").all()


def test_what_one_period_does_not_see_is_unknown():
    left, right = ([(x + side, y, 10.0) for x, y, _ in ROUND] for side in (-7.0, 7.0))
    made = map_changes(renderer(boxes=[0]), viewpoints(0, left) + viewpoints(1, right), (0, 1))
    unknown = named(made, "unknown")
    assert unknown[np.abs(made.xyz[:, 0]) > 4].all()
    assert named(made, "gone")[np.isclose(made.xyz[:, 2], 2) & (made.xyz[:, 0] > 0)].all()
    assert (made.geometry[unknown] == 0).all()
    assert made.shares()["unknown"] == np.mean(unknown) > 0.5


def test_periods_that_see_nothing_in_common():
    made = map_changes(
        renderer(), viewpoints(0, [(-50.0, 0.0, 10.0)]) + viewpoints(1, [(50.0, 0.0, 10.0)]), (0, 1)
    )
    assert named(made, "unknown").all()


def test_a_period_that_shows_nothing():
    empty = Prediction(np.zeros((48, 64, 3), np.float32), depth=np.zeros((48, 64), np.float32))
    render = renderer()
    with pytest.raises(ConfigError, match="period 1: expected surfaces in its training views"):
        map_changes(lambda c, pose, p: empty if p else render(c, pose, p), BOTH, (0, 1))
    with pytest.raises(ConfigError, match="period 1: expected surfaces"):
        map_changes(render, viewpoints(0, ROUND), (0, 1))


def test_behind_what_is_gone_there_may_be_nothing():
    def render(camera, pose, period):
        shown = renderer(boxes=[0])(camera, pose, 0)
        return replace(shown, depth=np.where(shown.depth < 9.9, 0, 10)) if period else shown

    made = map_changes(render, BOTH, (0, 1))
    assert named(made, "gone")[np.isclose(made.xyz[:, 2], 2)].all()


def test_a_view_has_the_scores_of_both_surfaces():
    """Seen from above, the box hides what is unchanged below it."""
    render = renderer(boxes=[1], patches=[1])
    made = map_changes(render, BOTH, (0, 1))
    (viewpoint,) = viewpoints(0, [(0.5, 0.5, 10.0)])
    shown = [render(viewpoint.camera, viewpoint.cam_from_world, period) for period in (0, 1)]
    scores = made.view_scores(viewpoint, shown)
    changed = shown[0].depth - shown[1].depth > 1
    assert scores.shape == (48, 64, 2)
    assert (scores[changed, 0] > GEOMETRY).mean() > 0.95
    assert (scores[~changed, 0] < GEOMETRY).mean() > 0.95
    painted = (shown[0].rgb != shown[1].rgb).any(axis=2)
    assert scores[painted & ~changed, 1].mean() > 5 * scores[~painted, 1].mean()


def test_colours_that_one_map_explains_but_for_a_few():
    rng = np.random.default_rng(0)
    first = rng.uniform(0.1, 0.9, (500, 3))
    sums = (first + 0.05).sum(axis=1, keepdims=True)
    second = first.copy()
    second[:20] = second[:20, ::-1]
    second = (second + 0.05) * rng.uniform(0.5, 2, sums.shape) - 0.05  # brightness does not count
    counted = np.arange(500) >= 10
    found = unexplained(first, second, counted)
    assert (found[:10] == 0).all()
    assert found[20:].max() < 1e-3 < 0.02 < np.median(found[10:20])


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


def masked(scene, first):
    """The scene with masks that ignore the columns before the first."""
    masks = {}
    for frame in scene.select(split="test"):
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


def test_a_scene_without_truth(run):
    ((_, scores),) = map_run(run, run.scene(), [(0, 1)])
    assert scores == {}


def test_a_model_for_each_period(trained):
    run = open_run(trained["4dgs"])
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


def changes(*arguments):
    return CliRunner().invoke(cli, ["changes", *map(str, arguments)], catch_exceptions=False)


def test_the_command_writes_a_folder(run, scene, tmp_path):
    result = changes(run.folder, "--scene", scene.root, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "ring: chronogs joint fast iterations=12 seed 0" in result.stdout
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
    again = changes(run.folder, "--out", tmp_path / "again", "--between", "autumn", 0)
    assert "not scored: no change masks of test views" in again.stderr
    clouds = [tmp_path / name / "changes_0_1.ply" for name in ("out", "again")]
    assert clouds[0].read_bytes() == clouds[1].read_bytes()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("0", "spring"), "--between 0 spring: expected two periods .*, found the same one twice"),
        (("0", "0.5"), "found a time between them"),
        (("0", "2"), "period 2: expected one from 0 to 1"),
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
    with pytest.raises(SceneError, match="expected a new or empty folder, found one in use"):
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
