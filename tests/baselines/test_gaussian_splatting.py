"""3DGS: schedule, bookkeeping of rows, and what it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from baselines.gaussian_splatting import SPEC
from baselines.gaussian_splatting.config import GaussianSplattingConfig
from baselines.gaussian_splatting.density import choose_growth, densify, reset_opacities
from baselines.gaussian_splatting.gaussians import (
    SHAPES,
    initialise,
    logit,
    mean_squared_spacing,
    opacities_of,
    scales_of,
)
from baselines.gaussian_splatting.method import GaussianSplatting
from baselines.gaussian_splatting.timeline import Timeline
from chronoscene.errors import CheckpointError, ConfigError, SceneError
from chronoscene.kernels.threads import set_threads
from chronoscene.methods import TrainingSet, TrainingView, build_config, import_object
from chronoscene.rasterizer import rasterize
from chronoscene.scene.geometry import Sim3
from chronoscene.training.camera_tensors import camera_tensors

WIDTH, HEIGHT = 48, 36
EXTENT = 1.1


@pytest.fixture(autouse=True)
def one_thread():
    """Scenes this small are quicker on one thread, most of all beside other work."""
    set_threads(1)
    yield
    set_threads()


# A scene whose answer is known: rendered Gaussians, seen from a ring of cameras.


def ring_of_views(count, *, periods=1):
    """Cameras at distance 1 from the origin that look at it; every one once per period."""
    views = []
    for period in range(periods):
        for i in range(count):
            angle = 2 * np.pi * i / count
            centre = np.array([np.cos(angle), np.sin(angle), 0.3 * np.sin(3 * angle)])
            centre /= np.linalg.norm(centre)
            forward = -centre
            right = np.cross(forward, [0, 0, 1.0])
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(forward, right), forward])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
            K = np.array([[50.0, 0, 25.5], [0, 52.0, 17.0], [0, 0, 1]])
            views.append(
                TrainingView(
                    K=K,
                    width=WIDTH,
                    height=HEIGHT,
                    cam_from_world=pose,
                    name=f"{period}/{i}.png",
                    period=period,
                )
            )
    return tuple(views)


def solid_gaussians(count, seed):
    generator = np.random.default_rng(seed)
    means = generator.uniform(-0.3, 0.3, (count, 3)).astype(np.float32)
    colors = generator.uniform(0.1, 0.9, (count, 3)).astype(np.float32)
    return torch.from_numpy(means), torch.from_numpy(colors)


def draw(means, colors, view):
    viewmats, Ks = camera_tensors(view)
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    raster = rasterize(
        means, quats, torch.full((count, 3), 0.06), torch.full((count,), 0.9), colors,
        viewmats, Ks, view.width, view.height,
    )  # fmt: skip
    return raster.image[0].clamp(0, 1)


def toy_scene(count=60, views=10, *, colors_per_period=1):
    """A training set whose points are the true centres, with noise; colours per period."""
    means, _ = solid_gaussians(count, 0)
    palettes = [solid_gaussians(count, 1 + period)[1] for period in range(colors_per_period)]
    cameras = ring_of_views(views, periods=colors_per_period)
    images = [(draw(means, palettes[v.period], v) * 255).round().byte().numpy() for v in cameras]
    noise = np.random.default_rng(5).normal(size=(count, 3)) * 0.01
    return TrainingSet(
        views=cameras,
        num_periods=1,
        points=(means.numpy() + noise).astype(np.float32),
        colors=(palettes[0].numpy() * 255).astype(np.uint8),
        point_periods=np.ones((count, 1), bool),
        training_from_world=Sim3.identity(),
        camera_extent=EXTENT,
        background=np.zeros(3, np.float32),
        load_image=images.__getitem__,
    )


def train(scene, config, *, seed=0):
    method = GaussianSplatting(config)
    method.setup(scene, seed=seed, device="cpu")
    for i in range(config.iterations):
        method.step(i, i / config.iterations)
    return method


def mean_squared_error(method, scene):
    errors = [
        np.mean((method.render(view, view.period).rgb - scene.load_image(i) / 255.0) ** 2)
        for i, view in enumerate(scene.views)
    ]
    return float(np.mean(errors))


SHORT = GaussianSplattingConfig(
    iterations=250, stretch=True, reset_interval=30_000, densify_interval=25, max_gaussians=300
)


# Schedule


def test_the_published_schedule():
    timeline = Timeline(GaussianSplattingConfig())
    due = [timeline.at(i, i / 30_000) for i in range(30_000)]
    assert [d.moment for d in due] == list(range(1, 30_001))
    assert [d.moment for d in due if d.densify] == list(range(600, 15_000, 100))
    assert [d.moment for d in due if d.reset] == [3_000, 6_000, 9_000, 12_000]
    assert [d.moment for d in due if d.collect] == list(range(1, 15_000))
    assert next(d.moment for d in due if d.prune_large) == 3_001
    degrees = [d.sh_degree for d in due]
    assert [degrees.index(k) + 1 for k in range(4)] == [1, 1_000, 2_000, 3_000]
    assert due[14_999].position_lr == pytest.approx(1.6e-5, rel=1e-3)
    assert due[29_999].position_lr == 1.6e-6


def test_longer_training_is_not_stretched_unless_asked():
    plain = Timeline(GaussianSplattingConfig(iterations=40_000))
    late = plain.at(30_000, 0.75)
    assert late.moment == 30_001 and late.position_lr == 1.6e-6 and not late.collect
    stretched = Timeline(GaussianSplattingConfig(iterations=40_000, stretch=True))
    assert stretched.at(30_000, 0.75).moment == 22_501


def test_a_squeezed_schedule_passes_the_same_phases():
    config = GaussianSplattingConfig(iterations=3_000, stretch=True, reset_interval=7_500)
    timeline = Timeline(config)
    due = [timeline.at(i, i / 3_000) for i in range(3_000)]
    assert [i for i, d in enumerate(due) if d.reset] == [750]
    assert [i + 1 for i, d in enumerate(due) if d.densify] == list(range(100, 1_501, 100))
    assert due[-1].sh_degree == 3 and due[50].sh_degree == 0 and due[100].sh_degree == 1


def test_a_run_that_ends_by_the_clock_follows_progress():
    # Ten times faster than its iterations would say: 300 steps go through everything.
    timeline = Timeline(GaussianSplattingConfig(iterations=3_000, stretch=True))
    due = [timeline.at(i, i / 300) for i in range(300)]
    assert sum(d.reset for d in due) == 4
    assert due[-1].sh_degree == 3 and not due[-1].collect


# Initialisation


def test_start_as_published():
    scene = toy_scene(views=1)
    start = initialise(scene, opacity=0.1)
    assert {name: tuple(rows.shape[1:]) for name, rows in start.items()} == SHAPES
    distances = np.linalg.norm(scene.points[:, None] - scene.points[None], axis=-1)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    expected = np.sqrt((nearest.astype(np.float64) ** 2).mean(1))
    np.testing.assert_allclose(
        scales_of(start["log_scales"]).numpy(), np.repeat(expected[:, None], 3, 1), rtol=1e-5
    )
    np.testing.assert_allclose(opacities_of(start["logit_opacities"]).numpy(), 0.1, rtol=1e-6)
    assert (start["quats"] == torch.tensor([1.0, 0, 0, 0])).all()
    assert not start["sh_rest"].any()


def test_twins_and_lone_points_start_with_a_size():
    assert mean_squared_spacing(np.zeros((1, 3), np.float32)).tolist() == [0.0]
    scene = toy_scene(views=1)
    for points in (np.zeros((1, 3)), np.zeros((5, 3)), np.array([[0, 0, 0], [3.0, 4, 0]])):
        few = replace(
            scene, points=points.astype(np.float32), colors=np.zeros((len(points), 3), np.uint8)
        )
        scales = scales_of(initialise(few, opacity=0.1)["log_scales"])
        assert torch.isfinite(scales).all() and (scales > 3e-4).all()
    assert scales[0, 0] == pytest.approx(5.0)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((60, 3), np.nan)])
def test_no_points_is_an_error(points):
    scene = toy_scene(views=1)
    empty = replace(scene, points=points.astype(np.float32), colors=scene.colors[: len(points)])
    with pytest.raises(SceneError, match="sparse points"):
        initialise(empty, opacity=0.1)


@pytest.mark.parametrize("function", [scales_of, opacities_of])
def test_gradients_of_the_activations(function):
    x = torch.randn(20, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(function, x.requires_grad_())
    extreme = torch.tensor([-200.0, 200.0 if function is opacities_of else 0.0]).requires_grad_()
    (gradient,) = torch.autograd.grad(function(extreme).sum(), extreme)
    assert torch.isfinite(gradient).all()


# Densification


def rows(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    parameters = {
        name: torch.randn(count, *shape, generator=generator) for name, shape in SHAPES.items()
    }
    parameters["logit_opacities"] = torch.full((count,), logit(0.5))
    parameters["log_scales"] = torch.full((count, 3), float(np.log(0.005)))
    return parameters


def run_round(parameters, gradient, *, prune_large=False, config=None, seed=0):
    return densify(
        parameters,
        gradient,
        extent=EXTENT,
        prune_large=prune_large,
        config=config or GaussianSplattingConfig(),
        generator=np.random.default_rng(seed),
    )


def test_a_small_gaussian_is_copied():
    parameters = rows(4)
    result = run_round(parameters, torch.tensor([0.0, 3e-4, 1e-4, 2e-4]))
    assert result.keep.all()
    for name in SHAPES:
        assert torch.equal(result.new[name], parameters[name][[1, 3]])


def test_a_large_gaussian_becomes_two_samples_of_itself():
    parameters = rows(3)
    parameters["log_scales"][1] = torch.log(torch.tensor([0.02, 0.3, 0.01]))
    result = run_round(parameters, torch.tensor([0.0, 3e-4, 0.0]))
    assert result.keep.tolist() == [True, False, True]
    assert len(result.new["means"]) == 2
    assert torch.equal(result.new["sh_rest"], parameters["sh_rest"][[1, 1]])
    assert torch.equal(result.new["quats"], parameters["quats"][[1, 1]])
    torch.testing.assert_close(
        scales_of(result.new["log_scales"]),
        scales_of(parameters["log_scales"][[1, 1]]) / 1.6,
        rtol=1e-6,
        atol=0,
    )


def test_parts_are_distributed_as_their_gaussian():
    from chronoscene.scene.geometry import rotation_from_quaternion

    count = 20_000
    parameters = {name: values[:1].repeat(count, *(1,) * (values.dim() - 1)) for name, values in
                  rows(1, seed=3).items()}  # fmt: skip
    scales = np.array([0.02, 0.3, 0.1])
    parameters["log_scales"][:] = torch.from_numpy(np.log(scales).astype(np.float32))
    result = run_round(parameters, torch.full((count,), 1.0))
    moves = (result.new["means"] - parameters["means"][0]).double().numpy()
    R = rotation_from_quaternion(parameters["quats"][0].double().numpy())
    expected = R @ np.diag(scales**2) @ R.T
    # 40,000 samples: the standard error of a covariance is under 0.8 % of the largest variance.
    np.testing.assert_allclose(np.cov(moves.T), expected, atol=0.03 * 0.3**2)
    np.testing.assert_allclose(moves.mean(0), 0, atol=0.01)


def test_faint_and_later_large_gaussians_go():
    parameters = rows(4)
    parameters["logit_opacities"][1] = logit(0.0049)
    parameters["log_scales"][2, 0] = float(np.log(0.111))
    quiet = torch.zeros(4)
    assert run_round(parameters, quiet).keep.tolist() == [True, False, True, True]
    assert run_round(parameters, quiet, prune_large=True).keep.tolist() == [
        True,
        False,
        False,
        True,
    ]
    # New rows are judged as the old ones are.
    assert len(run_round(parameters, torch.tensor([0, 1.0, 0, 0])).new["means"]) == 0


def test_the_limit_takes_the_largest_gradients():
    config = GaussianSplattingConfig(max_gaussians=6)
    gradient = torch.tensor([5e-4, 1e-4, 9e-4, 7e-4])
    scale = torch.tensor([0.001, 0.001, 0.001, 0.5])
    clone, split = choose_growth(gradient, scale, EXTENT, config)
    assert clone.tolist() == [False, False, True, False]
    assert split.tolist() == [False, False, False, True]
    full, _ = choose_growth(gradient, scale, EXTENT, replace(config, max_gaussians=3))
    assert not full.any()


def test_reset_leaves_no_opacity_above_the_limit():
    logits = torch.tensor([5.0, logit(0.01), -8.0])
    after = reset_opacities(logits, 0.01)
    assert (opacities_of(after) <= 0.01 * (1 + 1e-6)).all()
    assert after[1:].tolist() == logits[1:].tolist()


# Method


def test_moments_of_survivors_stay_and_new_rows_have_none():
    method = GaussianSplatting(replace(SHORT, gradient_threshold=0.0, max_gaussians=90))
    method.setup(toy_scene(), seed=0, device="cpu")
    for i in range(24):
        method.step(i, i / 250)
    before = {name: values.detach().clone() for name, values in method.parameters.items()}
    moments = {name: values.clone() for name, values in method._optimizer.state().items()}
    method.step(24, 24 / 250)
    after = method._optimizer.state()
    count = len(method.parameters["means"])
    assert 60 < count <= 90
    # Which old rows are still there, found by their values: nothing was stepped.
    kept = torch.tensor([bool((row == method.parameters["means"][:60]).all(1).any())
                         for row in before["means"]])  # fmt: skip
    survivors = int(kept.sum())
    assert 0 < survivors < count
    for name in SHAPES:
        assert torch.equal(method.parameters[name][:survivors], before[name][kept])
        for part in ("mean", "square"):
            assert torch.equal(after[f"{name}.{part}"][:survivors], moments[f"{name}.{part}"][kept])
            assert not after[f"{name}.{part}"][survivors:].any()


def test_a_reset_leaves_the_opacities_alone_otherwise():
    config = replace(SHORT, reset_interval=3_000, densify_from=30_000)
    method = GaussianSplatting(config)
    method.setup(toy_scene(), seed=0, device="cpu")
    for i in range(25):
        method.step(i, i / 250)
    before = method.parameters["logit_opacities"].detach().clone()
    means = method.parameters["means"].detach().clone()
    method.step(25, 0.1)
    assert torch.equal(method.parameters["logit_opacities"], before.clamp_max(logit(0.01)))
    assert not method._optimizer.state()["logit_opacities.mean"].any()
    assert not torch.equal(method.parameters["means"], means)


def test_it_learns_a_static_scene():
    scene = toy_scene(count=150)
    method = train(scene, replace(SHORT, iterations=600, max_gaussians=1_000))
    assert -10 * np.log10(mean_squared_error(method, scene)) > 32


@pytest.mark.slow
def test_it_learns_a_static_scene_to_35_db():
    scene = toy_scene(count=150)
    method = train(scene, replace(SHORT, iterations=1_500, densify_interval=50, max_gaussians=0))
    assert -10 * np.log10(mean_squared_error(method, scene)) > 35


def test_contradicting_periods_end_between_them():
    # One image per camera cannot be nearer to both periods than their average is; and one that
    # lies between them pixel by pixel is at most twice as far, in squares.
    scene = toy_scene(colors_per_period=2)
    images = np.stack([scene.load_image(i) / 255.0 for i in range(len(scene.views))])
    half = len(images) // 2
    average_error = np.mean((images[:half] - images[half:]) ** 2) / 4
    error = mean_squared_error(train(scene, SHORT), scene)
    assert average_error <= error < 2 * average_error


def test_every_period_renders_the_same():
    scene = toy_scene()
    method = train(scene, replace(SHORT, iterations=3))
    first, second = (method.render(scene.views[0], period).rgb for period in (0, 3))
    assert np.array_equal(first, second)


def test_saved_models_render_the_same(tmp_path):
    scene = toy_scene()
    method = train(scene, replace(SHORT, iterations=40))
    assert method.sh_degree == 3
    method.save(tmp_path)
    loaded = GaussianSplatting(GaussianSplattingConfig())
    loaded.load(tmp_path, device="cpu")
    assert loaded.config == method.config and loaded.size() == method.size()
    for view in scene.views[:3]:
        mine, theirs = method.render(view, 0), loaded.render(view, 0)
        assert np.array_equal(mine.rgb, theirs.rgb)
        assert np.array_equal(mine.alpha, theirs.alpha)
        assert np.array_equal(mine.depth, theirs.depth)
        assert mine.rgb.shape == (HEIGHT, WIDTH, 3) and mine.rgb.dtype == np.float32


def test_a_model_with_a_missing_group_is_refused(tmp_path):
    method = train(toy_scene(), replace(SHORT, iterations=1))
    del method.parameters["quats"]
    method.save(tmp_path)
    with pytest.raises(CheckpointError, match="parameter groups"):
        GaussianSplatting(GaussianSplattingConfig()).load(tmp_path, device="cpu")


def test_equal_seeds_give_equal_bytes_for_any_number_of_threads(tmp_path):
    # Enough rows for every kernel to share its work.
    scene = toy_scene(count=3_000, views=4)
    config = replace(SHORT, iterations=40, densify_interval=10, max_gaussians=4_000)
    contents = []
    for run, (threads, seed) in enumerate([(1, 0), (2, 0), (2, 0), (2, 1)]):
        set_threads(threads)
        folder = tmp_path / str(run)
        folder.mkdir()
        train(scene, config, seed=seed).save(folder)
        contents.append((folder / "model.safetensors").read_bytes())
    assert contents[0] == contents[1] == contents[2]
    assert contents[3] != contents[0]


def test_a_set_that_died_out_still_trains_and_renders():
    scene = toy_scene(views=2)
    method = GaussianSplatting(replace(SHORT, min_opacity=2.0, densify_interval=2))
    method.setup(scene, seed=0, device="cpu")
    for i in range(20):
        report = method.step(i, i / 250)
    assert report.primitives == 0 and np.isfinite(report.loss)
    assert not method.render(scene.views[0], 0).rgb.any()


# Specification


@pytest.mark.parametrize("preset", ["paper", "balanced", "fast"])
def test_presets_are_configurations(preset):
    config = build_config(SPEC, preset=preset)
    assert isinstance(config, GaussianSplattingConfig)
    assert (config == GaussianSplattingConfig()) == (preset == "paper")


def test_the_class_is_found():
    assert import_object(SPEC.method) is GaussianSplatting


@pytest.mark.parametrize(
    ("name", "value"), [("iterations", 0), ("sh_degree", 4), ("near_plane", -1.0)]
)
def test_impossible_options_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        GaussianSplattingConfig(**{name: value})
