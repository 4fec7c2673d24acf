"""Models that contradict what their photos state."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.registration.generated import CAMERA, CaseSettings, generate_case
from chronoscene.registration.photos.stated import Stated
from chronoscene.registration.quality.position import Position, judge_position
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import fit

FOCAL = 400.0


@pytest.fixture(scope="module")
def model() -> Registered:
    settings = CaseSettings(seed=9, points=600, views=8, gps_gross=0, gps_bias=0, gps_noise=0.5)
    return generate_case(settings).model


def judged(model: Registered, **values: float | None) -> Position:
    """Verdict on a model all of whose photos state the same."""
    said = Stated(focal_error=0.03, **values)  # type: ignore[arg-type]
    return judge_position(replace(model, stated=dict.fromkeys(model.names, said)))


def headings(model: Registered, turn: float) -> dict[str, Stated]:
    east, north = model.cam_from_world[:, 2, :2].T
    found = np.degrees(np.arctan2(east, north)) + turn
    return {n: Stated(heading=float(a) % 360) for n, a in zip(model.names, found, strict=True)}


def kinds(position: Position) -> list[str]:
    return [f"{o.check} {o.place}" for o in position.objections if o.check == "metadata"]


def test_a_model_that_agrees_is_shown_beside_its_metadata(model: Registered) -> None:
    assert CAMERA.K[0, 0] == FOCAL
    position = judged(model, focal=FOCAL * 1.04)
    assert kinds(position) == []
    (compared,) = position.metadata
    assert (compared.found, compared.stated) == (pytest.approx(400.0), pytest.approx(416.0))
    assert compared.photos == len(model.names)


def test_a_focal_length_that_is_wrong_by_a_quarter_is_said_first(model: Registered) -> None:
    position = judged(model, focal=FOCAL / 0.75)
    assert position.level == "doubtful"
    assert "contradicts what its photos state" in position.text
    assert "400.0 px, while 16 photos state 533.3 px" in position.text
    assert any("oblique photos" in todo for todo in position.todo)


def test_it_is_said_without_gps_too(model: Registered) -> None:
    bare = replace(model, georeference=None, gps_used=np.zeros(len(model.names), bool))
    assert judge_position(bare).level == "not checked"
    assert judged(bare, focal=FOCAL / 0.75).level == "doubtful"


def test_height_above_ground(model: Registered) -> None:
    centres = camera_centre(model.cam_from_world)
    height = float(np.median(centres[:, 2]))
    assert kinds(judged(model, height=height)) == []
    far = judged(model, height=1.8 * height)
    assert kinds(far) == ["metadata height above ground of the model"]


def test_heading(model: Registered) -> None:
    for turn, wrong in ((0.0, False), (9.0, False), (-40.0, True), (170.0, True)):
        position = judge_position(replace(model, stated=headings(model, turn)))
        assert bool(kinds(position)) == wrong, turn


def test_scale_has_an_accuracy_of_its_own(model: Registered) -> None:
    good = judge_position(model)
    assert good.scale_error is not None and good.scale_error < 0.01
    assert "scale" not in [o.check for o in good.objections]
    rng = np.random.default_rng(0)
    noisy = replace(model, gps_enu=model.gps_enu + rng.normal(0, 8, model.gps_enu.shape))
    worse = judge_position(noisy)
    assert worse.scale_error is not None and worse.scale_error > 0.02
    assert "scale" in [o.check for o in worse.objections]


@pytest.mark.parametrize("count", [6, 40])
def test_the_accuracy_of_the_scale_against_monte_carlo(model: Registered, count: int) -> None:
    rng = np.random.default_rng(3)
    places = rng.uniform(-30, 30, (count, 3)) * [1, 1, 0.05]
    poses = np.tile(np.eye(4), (count, 1, 1))
    names, cameras = tuple(f"{i}.jpg" for i in range(count)), model.cameras[:1] * count
    bare = replace(model, names=names, cameras=cameras, gps_used=np.ones(count, bool))
    scales, stated = [], []
    for _ in range(400):
        gps = places + rng.normal(0, 1, places.shape)
        found = fit(places, gps)
        assert found is not None
        move = found.to_sim3()
        poses[:, :3, 3] = -move.apply(places)
        scales.append(move.scale)
        position = judge_position(replace(bare, cam_from_world=poses, gps_enu=gps))
        stated.append(position.scale_error)
    assert np.mean(stated) == pytest.approx(np.std(scales), rel=0.12)
