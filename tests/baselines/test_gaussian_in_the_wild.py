"""GS-W: what its networks read and compute, whose photos they see, and what a model keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from toy_scene import SHORT, photo_of, ring_of_views, solid_gaussians, toy_scene, train

from baselines.gaussian_in_the_wild import SPEC, networks
from baselines.gaussian_in_the_wild.config import GaussianInTheWildConfig
from baselines.gaussian_in_the_wild.features import read_features, small_photo, start_coordinates
from baselines.gaussian_in_the_wild.method import GaussianInTheWild
from baselines.gaussian_in_the_wild.model import COORDINATES
from baselines.gaussian_in_the_wild.networks import (
    Networks,
    colors_of,
    read_photo,
    see,
    start_networks,
)
from baselines.gaussian_in_the_wild.trainer import WildTrainer, central_views
from chronoscene.errors import ConfigError
from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train import painted_balls
from chronoscene.methods import TrainingSet, View, build_config
from chronoscene.training.photometric import photometric_loss_reference
from chronoscene.training.views import PhotosOnDevice


def config(**changes: Any) -> GaussianInTheWildConfig:
    """The preset for short trainings, made for the toy scene."""
    made = {"iterations": 200, "densify_interval": 25, "max_gaussians": 200, **changes}
    found: GaussianInTheWildConfig = build_config(SPEC, preset="fast", overrides=made)
    return found


DUSK = torch.tensor([0.4, 0.6, 1.0])


def two_periods() -> TrainingSet:
    """Ten photos of each period; the second is in another light."""
    scene = replace(toy_scene(colors_per_period=2), num_periods=2)
    images = [lit(view, view.period) for view in scene.views]
    return replace(scene, load_image=images.__getitem__)


def lit(view: View, period: int) -> np.ndarray:
    """Photo of a view in the light of a period."""
    colors = solid_gaussians(60, 1)[1]
    found: np.ndarray = photo_of(
        solid_gaussians(60, 0)[0], colors * DUSK if period else colors, view
    )
    return found


def begun(scene: TrainingSet, steps: int = 0, **changes: Any) -> GaussianInTheWild:
    method = GaussianInTheWild(config(**changes))
    method.setup(scene, seed=0, device="cpu")
    for index in range(steps):
        method.step(index, index / 200)
    return method


def trainer_of(method: GaussianInTheWild) -> WildTrainer:
    assert method.trainer is not None
    return method.trainer


def make_networks(**changes: Any) -> Networks:
    sizes = {"encoder": "small", "map_channels": 2, "width": 8, "frequencies": 2}
    return Networks(**{**sizes, "position_unit": 0.5, "from_constant": False, **changes})


def make_problem(made: Networks, count: int, kind: Any) -> tuple[list[torch.Tensor], list[str]]:
    """Means, features of two kinds, a camera centre, and the weights of the colour network."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(count, 3), (count, networks.INTRINSIC), (count, made.dynamic), (3,)]
    own = start_networks(made, 0)
    names = [name for name in own if name.startswith("color.")]
    values = [torch.randn(shape, generator=generator) for shape in shapes]
    values += [own[n] + 0.1 * torch.randn(own[n].shape, generator=generator) for n in names]
    return [value.to(kind) for value in values], names


def call(function: Any, made: Networks, values: Any, names: list[str]) -> torch.Tensor:
    result: torch.Tensor = function(*values[:4], dict(zip(names, values[4:], strict=True)), made)
    return result


# Networks


