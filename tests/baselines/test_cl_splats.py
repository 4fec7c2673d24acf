"""CL-Splats: what it finds changed, what it optimises then, and that all else stays as it was."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from toy_scene import ring_of_views, toy_scene

from baselines.cl_splats import SPEC
from baselines.cl_splats.changes import change_mask, change_scores, changed_pixels
from baselines.cl_splats.config import CLSplatsConfig
from baselines.cl_splats.lifting import Comparison, enclose, new_points, vote
from baselines.cl_splats.method import CLSplats
from baselines.cl_splats.model import LIVES, STRAYS
from baselines.cl_splats.trainer import CLSplatsTrainer, by_period
from chronoscene.errors import ConfigError
from chronoscene.gaussians.model import SHAPES
from chronoscene.methods import TrainingSet, build_config
from chronoscene.rasterizer import NEAR_PLANE
from chronoscene.scene.geometry import camera_centre
from chronoscene.training.checkpoint import load_tensors
from chronoscene.training.drawing import Splats, draw

STEPS = 100


def config(**changes: Any) -> CLSplatsConfig:
    made = {"iterations": STEPS, "densify_interval": 20, "max_gaussians": 150}
    made |= {"dilation": 0.0, "exposure": "none", **changes}
    found: CLSplatsConfig = build_config(SPEC, preset="fast", overrides=made)
    return found


def stage(period: int) -> TrainingSet:
    """The photos of the toy scene as those of a period."""
    scene = toy_scene()
    views = tuple(replace(view, period=period) for view in scene.views)
    seen = np.ones((60, period + 1), bool)
    return replace(scene, views=views, num_periods=period + 1, point_periods=seen)


def second(method: CLSplats, change: str = "repainted") -> TrainingSet:
    """Period 1: the model of period 0, in which something has become of one side."""
    there = deepcopy(method.model)
    p = {name: tensor.detach() for name, tensor in there.parameters.items()}
    if change == "repainted":
        p["sh_dc"] = torch.where(side(p)[:, None], -p["sh_dc"].flip(1), p["sh_dc"])
    elif change == "removed":
        p["logit_opacities"] = torch.where(side(p), -9.0, p["logit_opacities"])
    elif change == "moved":
        p["means"] = p["means"] + side(p)[:, None] * torch.tensor([0.0, 0.0, 0.25])
    there.parameters = p
    splats = [there.splats(view, 0.0) for view in stage(0).views]
    images = [
        draw(splat, view, torch.zeros(3), near_plane=NEAR_PLANE).image[0].detach()
        for splat, view in zip(splats, stage(0).views, strict=True)
    ]
    photos = [as_photo(image.numpy()) for image in images]
    return replace(stage(1), load_image=photos.__getitem__)


def side(parameters: dict[str, torch.Tensor]) -> torch.Tensor:
    return parameters["means"][:, 0] > 0.1


def run(method: CLSplats, steps: range = range(STEPS)) -> None:
    for index in steps:
        method.step(index, index / STEPS)


def begun(**changes: Any) -> CLSplats:
    """A method at the end of period 0."""
    method = CLSplats(config(**changes))
    method.setup(stage(0), seed=0, device="cpu")
    run(method)
    return method


def trainer_of(method: CLSplats) -> CLSplatsTrainer:
    assert method.trainer is not None
    return method.trainer


# Change detection


def picture() -> np.ndarray:
    """Soft coloured spots, 0.2..0.8. [120, 160, 3]"""
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(120, 160, 3)), (4, 4, 0))
    return np.asarray(0.5 + 0.3 * noise / np.abs(noise).max())


def as_photo(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)


def test_a_planted_change_is_found_and_nothing_else() -> None:
    image, options = picture(), config()
    changed = np.zeros((120, 160), bool)
    changed[40:70, 60:100] = True
    photo = as_photo(np.where(changed[..., None], image[..., ::-1] * [0.3, 1.0, 1.2], image))
    for exposed in (photo, as_photo(photo / 255 * [0.8, 0.7, 0.6] + 0.02)):
        mask = change_mask(change_scores(image, exposed, None), options)
        assert mask[changed].mean() > 0.95
        assert mask[~changed].mean() < 0.06, "but for the dilation"


@pytest.mark.parametrize("gain", [1.0, 0.6, 1.2])
def test_an_equal_image_has_not_changed_nor_has_its_exposure(gain: float) -> None:
    image, options = picture(), config()
    scores = change_scores(image, as_photo(image * gain + 0.01), None)
    assert scores.max() < 0.1
    assert not change_mask(scores, options).any()


def test_ignored_pixels_neither_change_nor_matter() -> None:
    image = picture()
    counts = np.ones((120, 160), bool)
    counts[20:90, 20:90] = False
    noise = np.random.default_rng(1).integers(0, 256, (120, 160, 3), np.uint8)
    photo = np.where(counts[..., None], as_photo(image), noise)
    scores = change_scores(image, photo, counts)
    assert scores.max() < 0.1
    assert not change_scores(image, noise, np.zeros_like(counts)).any()


def test_masks_have_no_small_spots_and_no_small_holes() -> None:
    scores = np.zeros((400, 400))
    scores[120:240, 120:240] = 1.0
    scores[176:178, 176:178] = 0.0
    clean = scores >= 0.5
    clean[176:178, 176:178] = True
    scores[320:328, 320:328] = 1.0
    mask = change_mask(scores, config(dilation=0.0))
    assert not mask[280:].any() and mask[176:178, 176:178].all()
    assert (mask & clean).sum() > 0.95 * clean.sum() and not mask[~clean].any()


@pytest.mark.parametrize("ignored", [False, True])
def test_wide_photos_are_compared_small(ignored: bool) -> None:
    """Each pixel of the small images becomes 5 x 5: the mask is theirs, and follows the edges."""
    image, options = picture(), config()
    photo = as_photo(image)
    photo[40:70, 60:100] = as_photo(image[40:70, 60:100, ::-1] * [0.3, 1.0, 1.2])
    counts = np.ones(photo.shape[:2], bool)
    counts[:, :20] = not ignored
    wide = [np.kron(x, np.ones((5, 5, 1))) for x in (image, photo)]
    mask = changed_pixels(
        wide[0], wide[1].astype(np.uint8), np.kron(counts, np.ones((5, 5))) > 0, options
    )
    assert mask.shape == (600, 800)
    own = change_mask(change_scores(image, photo, counts), options)
    assert (mask == np.kron(own, np.ones((5, 5)))).mean() > 0.99
    assert mask[205:345, 305:495].all()


# Lifting


def two_gaussians() -> Splats:
    """One on each side of the origin, along the axis of the ring of cameras."""
    return Splats(
        means=torch.tensor([[0.0, 0.0, 0.25], [0.0, 0.0, -0.25]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.05),
        opacities=torch.full((2,), 0.9),
        colors=torch.zeros(2, 3),
    )


def comparisons(upper: int, lower: int) -> list[Comparison]:
    """Four views; the upper half has changed in some, the lower half in others."""
    found = []
    for i, view in enumerate(ring_of_views(4)):
        changed = np.zeros((view.height, view.width), bool)
        changed[: view.height // 2] = i < upper
        changed[view.height // 2 :] = i < lower
        photo = np.zeros((view.height, view.width, 3), np.uint8)
        depth = np.full(changed.shape, np.inf)
        found.append(Comparison(view, photo, np.ones_like(changed), changed, depth))
    return found


@pytest.mark.parametrize(("upper", "lower"), [(3, 1), (1, 3), (2, 4), (0, 0)])
def test_gaussians_have_changed_if_they_have_in_most_of_the_views(upper: int, lower: int) -> None:
    assert vote(two_gaussians(), comparisons(upper, lower), config()).tolist() == [
        upper > 2, lower > 2
    ]  # fmt: skip


def test_views_that_do_not_see_a_gaussian_have_no_vote() -> None:
    splats, found = two_gaussians(), comparisons(3, 0)
    assert vote(splats, found, config()).tolist() == [True, False]
    # Ignored in two of the three views, it is seen there no more.
    nowhere = np.zeros_like(found[0].counts)
    hidden = [replace(item, counts=nowhere, changed=nowhere) for item in found[:2]]
    assert vote(splats, [*hidden, *found[2:]], config()).tolist() == [False, False]
    # Behind a wall, which has changed, a Gaussian has not.
    wall = Splats(
        *(torch.cat([rows, rows[:1]]) for rows in splats[:2]),
        torch.cat([splats.scales, torch.full((1, 3), 2.0)]),
        torch.cat([splats.opacities, torch.ones(1)]),
        torch.zeros(3, 3),
    )
    wall.means[2] = 0.5 * torch.from_numpy(camera_centre(found[0].view.cam_from_world))
    in_front = [replace(item, changed=item.counts) for item in found[:1]]
    assert vote(wall, in_front, config()).tolist() == [False, False, True]


def test_new_gaussians_start_where_views_agree_on_a_change() -> None:
    """A ball that appears in the middle: its silhouettes, and sparse points in it and elsewhere."""
    found = []
    for view in ring_of_views(8):
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        K = view.K
        near = np.hypot((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]) < 0.1
        photo = np.repeat(np.where(near, 200, 0)[..., None], 3, 2).astype(np.uint8)
        depth = np.full(near.shape, 1.3)
        found.append(Comparison(view, photo, np.ones_like(near), near, depth))
    train = replace(
        stage(1),
        points=np.array([[0, 0, 0], [0.01, 0, 0], [0, 0, 0.3]], np.float32),
        colors=np.full((3, 3), 7, np.uint8),
        point_periods=np.array([[True, True], [False, True], [False, True]]),
    )
    far = two_gaussians()
    generator = np.random.default_rng(0)
    points, colors = new_points(far, found, train, config(samples=0), generator)
    np.testing.assert_allclose(points, [[0.01, 0, 0]], atol=1e-7)
    points, colors = new_points(far, found, train, config(samples=2_000), generator)
    assert len(points) > 20
    assert np.linalg.norm(points[1:], axis=1).max() < 0.2
    assert (colors[1:] == 200).all()


def test_spheres_enclose_clusters() -> None:
    generator = np.random.default_rng(0)
    clusters = [generator.uniform(-0.1, 0.1, (200, 3)) + np.eye(3)[0] * x for x in (-1.0, 1.0)]
    spheres = enclose(np.concatenate(clusters), config(sphere_share=1.0), 1.0)
    assert len(spheres) == 2
    for sphere, points in zip(spheres[spheres[:, 0].argsort()], clusters, strict=True):
        distances = np.linalg.norm(points - sphere[:3], axis=1)
        assert sphere[3] == pytest.approx(distances.max() + 0.02)
    assert enclose(np.zeros((0, 3)), config(), 1.0).shape == (0, 4)
    assert enclose(np.zeros((1, 3)), config(), 1.0).tolist() == [[0.0, 0.0, 0.0, 0.02]]


# Training


def test_only_what_changed_is_optimised_and_earlier_periods_stay_to_the_bit() -> None:
    method = begun()
    before = {name: tensor.clone() for name, tensor in method.stored_tensors().items()}
    first = [method.render(view, 0.0).rgb for view in stage(0).views]
    count, train = len(before["means"]), second(method)
    method.extend(train)
    ended = method.model.kept[LIVES][:, 1] == 1
    assert 0 < ended.sum() < count
    run(method)
    after = method.stored_tensors()
    assert len(after["means"]) > count
    for name in SHAPES:
        assert torch.equal(after[name][:count], before[name]), name
    assert (after[LIVES][:count, 0] == 0).all() and (after[LIVES][count:, 0] == 1).all()
    again = [method.render(view, 0.0).rgb for view in stage(0).views]
    np.testing.assert_array_equal(again, first)
    photos = [train.load_image(i) / 255 for i in range(len(train.views))]
    old, new = (
        np.mean((np.stack([method.render(v, p).rgb for v in train.views]) - photos) ** 2)
        for p in (0.0, 1.0)
    )
    assert new < 0.8 * old


def test_what_is_repainted_removed_or_moved_is_optimised() -> None:
    method = begun()
    painted = side(method.stored_tensors())
    for change in ("repainted", "removed", "moved"):
        found = deepcopy(method)
        found.extend(second(method, change))
        ended = found.model.kept[LIVES][:, 1] == 1
        hits = float((ended & painted).sum())
        assert hits > 0.6 * painted.sum(), change
        assert hits > 0.6 * ended.sum(), change


def test_gradients_reach_what_changed_and_nothing_else() -> None:
    method = begun()
    method.extend(second(method))
    model, statistics = method.model, trainer_of(method).statistics
    seen = {name: tensor.clone() for name, tensor in model.kept.items()}
    method.step(0, 0.0)
    for name in SHAPES:
        assert model.parameters[name].grad is not None
        assert not model.kept[name].requires_grad
        assert torch.equal(model.kept[name], seen[name])
    assert len(statistics.sums) == len(model)
    assert (statistics.sums > 0).any()


def test_where_nothing_changes_nothing_is_trained() -> None:
    method = begun()
    before = {name: tensor.clone() for name, tensor in method.stored_tensors().items()}
    method.extend(second(method, "nothing"))
    run(method)
    assert len(method.model) == 0
    for name, tensor in method.stored_tensors().items():
        assert torch.equal(tensor, before[name]), name


def test_of_another_period_a_view_takes_the_exposure_alone() -> None:
    """Other Gaussians live there, so that their colours are of no use."""
    method = begun(exposure="period")
    method.extend(second(method))
    run(method)
    view = stage(0).views[0]
    plain, split = (
        method.render_split(view, geometry_period=0.0, appearance_period=period)
        for period in (0.0, 1.0)
    )
    np.testing.assert_array_equal(split.alpha, plain.alpha)
    np.testing.assert_array_equal(split.depth, plain.depth)
    assert not np.array_equal(split.rgb, plain.rgb)


@pytest.mark.parametrize("missing", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_period_without_photos_shows_the_nearest_before_it_or_the_first(missing: int) -> None:
    """A whole period may be held out: `chronoscene split --strategy periods`."""
    data, known = stage(2), [period for period in range(3) if period != missing]
    views = tuple(replace(view, period=known[i % 2]) for i, view in enumerate(data.views))
    method = CLSplats(config())
    method.setup(replace(data, views=views), seed=0, device="cpu")
    for steps in (range(0), range(40), range(40, STEPS)):  # the second stage is in the last ones
        run(method, steps)
        image, other = (method.render(views[0], float(period)) for period in (missing, known[0]))
        assert image.alpha is not None and image.alpha.max() > 0.1
        np.testing.assert_array_equal(image.rgb, other.rgb)


def test_what_lives_at_a_period_is_drawn_then_and_exported(tmp_path: Path) -> None:
    method = begun()
    method.extend(second(method))
    run(method)
    method.save(tmp_path)
    loaded = CLSplats(config())
    loaded.load(tmp_path, device="cpu")
    views = stage(0).views
    lives = load_tensors(tmp_path)[0][LIVES]
    for period in (0, 1):
        there = (lives[:, 0] <= period) & ((lives[:, 1] == 0) | (period < lives[:, 1]))
        cloud = loaded.to_gaussians(period, views)
        assert len(cloud.means) == int(there.sum()) < len(lives)
        image = method.render(views[0], period).rgb
        np.testing.assert_array_equal(loaded.render(views[0], period).rgb, image)
    order = np.random.default_rng(0).permutation(len(lives))
    loaded.permute(order)
    assert torch.equal(loaded.stored_tensors()[LIVES], lives[order])


def test_strays_are_pruned_unless_they_come_back() -> None:
    method = begun(stray_checks=3)
    method.extend(second(method))
    trainer, means = trainer_of(method), method.model.parameters["means"]
    count, place = len(means), means[0].clone()
    away = torch.tensor([3.0, 0.0, 0.0])

    def check(first: torch.Tensor) -> float:
        with torch.no_grad():
            method.model.parameters["means"][0] = first
        trainer._prune_strays()
        return float(method.model.parameters[STRAYS][0].detach())

    assert [check(x) for x in (away, away, place, away, away)] == [1.0, 2.0, 0.0, 1.0, 2.0]
    assert len(method.model) == count
    check(away)
    assert len(method.model) == count - 1 == len(trainer.statistics.sums)
    method.step(0, 0.0)


def test_a_training_goes_on_to_the_bit_within_a_period(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("training", "a", "b")]
    for folder in folders:
        folder.mkdir()
    method = begun(stray_interval=10)
    method.extend(second(method))
    run(method, range(45))
    method.save_training(folders[0])
    run(method, range(45, STEPS))
    method.save(folders[1])
    again = begun(stray_interval=10)
    again.extend(second(again))
    again.load_training(folders[0])
    run(again, range(45, STEPS))
    again.save(folders[2])
    assert (folders[1] / "model.json").read_bytes() == (folders[2] / "model.json").read_bytes()


def test_opacities_are_reset_in_the_first_period_alone() -> None:
    method = begun(reset_interval=5_000)
    largest = []
    method.extend(second(method))
    for index in range(40):
        method.step(index, index / STEPS)
        largest.append(float(method.model.parameters["logit_opacities"].detach().max()))
    assert min(largest) > -2
    first = CLSplats(config(reset_interval=5_000))
    first.setup(stage(0), seed=0, device="cpu")
    run(first, range(18))
    assert float(first.model.parameters["logit_opacities"].detach().max()) < -2


def test_one_training_takes_the_periods_in_order() -> None:
    """Under ``joint``, with as many passes over the views of each as of the others."""
    stages = [stage(0), second(begun())]
    images = [part.load_image(i) for part in stages for i in range(10)]
    later = [replace(view, period=2) for view in stages[1].views[5:]]
    seen = np.ones((60, 3), bool)
    seen[:20, 0] = False
    joint = replace(
        stages[1],
        views=(*stages[0].views, *stages[1].views[:5], *later),
        num_periods=3,
        point_periods=seen,
        load_image=images.__getitem__,
    )
    parts = by_period(joint)
    assert [{v.period for v in part.views} for part in parts] == [{0}, {1}, {2}]
    np.testing.assert_array_equal(parts[1].load_image(3), images[13])
    np.testing.assert_array_equal(parts[2].load_image(3), images[18])
    method = CLSplats(config())
    method.setup(joint, seed=0, device="cpu")
    assert len(method.model) == 40
    for number, steps in enumerate((range(40), range(40, 60), range(60, 80))):
        for done, index in enumerate(steps):
            method.step(index, index / 80)
            trainer = trainer_of(method)
            assert method.model.period == trainer.stage == number
            # The schedule of each period begins anew, and ends with it.
            moment = round(done / len(steps) * method.config.schedule_length) + 1
            assert trainer.timeline.last_moment == moment


def test_periods_whose_photos_are_listed_in_another_order_give_the_same_model() -> None:
    """Views are listed by their names, which need not follow the dates."""
    stages = [stage(0), second(begun())]
    images = [part.load_image(i) for part in stages for i in range(10)]
    seen = np.ones((60, 2), bool)
    seen[:20, 0] = False
    views = tuple(view for part in stages for view in part.views)
    joint = replace(stages[1], views=views, point_periods=seen, load_image=images.__getitem__)
    models = []
    for given in (joint, joint.with_views([*range(10, 20), *range(10)])):
        method = CLSplats(config())
        method.setup(given, seed=0, device="cpu")
        for index in range(80):
            method.step(index, index / 80)
        models.append(method.stored_tensors())
    first, other = models
    assert first[LIVES][:, 0].unique().tolist() == [0, 1]
    assert first.keys() == other.keys()
    assert all(torch.equal(first[name], other[name]) for name in first)


def test_moments_are_steps_of_the_period_where_schedules_are_not_stretched(tmp_path: Path) -> None:
    """A training that goes on from a checkpoint within the second period has them, too."""
    views = tuple(view for period in (0, 1) for view in stage(period).views)
    images = [stage(0).load_image(i) for i in range(10)] * 2
    joint = replace(
        stage(1), views=views, point_periods=np.ones((60, 2), bool), load_image=images.__getitem__
    )
    moments: list[int] = []

    def made() -> CLSplats:
        method = CLSplats(config(stretch=False))
        method.setup(joint, seed=0, device="cpu")
        return method

    def steps(method: CLSplats, indices: range) -> None:
        for index in indices:
            method.step(index, index / 20)
            moments.append(trainer_of(method).timeline.last_moment)

    first, second = made(), made()
    steps(first, range(14))
    first.save_training(tmp_path)
    second.load_training(tmp_path)
    steps(second, range(14, 20))
    assert moments == [*range(1, 11), *range(1, 11)]


@pytest.mark.parametrize("name", ["vote_share", "sphere_share"])
def test_shares_are_no_percentages(name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: expected a value less than or equal to 1"):
        CLSplatsConfig(**{name: 95.0})


def test_random_moves_are_refused() -> None:
    with pytest.raises(ConfigError, match="densification"):
        config(densification="mcmc")
