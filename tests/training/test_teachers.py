"""Models that teach: when each learns, and what they show."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.bench.contract import tiny_training
from chronoscene.methods import Prediction, build_config, import_object, load_spec
from chronoscene.scene.geometry import camera_centre
from chronoscene.training import teachers
from chronoscene.training.teachers import Lessons, mean_image, pose_between, views_between

STEPS = 24


@dataclass
class Plain:
    """Shows one colour, and keeps nothing."""

    value: float = 0.0

    def render(self, view, period):
        return Prediction(np.full((view.height, view.width, 3), self.value, np.float32))

    def save(self, folder):
        (folder / "model").write_text(str(self.value))

    def load(self, folder, *, device):
        self.value = float((folder / "model").read_text())


def lessons(count=2, seed=0):
    return Lessons(count, seed, tiny_training.make_training_set(2), "cpu")


def own_times(made, steps):
    """Of all steps of a training of that length, with the number of teachers trained by then."""
    found = []
    for index in range(steps):
        while made.is_over(index / steps):
            made.end(Plain(), index)
        found.append((len(made.taught), *made.own_time(index, index / steps)))
    return found


def test_teachers_take_equal_shares_of_the_first_half_and_each_model_all_of_a_schedule():
    found = own_times(lessons(), STEPS)
    for number, (first, length) in enumerate([(0, 6), (6, 6), (12, 12)]):
        part = found[first : first + length]
        assert [(n, index) for n, index, _ in part] == [(number, i) for i in range(length)]
        np.testing.assert_allclose([p for *_, p in part], np.arange(length) / length, atol=1e-12)


def test_a_longer_training_goes_on_with_the_model_that_stays():
    made = lessons()
    own_times(made, STEPS)
    # 12 of 24 steps were its own, of 48 it has 36.
    assert made.own_time(24, 24 / 48) == (12, pytest.approx(12 / 36))


def test_models_have_seeds_of_their_own_and_the_last_one_that_of_the_training():
    made, seeds = lessons(seed=3), []
    for _ in range(3):
        seeds.append(made.own_seed())
        made.end(Plain(), 0)
    assert len(set(seeds)) == 3 and seeds[-1] == 3
    assert lessons(seed=4).own_seed() not in seeds


@given(share=st.floats(0.0, 1.0))
def test_a_pose_between_two_has_its_centre_on_the_line_and_turns_evenly(share):
    first, second = (view.cam_from_world for view in tiny_training.make_training_set(1).views[:2])
    pose = pose_between(first, second, share)
    centre = (1 - share) * camera_centre(first) + share * camera_centre(second)
    np.testing.assert_allclose(camera_centre(pose), centre, atol=1e-12)

    def angle(a, b):
        cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1) / 2
        return np.arccos(np.clip(cosine, -1, 1))

    np.testing.assert_allclose(angle(first, pose), share * angle(first, second), atol=1e-6)


def test_views_lie_between_photos_of_one_period_and_show_all_periods():
    train = tiny_training.make_training_set(2)
    views = views_between(train, np.random.default_rng(0))
    assert len(views) == teachers.VIEWS_PER_PHOTO * len(train.views)
    assert {view.period for view in views} == {0, 1}
    centres = camera_centre(np.stack([view.cam_from_world for view in train.views]))
    periods = np.array([view.period for view in train.views])
    for view in views:
        centre, distances = camera_centre(view.cam_from_world), []
        for period in (0, 1):
            a = centres[periods == period]
            ways = a[None] - a[:, None]
            squares = np.square(ways).sum(-1).clip(1e-12)
            shares = ((centre - a[:, None]) * ways).sum(-1) / squares
            nearest = a[:, None] + shares.clip(0, 1)[..., None] * ways
            distances.append(np.linalg.norm(centre - nearest, axis=-1).min())
        assert min(distances) < 1e-6


def test_large_photos_leave_room_for_fewer_views(monkeypatch):
    train = tiny_training.make_training_set(2)
    monkeypatch.setattr(teachers, "MEMORY", 5 * tiny_training.WIDTH * tiny_training.HEIGHT * 3 + 1)
    assert len(views_between(train, np.random.default_rng(0))) == 5


def test_what_teachers_show_is_their_mean_beside_the_photos():
    made = lessons()
    for value in (0.2, 0.6):
        made.end(Plain(value), 0)
    train, photos = made.training_set(Plain), made.train
    count = len(photos.views)
    assert train.views[:count] == photos.views
    np.testing.assert_array_equal(train.load_image(0), photos.load_image(0))
    np.testing.assert_array_equal(train.load_image(count), np.full_like(train.load_image(0), 102))
    assert train.load_mask(count) is None
    assert mean_image([Plain(2.0)], train.views[0]).max() == 255


def test_a_training_that_stopped_while_a_teacher_learned_ends_the_same(tmp_path):
    spec = load_spec("chronogs")
    data = tiny_training.make_training_set(2)

    def start():
        options = {"iterations": STEPS, "teachers": 2}
        method = import_object(spec.method)(build_config(spec, preset="fast", overrides=options))
        method.setup(data, seed=0, device="cpu")
        return method

    whole, first = start(), start()
    reports = [whole.step(i, i / STEPS) for i in range(STEPS)]
    for i in range(8):
        first.step(i, i / STEPS)
    first.save_training(tmp_path)
    again = start()
    again.load_training(tmp_path)
    assert [again.step(i, i / STEPS) for i in range(8, STEPS)] == reports[8:]


def test_the_views_ahead_are_photos_alone():
    asked, made = [], lessons()
    made.train = replace(made.train, expect=asked.append)
    made.end(Plain(), 0)
    made.end(Plain(), 0)
    train = made.training_set(Plain)
    train.expect([0, len(made.train.views), 1])
    assert asked == [[0, 1]]