def test_the_sizes_of_the_released_networks() -> None:
    made = GaussianInTheWild(GaussianInTheWildConfig())
    made.setup(toy_scene(), seed=0, device="cpu")
    layers = made.model.networks.layers()
    assert [layers[f"color.encoder.{i}"] for i in range(4)] == [
        (128, 159), (96, 128), (64, 96), (48, 64)
    ]  # fmt: skip
    assert [layers[f"color.decoder.{i}"] for i in range(3)] == [(48, 96), (48, 48), (48, 48)]
    assert [layers[f"color.head.{i}"] for i in range(2)] == [(48, 51), (3, 48)]
    filters = made.model.networks.filters()
    assert filters["photo.maps"][0] == 48 and filters["photo.down.0"] == (64, 3, 7, 7)
    encoder = [n for n in filters if n.startswith(("photo.down", "photo.block", "photo.shortcut"))]
    # ResNet-18 without the layer of classes has 11,166,912 numbers in its filters.
    assert sum(np.prod(filters[name]) for name in encoder) == 11_166_912
    # 62 numbers of each Gaussian are stored there, three of them normals; and coordinates.
    assert sum(t[0].numel() for t in made.model.parameters.values()) == 62 - 3 + 6
    assert np.isfinite(made.step(0, 0.5).loss)


