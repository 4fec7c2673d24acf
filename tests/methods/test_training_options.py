"""Options that methods share: each does what it says, and a training with it can be resumed."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train import painted_balls
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import build_config, import_object, load_spec
from chronoscene.methods.interface import no_depths
from chronoscene.training import sparse_depth, views
from chronoscene.training.optimizers.adam import Adam
from chronoscene.training.views import downscale_view

STEPS = 30

GAUSSIANS = ["4dgs", "realtime4dgs", "gs-w", "cl-splats"]
"""Methods that are 3DGS and something else."""

ONE_OF_THEM = [
    pytest.param(name, marks=() if name == "realtime4dgs" else pytest.mark.slow)
    for name in GAUSSIANS
]
"""For what 3DGS does for all of them."""

OPTIONS = [
    ("3dgs", {"random_background": True}),
    ("3dgs", {"exposure": "image"}),
    ("3dgs", {"absgrad": True, "densify_interval": 8}),
    ("scaffold-gs", {"absgrad": True, "density_interval": 8, "depth_weight": 0.0}),
    ("3dgs", {"antialiased": True}),
    ("scaffold-gs", {"antialiased": True}),
    ("scaffold-gs", {"random_background": True, "exposure": "image"}),
    ("chronogs", {"exposure": "period"}),
    ("chronogs", {"unused_share": 0.05, "cooldown": 0.2}),
    ("chronogs", {"merge_share": 0.5, "density_interval": 8}),
    ("chronogs", {"period_decay": 3.0, "views_per_step": 2}),
    ("4dgs", {"exposure": "period", "cooldown": 0.5}),
    ("gs-w", {"reference": "period", "exposure": "image"}),
    ("3dgs", {"views_per_step": 2, "densify_interval": 8}),
    ("chronogs", {"views_per_step": 3, "density_interval": 8}),
    ("scaffold-gs", {"views_per_step": 2, "exposure": "image"}),
    ("cl-splats", {"views_per_step": 2}),
    ("3dgs", {"opacity_dropout": 0.4}),
    ("chronogs", {"opacity_dropout": 0.4, "views_per_step": 2}),
    ("3dgs", {"depth_weight": 0.3}),
    ("gs-w", {"depth_weight": 0.3, "exposure": "image"}),
    ("chronogs", {"depth_weight": 0.3, "views_per_step": 2}),
    ("3dgs", {"densification": "mcmc", "max_gaussians": 350, "densify_interval": 8}),
    ("gs-w", {"densification": "mcmc", "max_gaussians": 350, "densify_interval": 8}),
]
OPTIONS_IDS = [f"{method}-{'-'.join(options)}" for method, options in OPTIONS]


def start(name, data, **options):
    spec = load_spec(name)
    options = {"iterations": STEPS, **options}
    method = import_object(spec.method)(build_config(spec, preset="fast", overrides=options))
    method.setup(data, seed=0, device="cpu")
    return method


def train(method, start=0, stop=STEPS):
    reports = []
    while start < stop:
        reports.append(method.step(start, start / STEPS))
        start += reports[-1].views
    return reports


def saved(method, folder):
    folder.mkdir()
    method.save(folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(("name", "options"), OPTIONS, ids=OPTIONS_IDS)
def test_a_training_with_options_ends_the_same_when_interrupted(name, options, tmp_path):
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    whole = start(name, data, **options)
    views = options.get("views_per_step", 1)
    middle = 17 // views * views
    train(whole, 0, middle)
    (tmp_path / "training").mkdir()
    whole.save_training(tmp_path / "training")  # which changes nothing: a rule of the contract
    reports = train(whole, middle)
    second = start(name, data, **options)
    second.load_training(tmp_path / "training")
    assert train(second, middle) == reports
    assert saved(second, tmp_path / "second") == saved(whole, tmp_path / "whole")
    loaded = import_object(load_spec(name).method)(whole.config)
    loaded.load(tmp_path / "whole", device="cpu")
    for view, period in ((data.views[0], 0.0), (data.views[-1], float(data.views[-1].period))):
        ours, theirs = (m.render(view, period) for m in (whole, loaded))
        np.testing.assert_array_equal(ours.rgb, theirs.rgb)
    assert loaded.size() == whole.size()
    assert saved(loaded, tmp_path / "again") == saved(whole, tmp_path / "and again")


@pytest.mark.parametrize("name", ["3dgs", "chronogs"])
def test_the_next_photos_are_named_before_they_are_loaded(name):
    data, said, loaded = painted_balls.make_training_set(1), [], []

    def load(index):
        loaded.append(index)
        return data.load_image(index)

    train(start(name, replace(data, load_image=load, expect=said.append)), 0, 4)
    assert len(said) == 4 and [views[0] for views in said] == loaded


@pytest.mark.parametrize("name", ["3dgs", "scaffold-gs"])
def test_a_random_background_leaves_no_hole_where_photos_are_as_dark_as_it(name):
    """Black photos need no Gaussians before black; before any colour they need opaque ones."""
    data = painted_balls.make_training_set(1)
    black = np.zeros((painted_balls.HEIGHT, painted_balls.WIDTH, 3), np.uint8)
    data = replace(data, load_image=lambda index: black)
    drawn = []
    for random in (False, True):
        method = start(name, data, random_background=random)
        train(method)
        drawn.append(float(np.mean([method.render(v, 0.0).alpha.mean() for v in data.views])))
    assert drawn[1] > 1.2 * drawn[0]


@pytest.mark.parametrize("name", ["3dgs", "scaffold-gs", "chronogs", *GAUSSIANS])
def test_steps_leave_gaussians_out_once_the_training_is_under_way(name):
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    usual, thinned = start(name, data), start(name, data, opacity_dropout=0.9)
    assert usual.step(0, 0.0).loss == thinned.step(0, 0.0).loss
    assert abs(thinned.step(1, 0.9).loss - usual.step(1, 0.9).loss) > 1e-4


@pytest.mark.parametrize("name", ["3dgs", "scaffold-gs", "chronogs", *ONE_OF_THEM])
def test_surfaces_are_held_to_the_sparse_points(name, monkeypatch):
    monkeypatch.setattr(sparse_depth, "INTERVAL", 1)  # so that a few steps are enough
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    deviations = []
    for weight in (0.0, 3.0):
        method = start(name, data, depth_weight=weight)
        train(method)
        rendered = [method.render(view, float(view.period)).depth for view in data.views]
        known = [data.load_depths(index) for index in range(len(data.views))]
        ratios = [d.flat[k.pixels] / k.depths for d, k in zip(rendered, known, strict=True)]
        deviations.append(float(np.mean(np.abs(np.concatenate(ratios) - 1))))
    assert deviations[1] < 0.95 * deviations[0]


@pytest.mark.parametrize("name", ["3dgs", "scaffold-gs", "chronogs", *GAUSSIANS])
def test_large_photos_are_drawn_at_half_their_size_at_first(name, monkeypatch, tmp_path):
    monkeypatch.setattr(views, "HALVED_PIXELS", 1)
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    method, widths = start(name, data, half_size_share=0.5, iterations=8), []
    for index in range(8):
        assert not method.step(index, index / 8).skipped
        widths.append(method.trainer.train.views[0].width)
        if index == 2:
            (tmp_path / "training").mkdir()
            method.save_training(tmp_path / "training")
    bounds = getattr(method.trainer, "bounds", [0.0, 1.0])  # cl-splats: of its dates
    middles = [(a, (a + b) / 2) for a, b in pairwise(bounds)]
    small = [any(a <= index / 8 < middle for a, middle in middles) for index in range(8)]
    assert widths == [painted_balls.WIDTH // (1 + half) for half in small]
    resumed = start(name, data, half_size_share=0.5, iterations=8)
    resumed.load_training(tmp_path / "training")
    for index in range(3, 8):
        resumed.step(index, index / 8)
    assert saved(resumed, tmp_path / "resumed") == saved(method, tmp_path / "whole")


@pytest.mark.parametrize("name", ["3dgs", *GAUSSIANS])
def test_a_cooldown_lowers_the_rates_of_all_tensors_in_its_share(name, monkeypatch):
    """Networks and planes are among them. Anchors: tests/chronogs/test_training.py."""
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    taken, step = [], Adam.step

    def watched(adam, rates, **options):
        taken[-1].append(dict(rates))
        step(adam, rates, **options)

    monkeypatch.setattr(Adam, "step", watched)
    steps = range(0, STEPS, 3)
    for cooldown in (0.0, 0.25):
        taken.append([])
        options = {"cooldown": cooldown, "exposure": "none"}
        method = start(name, replace(data, views=data.views[:1]), **options)
        for index in steps:
            method.step(index, index / STEPS)
    for index, plain, cooled in zip(steps, *taken, strict=True):
        assert cooled.keys() == plain.keys() >= set(method.model.tensors()) - {"strays"}
        factor = 0.1 ** max((index / STEPS - 0.75) / 0.25, 0.0)
        for tensor, rate in plain.items():
            assert cooled[tensor] == pytest.approx(rate * factor, rel=1e-12), tensor
            assert index < 0.75 * STEPS or cooled[tensor] < rate


@pytest.mark.parametrize("name", ["3dgs", *ONE_OF_THEM, "scaffold-gs", "chronogs"])
def test_antialiased_models_are_as_opaque_in_small_images(name):
    """At a quarter of the size the blur enlarges everything, unless opacities make up for it."""
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    errors, losses = [], []
    for antialiased in (False, True):
        method = start(name, data, antialiased=antialiased)
        losses.append(train(method)[0].loss)
        covered = [
            [method.render(v, float(view.period)).alpha.mean() for v in (view, small)]
            for view in data.views
            for small in [downscale_view(view, 4)]
        ]
        errors.append(float(np.abs(np.diff(covered)).mean()))
    assert errors[1] < 0.15 * errors[0] and losses[1] != losses[0]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("chronogs", {"density_interval": 8}),
        ("scaffold-gs", {"exposure": "image"}),
        ("3dgs", {"densify_interval": 8}),
        ("4dgs", {}),
        ("realtime4dgs", {}),
        ("gs-w", {}),
        ("cl-splats", {}),
    ],
)
def test_steps_of_several_views_have_equal_bits_for_any_number_of_threads(name, options, tmp_path):
    if set_threads() < 2:
        pytest.skip("one processor only")
    data = painted_balls.make_training_set(tiny_training.periods_for(load_spec(name)))
    results = []
    for threads in (1, 2):
        set_threads(threads)
        method = start(name, data, views_per_step=4, **options)
        reports = train(method)
        assert sum(report.views for report in reports) == STEPS and reports[-1].views == 2
        assert reports[-1].loss < reports[0].loss
        results.append((reports, saved(method, tmp_path / str(threads))))
    assert results[0] == results[1]


def test_a_training_goes_on_with_as_many_views_to_a_step(tmp_path):
    data = painted_balls.make_training_set(1)
    first, second = (start("3dgs", data, views_per_step=n) for n in (2, 1))
    train(first, 0, 4)
    first.save_training(tmp_path)
    with pytest.raises(
        CheckpointError, match=r"views_per_step: expected 2, found 1; continue with"
    ):
        second.load_training(tmp_path)


@pytest.mark.parametrize("name", ["3dgs", "chronogs"])
def test_views_without_sparse_points_are_learned_all_the_same(name):
    data = painted_balls.make_training_set(1)
    some = replace(
        data, load_depths=lambda index: (no_depths if index else data.load_depths)(index)
    )
    reports = train(start(name, some, depth_weight=0.1))
    assert not any(report.skipped for report in reports) and reports[-1].loss < reports[0].loss


@pytest.mark.parametrize("name", ["3dgs", "chronogs"])
def test_points_that_no_image_observes_hold_no_surface(name):
    data = replace(painted_balls.make_training_set(1), load_depths=no_depths)
    held, free = (train(start(name, data, depth_weight=weight)) for weight in (0.1, 0.0))
    assert held == free
    with pytest.raises(ConfigError, match=r"absgrad: expected False with depth_weight"):
        start(name, data, depth_weight=0.1, absgrad=True)


def test_methods_without_steps_of_several_views_say_so():
    with pytest.raises(ConfigError, match=r"nerf --set.*views_per_step"):
        start("nerf", None, views_per_step=2)
    with pytest.raises(ConfigError, match=r"views_per_step: expected .*found '?0"):
        start("3dgs", None, views_per_step=0)
