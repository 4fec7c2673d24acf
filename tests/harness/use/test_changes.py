"""Constructed scenes whose changes are known: a box, a patch of another colour, another light."""

from dataclasses import replace

import numpy as np
import pytest

from chronoscene.cli.runs.changes import _panel, parse_pair
from chronoscene.errors import ConfigError
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.changes import (
    CLASSES,
    GEOMETRY,
    ChangeMap,
    back_project,
    map_changes,
    unexplained,
)
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


def test_a_label_of_two_periods_names_neither():
    with pytest.raises(ConfigError, match="--between May 1: expected labels of one period each"):
        parse_pair(["May", "May"], ("May", "1"))
    assert parse_pair(["May", "May", "June"], ("June", "1")) == (1, 2)


def test_titles_of_maps_are_no_wider_than_these():
    made = ChangeMap((0, 1), np.zeros((1, 3)), *np.zeros((2, 1), bool), *np.zeros((2, 1)))
    known = {"0": "before the works", "1": "after the works"}
    assert _panel(made, known).title == "before the works \N{RIGHTWARDS ARROW} after the works"
    known = {"0": "warm evening 2017", "1": "cool autumn morning 2018"}
    assert _panel(made, known).title == " \N{RIGHTWARDS ARROW} ".join(known.values())
    survey = "survey of the year {} by helicopter"
    title = _panel(made, {"0": survey.format(1970), "1": survey.format(1971)}).title
    assert title == "0: survey of the... \N{RIGHTWARDS ARROW} 1: survey of the..."