@pytest.mark.parametrize("encoder", networks.ENCODERS)
@pytest.mark.parametrize("size", [(1, 1), (33, 20), (64, 48)])
def test_maps_have_half_the_size_of_the_photo(encoder: str, size: tuple[int, int]) -> None:
    made = make_networks(encoder=encoder)
    tensors, photo = start_networks(made, 0), torch.rand(1, 3, size[1], size[0])
    maps, stages = read_photo(photo, tensors, made)
    assert maps.shape == (3, 2, -(-size[1] // 2), -(-size[0] // 2))
    seen = see(stages, tensors, size[1], size[0])
    assert seen.shape == (size[1], size[0]) and 0 < float(seen.min()) <= float(seen.max()) < 1


def test_all_tensors_of_the_networks_get_a_gradient() -> None:
    """All that are not behind a zero, with which residual blocks start."""
    made = make_networks(encoder="resnet18")
    own = {name: tensor.requires_grad_() for name, tensor in start_networks(made, 0).items()}
    maps, stages = read_photo(torch.rand(1, 3, 64, 64), own, made)
    (maps.square().sum() + see(stages, own, 64, 64).sum()).backward()
    without = {n for n, t in own.items() if n.startswith("photo.") and t.grad is None}
    assert not without
    zero = {n for n, t in own.items() if t.grad is not None and not t.grad.any()}
    assert zero == {n for n in own if ".first." in n}


def test_colors_have_the_gradients_of_finite_differences() -> None:
    made = make_networks(frequencies=1)
    values, names = make_problem(made, 2, torch.float64)
    leaves = [value.requires_grad_(i != 3) for i, value in enumerate(values)]
    assert torch.autograd.gradcheck(lambda *v: call(colors_of, made, v, names), leaves)


def test_colors_start_as_those_of_the_points() -> None:
    scene = toy_scene()
    colors = begun(scene).splats(scene.views[0], 0, 0).colors
    np.testing.assert_allclose(colors.detach(), scene.colors / 255, atol=1e-6)


@pytest.mark.parametrize("scale", [-4.0, 0.0])
def test_gaussians_without_a_colour_are_not_drawn(scale: float) -> None:
    """Small ones and large ones, all around the camera."""
    scene = toy_scene()
    generator = np.random.default_rng(0)
    points = generator.uniform(-3, 3, (2_000, 3)).astype(np.float32)
    scene = replace(scene, points=points, colors=np.full((2_000, 3), 200, np.uint8))
    method = begun(scene)
    p = method.model.parameters
    with torch.no_grad():
        p["log_scales"].copy_(torch.from_numpy(generator.normal(scale, 1.0, (2_000, 3))))
        p["quats"].copy_(torch.from_numpy(generator.normal(size=(2_000, 4))))
        p["logit_opacities"].fill_(9.0)
    for view in scene.views:
        rows = method.model.rows_in(view)
        drawn = method.draw_splats(method.splats(view, 0, 0), view).info.radii[0].gt(0).all(-1)
        assert set(drawn.nonzero()[:, 0].tolist()) <= set(rows.tolist())
        assert int(drawn.sum()) > 10 and len(rows) < 2_000


# Reading


def ramps(height: int, width: int) -> torch.Tensor:
    """Maps of two channels that say where they are read, x and y in -1..1 at the outer edges."""
    x, y = (2 * (torch.arange(n, dtype=torch.float64) + 0.5) / n - 1 for n in (width, height))
    plane = torch.stack([x.expand(height, width), y[:, None].expand(height, width)])
    return torch.stack([plane, 10 + plane, 20 + plane])


def test_gaussians_read_at_their_coordinates_and_where_they_are_projected_to() -> None:
    """The camera's principal point is not the middle."""
    view = ring_of_views(3)[0]
    pose, means = (
        view.cam_from_world,
        torch.tensor(
            [[0.1, 0.05, 0.2], [0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 0.1, 0.6]],
            dtype=torch.float64,
        ),
    )
    coordinates = start_coordinates(means, 1.0, 0).double()
    read, inside = read_features(ramps(60, 80), means, coordinates, view, box_in_pixels=False)
    seen = means.numpy() @ pose[:3, :3].T + pose[:3, 3]
    places = (seen @ view.K.T)[:, :2] / seen[:, 2:] / (view.width, view.height) * 2 - 1
    assert inside.tolist() == [True, True, False, False]
    np.testing.assert_allclose(read[:2, 4:], 20 + places[:2], atol=1e-6)
    assert not read[2:, 4:].any()
    border = coordinates[:, :2].clamp(-1 + 1 / 60, 1 - 1 / 60)
    near = (coordinates[:, :2].abs() < 1 - 1 / 60).all(-1).all(-1)
    assert near.any()
    np.testing.assert_allclose(read[near, 0:2], border[near, 0], atol=1e-9)
    np.testing.assert_allclose(read[near, 2:4], 10 + border[near, 1], atol=1e-9)


def test_a_larger_box_reads_further_left_and_up_and_pixels_are_a_unit_of_its_sides() -> None:
    view, means = ring_of_views(3)[0], torch.zeros(1, 3, dtype=torch.float64)
    found = {}
    for side in (1.0, 2.0, 0.25):
        coordinates = start_coordinates(means, side, 0).double()
        read, inside = read_features(ramps(60, 80), means, coordinates, view, box_in_pixels=False)
        found[side] = read[0, 4:] if inside else None
    assert found[0.25] is None and found[1.0] is not None and found[2.0] is not None
    np.testing.assert_allclose(found[2.0] - 20, (found[1.0] - 20 + 1) / 2 - 1, atol=1e-6)
    coordinates[:, -1] = torch.tensor([view.width, view.height])
    read, _ = read_features(ramps(60, 80), means, coordinates, view, box_in_pixels=True)
    np.testing.assert_allclose(read[0, 4:], found[1.0], atol=1e-9)


def test_reading_has_the_gradients_of_finite_differences() -> None:
    view, generator = ring_of_views(3)[0], torch.Generator().manual_seed(0)
    means = 0.2 * torch.rand(4, 3, generator=generator, dtype=torch.float64)
    maps = torch.rand(3, 2, 5, 7, generator=generator, dtype=torch.float64)
    leaves = [maps, means, 0.9 * start_coordinates(means, 1.2, 0).double()]

    def function(maps: torch.Tensor, means: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        return read_features(maps, means, at, view, box_in_pixels=False)[0]

    assert torch.autograd.gradcheck(function, [leaf.requires_grad_() for leaf in leaves])


def test_neighbours_start_to_read_near_each_other() -> None:
    means = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32))
    at = start_coordinates(means, 7.0, 3)
    assert at.shape == (200, 3, 2) and (at[:, -1] == 7).all() and float(at[:, :-1].abs().max()) <= 1
    moved = start_coordinates(torch.cat([means[:1] + 1e-3, means[1:]]), 7.0, 3)
    assert float((moved - at).abs().max()) < 2e-3
    assert torch.equal(at, start_coordinates(means, 7.0, 3))
    assert not torch.equal(at, start_coordinates(means, 7.0, 4))
    assert start_coordinates(means[:1], 7.0, 3).isfinite().all()


def test_photos_are_read_small_and_grey_where_they_do_not_count() -> None:
    photo, mask = np.full((60, 80, 3), 200, np.uint8), np.ones((60, 80), bool)
    mask[:30] = False
    small = small_photo(photo, mask, 20)
    assert small.shape == (15, 20, 3) and (small[:7] == 128).all() and (small[8:] == 200).all()
    assert (photo == 200).all()
    for size in (0, 80, 100):
        assert small_photo(photo, None, size).shape == photo.shape


# Training


def test_with_features_of_zero_a_model_is_its_static_part() -> None:
    """The colours are those of the network with features of zero, at all periods."""
    scene = two_periods()
    method = begun(scene, 3)
    method.model.period_features = torch.zeros_like(method.stored_tensors()["period_features"])
    model, view = method.model, scene.views[3]
    p = model.parameters
    intrinsic = torch.cat([p["sh_dc"], p["sh_rest"].flatten(1)], 1).double()
    centre = torch.tensor(-view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3])
    zero = torch.zeros(len(model), model.networks.dynamic, dtype=torch.float64)
    tensors = {name: tensor.double() for name, tensor in model.shared.items()}
    truth = colors_of(p["means"].double(), intrinsic, zero, centre, tensors, model.networks)
    for period in (0, 1):
        colors = method.splats(view, period, period).colors
        np.testing.assert_allclose(colors.detach(), truth.detach(), atol=1e-5)


@pytest.mark.parametrize("reference", ["image", pytest.param("period", marks=pytest.mark.slow)])
def test_periods_differ_in_colour_alone_and_are_told_apart(reference: str) -> None:
    scene = two_periods()
    wild = train(scene, config(reference=reference), method_class=GaussianInTheWild)
    static = train(scene, replace(SHORT, iterations=200, max_gaussians=200))
    view = ring_of_views(7)[2]
    images = [wild.render(view, float(period)) for period in (0, 1)]
    np.testing.assert_array_equal(images[0].alpha, images[1].alpha)
    np.testing.assert_array_equal(images[0].depth, images[1].depth)
    truths = [lit(view, period) / 255 for period in (0, 1)]
    errors = [[float(np.mean((image.rgb - t) ** 2)) for t in truths] for image in images]
    blend = [float(np.mean((static.render(view, 0.0).rgb - t) ** 2)) for t in truths]
    assert errors[0][0] < 0.3 * errors[0][1] and errors[1][1] < 0.3 * errors[1][0]
    assert errors[0][0] + errors[1][1] < 0.5 * sum(blend)
    # The colours follow the photos that are read, and not the period of the geometry.
    mixed = wild.render_split(view, geometry_period=0.0, appearance_period=1.0)
    np.testing.assert_array_equal(mixed.rgb, images[1].rgb)


def test_what_is_gone_in_a_period_leaves_a_ghost() -> None:
    """Opacities are those of all periods: what the method cannot do."""
    scene = two_periods()
    (means, colors), stays = solid_gaussians(60, 0), solid_gaussians(60, 0)[0][:, 2] < 0
    images = [
        photo_of(means[stays], colors[stays], v) if v.period else photo_of(means, colors, v)
        for v in scene.views
    ]
    wild = train(
        replace(scene, load_image=images.__getitem__),
        config(iterations=110),
        method_class=GaussianInTheWild,
    )
    view = ring_of_views(7)[2]
    first, second = (wild.render(view, float(period)) for period in (0, 1))
    np.testing.assert_array_equal(first.alpha, second.alpha)
    bare = photo_of(means[stays], colors[stays], view).max(-1) < 5
    covered = bare & (photo_of(means[~stays], colors[~stays], view).max(-1) > 100)
    assert covered.sum() > 20 and second.alpha is not None
    assert float(second.alpha[covered].mean()) > 0.2


def test_features_of_a_period_are_the_mean_over_its_training_photos() -> None:
    scene = two_periods()
    method = begun(scene, 5)
    found, channels = method.stored_tensors()["period_features"], 16
    rows = torch.arange(len(found))
    for period in (0, 1):
        reads = [
            trainer_of(method)._read(i, rows)[:2]
            for i, view in enumerate(scene.views)
            if view.period == period
        ]
        dynamic = torch.stack([read for read, _ in reads])
        inside = torch.stack([inside for _, inside in reads])[..., None]
        free = dynamic[..., :-channels].mean(0)
        projected = dynamic[..., -channels:].sum(0) / inside.sum(0).clamp_min(1)
        torch.testing.assert_close(found[:, period], torch.cat([free, projected], 1))


def test_one_photo_of_a_period_is_that_of_the_camera_in_the_middle() -> None:
    scene = two_periods()
    centres = {0: [0.0, 4.0, 1.9, 9.0], 1: [5.0, 6.0, 7.0]}
    views = []
    for period, places in centres.items():
        for place in places:
            pose = np.eye(4)
            pose[0, 3] = -place
            views.append(replace(scene.views[0], cam_from_world=pose, period=period))
    assert central_views(replace(scene, views=tuple(views))) == {0: 1, 1: 5}
    method = begun(scene, 3, reference="period")
    trainer = trainer_of(method)
    for period, number in central_views(scene).items():
        found = method.stored_tensors()["period_features"][:, period]
        assert torch.equal(found, trainer._read(number, torch.arange(len(found)))[0].detach())
    loaded: list[int] = []
    trainer.train = replace(scene, load_image=lambda i: (loaded.append(i), scene.load_image(i))[1])
    trainer.photos = PhotosOnDevice(trainer.train, torch.device("cpu"))
    method.step(3, 0.1)
    assert loaded[0] == central_views(scene)[scene.views[loaded[1]].period]


def test_a_period_without_photos_reads_zeros() -> None:
    method = begun(replace(two_periods(), num_periods=3), 1)
    found = method.stored_tensors()["period_features"]
    assert found[:, 1].any() and not found[:, 2].any()


def test_test_photos_change_no_bit_of_a_prediction(tmp_path: Path) -> None:
    """Noise in their place, or nothing that could be loaded at all once the model is saved."""
    images, views = [], painted_balls.make_training_set(3).views
    for noise in (False, True):
        data = tiny_training.training_set_on_disk(SPEC, tmp_path, noisy_tests=noise)
        assert len(data.views) == 12 and len(views) == 15
        method, _ = tiny_training.train(SPEC, data, steps=40)
        images.append([method.render(view, float(view.period)).rgb for view in views])
    np.testing.assert_array_equal(*images)
    (tmp_path / "model").mkdir()
    method.save(tmp_path / "model")
    for photo in tmp_path.glob("*.png"):
        photo.unlink()
    loaded = GaussianInTheWild(method.config)
    loaded.load(tmp_path / "model", device="cpu")
    again = [loaded.render(view, float(view.period)).rgb for view in views]
    np.testing.assert_array_equal(again, images[0])
    kept = loaded.stored_tensors()
    assert COORDINATES not in kept and not any(name.startswith("photo.") for name in kept)


def test_the_features_of_periods_are_read_anew_after_a_step_and_a_resumed_training(
    tmp_path: Path,
) -> None:
    scene = two_periods()
    method, other = begun(scene, 2), begun(scene)
    before = method.stored_tensors()["period_features"]
    assert method.stored_tensors()["period_features"] is before
    method.save_training(tmp_path)
    start = other.stored_tensors()["period_features"]
    other.load_training(tmp_path)
    assert torch.equal(other.stored_tensors()["period_features"], before)
    method.step(2, 0.01)
    after = method.stored_tensors()["period_features"]
    assert not torch.equal(before, after) and not torch.equal(before, start)


def test_gaussians_in_another_order_look_the_same(tmp_path: Path) -> None:
    """Features read from photos move with their Gaussians: compressed models are sorted."""
    scene = two_periods()
    method = begun(scene, 40)
    method.save(tmp_path)
    loaded = GaussianInTheWild(method.config)
    loaded.load(tmp_path, device="cpu")
    loaded.permute(np.random.default_rng(0).permutation(len(loaded.model)))
    for period in (0.0, 1.0):
        image, other = (m.render(scene.views[0], period).rgb for m in (method, loaded))
        np.testing.assert_allclose(other, image, rtol=0, atol=1e-5)


def test_torch_has_its_threads_again_after_a_step() -> None:
    scene = toy_scene()
    torch.set_num_threads(2)
    begun(scene, 1).render(scene.views[0], 0.0)
    assert torch.get_num_threads() == 2


# Visibility


def test_visibility_counts_after_its_moment_alone() -> None:
    """Before it the model is the same, bit by bit, as without visibility."""
    scene = toy_scene()
    models = [
        begun(scene, 6, visibility=on, visibility_from=30_000).model.tensors()
        for on in (True, False)
    ]
    assert all(torch.equal(tensor, models[1][name]) for name, tensor in models[0].items())
    method = begun(scene, 6, visibility=True, visibility_from=0)
    filters = [name for name in method.model.shared if name.startswith("photo.see.")]
    assert filters
    for name in filters:
        assert not torch.equal(method.model.shared[name], models[1][name])


def test_visibility_pauses_after_an_opacity_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a training that goes on from between the two."""
    monkeypatch.setattr("baselines.gaussian_in_the_wild.trainer.PAUSE", 3)
    options = {"visibility": True, "visibility_from": 0, "reset_interval": 600}
    method, resumed = (begun(two_periods(), **options) for _ in range(2))
    counts = []
    for index in range(10):  # 150 moments each; resets are in steps 4 and 8
        if index == 5:
            trainer_of(resumed).load_state(trainer_of(method).state())
        for each in (method, resumed) if index >= 5 else (method,):
            each.step(index, index / 200)
        counts.append(trainer_of(method)._visible is not None)
        if index >= 5:
            assert (trainer_of(resumed)._visible is not None) == counts[-1]
    assert counts == [True] * 5 + [False] * 3 + [True, False]


def test_the_loss_has_the_gradients_of_the_reference_in_image_and_visibility() -> None:
    method, generator = begun(toy_scene()), torch.Generator().manual_seed(0)
    trainer = trainer_of(method)
    image, visible = (
        torch.rand(20, 30, 3, generator=generator),
        torch.rand(20, 30, generator=generator),
    )
    photo = torch.randint(0, 256, (20, 30, 3), generator=generator).byte()
    found = []
    for kind in (torch.float32, torch.float64):
        leaves = [value.to(kind, copy=True).requires_grad_() for value in (image, visible)]
        if kind == torch.float32:
            trainer._visible = leaves[1]
            loss = trainer.compare(leaves[0], photo, None)
        else:
            seen = leaves[1][..., None]
            pair = leaves[0] * seen, photo.double() / 255 * seen
            loss = photometric_loss_reference(*pair) + 0.15 * (1 - leaves[1]).square().mean()
        loss.backward()
        found.append((loss.detach(), *(leaf.grad for leaf in leaves)))
    for ours, truth in zip(*found, strict=True):
        assert float((ours - truth).abs().max()) <= 2e-5 * float(truth.abs().max())
    trainer._visible = torch.ones(20, 30)
    seen_all = trainer.compare(image, photo, None)
    trainer._visible = None
    assert float(seen_all) == pytest.approx(float(trainer.compare(image, photo, None)), rel=1e-6)


def test_what_covers_the_scene_in_single_photos_is_taken_for_not_visible() -> None:
    scene = toy_scene(views=20)
    generator, images, hidden = np.random.default_rng(0), [], []
    for i in range(len(scene.views)):
        photo = scene.load_image(i).copy()
        row, column = generator.integers(6, 22), generator.integers(10, 30)
        photo[row : row + 8, column : column + 8] = (255, 0, 255)
        images.append(photo)
        hidden.append((slice(row, row + 8), slice(column, column + 8)))
    covered = replace(scene, load_image=images.__getitem__)
    method = train(covered, config(visibility=True), method_class=GaussianInTheWild)
    trainer, inside, whole = trainer_of(method), [], []
    for i, place in enumerate(hidden):
        with torch.no_grad():
            seen = see(
                trainer._read(i, torch.arange(1))[2], method.model.shared, *images[i].shape[:2]
            )
        inside.append(float(seen[place].mean()))
        whole.append(float(seen.mean()))
    assert np.mean(inside) < np.mean(whole) - 0.2


# Options


def test_coordinates_outside_of_the_maps_cost() -> None:
    scene = toy_scene()
    losses = []
    for place in (1.0, 3.0):  # all read the border of the maps
        method = begun(scene, coordinate_weight=10.0, dropout=0.0)
        with torch.no_grad():
            method.model.parameters[COORDINATES][:, :-1] = place
        losses.append(method.step(0, 0.0).loss)
    assert losses[1] - losses[0] == pytest.approx(10.0 * 2, rel=1e-4)


def test_dropout_is_in_training_alone() -> None:
    scene = toy_scene()
    with_it, without = (begun(scene, 4, dropout=share) for share in (0.9, 0.0))
    assert with_it.trainer is not None
    images = [with_it.render(scene.views[0], 0.0).rgb for _ in range(2)]
    np.testing.assert_array_equal(*images)
    assert with_it.step(4, 0.02).loss != without.step(4, 0.02).loss


@pytest.mark.parametrize("unit", ["world", "training"])
def test_positions_are_encoded_in_the_unit_that_was_asked_for(unit: str) -> None:
    scene = toy_scene()
    scene = replace(scene, training_from_world=replace(scene.training_from_world, scale=0.2))
    method = begun(scene, length_unit=unit)
    assert method.model.networks.position_unit == (0.2 if unit == "world" else 1.0)


def test_the_released_rates_fall_and_the_colour_network_keeps_its_own() -> None:
    method = GaussianInTheWild(GaussianInTheWildConfig())
    method.setup(toy_scene(), seed=0, device="cpu")
    first, last = (
        method.learning_rates(trainer_of(method).timeline.at(i, i / 30_000)) for i in (0, 29_999)
    )
    for rates, scale in ((first, 1.0), (last, 0.1)):
        assert rates["photo.maps.weight"] == pytest.approx(2e-3 * scale, rel=1e-3)
        assert rates["color.head.0.weight"] == 5e-4
        assert rates["sh_dc"] == rates["sh_rest"] == 1.25e-4
    assert first[COORDINATES] == pytest.approx(1, rel=1e-3)
    assert last[COORDINATES] == pytest.approx(0.01, rel=1e-3)
    assert first.keys() == method.model.tensors().keys()


def test_an_exported_model_looks_alike_in_the_training_views() -> None:
    scene = two_periods()
    method = begun(scene, 50)
    own = [view for view in scene.views if view.period == 1]
    gaussians = method.to_gaussians(1.0, own)
    for view in own[::3]:
        drawn = method.render_gaussians(gaussians, view).rgb
        assert float(np.abs(drawn - method.render(view, 1.0).rgb).mean()) < 0.01


def test_presets_have_the_iterations_of_other_methods() -> None:
    steps = {name: build_config(SPEC, preset=name).iterations for name in SPEC.presets}
    assert steps == {"paper": 30_000, "accurate": 8_000, "balanced": 3_000, "fast": 1_000}


@pytest.mark.parametrize(("name", "value"), [("reference", "test"), ("encoder", "vgg")])
def test_impossible_options_are_named(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        GaussianInTheWildConfig(**{name: value})
