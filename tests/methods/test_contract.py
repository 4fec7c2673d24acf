"""What every installed method must do, so that the harness need not know which one it drives.

``pytest tests/methods -k NAME`` checks one method.
"""

import dataclasses
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tiny_training
from safetensors import safe_open

from chronoscene.errors import CheckpointError
from chronoscene.kernels.runtime import set_threads
from chronoscene.methods import (
    Method,
    MethodSpec,
    StepReport,
    TrainingSet,
    View,
    build_config,
    import_object,
    load_spec,
    method_names,
)


@dataclass
class Trained:
    """A method after training, with what it was trained on and what it saved."""

    spec: MethodSpec
    method: Method
    reports: list[StepReport]
    data: TrainingSet
    folder: Path

    def loaded(self) -> Method:
        """A new instance that has read the checkpoint."""
        method: Method = import_object(self.spec.method)(tiny_training.small_config(self.spec))
        method.load(self.folder, device="cpu")
        return method


@pytest.fixture(scope="module", params=method_names())
def name(request):
    return request.param


@pytest.fixture(scope="module")
def spec(name):
    return load_spec(name)


@pytest.fixture(scope="module")
def trained(spec, tmp_path_factory):
    data = tiny_training.make_training_set(tiny_training.periods_for(spec))
    method, reports = tiny_training.train(spec, data)
    folder = tmp_path_factory.mktemp(spec.name)
    method.save(folder)
    return Trained(spec, method, reports, data, folder)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def resized(view, width, height):
    scale = np.diag([width / view.width, height / view.height, 1.0])
    return View(scale @ view.K, width, height, view.cam_from_world)


def test_the_spec_is_pure_data(name, spec):
    text = json.dumps(dataclasses.asdict(spec))
    assert json.loads(text)["name"] == spec.name == name
    assert spec.title and spec.paper and spec.licence
    assert spec.period_input in ("none", "label", "continuous")
    assert {"rgb"} <= set(spec.outputs) <= {"rgb", "alpha", "depth"}
    assert set(spec.devices) <= {"cpu", "cuda"} and spec.devices


def test_the_spec_imports_nothing_heavy(name):
    code = (
        "import sys; from chronoscene.methods import load_spec\n"
        f"load_spec({name!r})\n"
        "heavy = {'torch', 'numba', 'open3d', 'cv2', 'matplotlib', 'pycolmap'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_preset_builds_a_frozen_config(spec):
    assert "balanced" in spec.presets and "fast" in spec.presets
    for preset in spec.presets:
        config = build_config(spec, preset=preset)
        assert isinstance(config.iterations, int) and config.iterations > 0
        assert json.loads(json.dumps(dataclasses.asdict(config)))
        with pytest.raises(dataclasses.FrozenInstanceError):
            config.iterations = 1


def test_training_lowers_a_finite_loss(trained):
    losses = np.array([report.loss for report in trained.reports])
    assert len(losses) == tiny_training.STEPS and np.isfinite(losses).all()
    assert losses[-15:].mean() < 0.8 * losses[:5].mean()


def test_short_presets_do_not_depend_on_the_unit_of_the_scene(spec, trained):
    """Millimetres instead of metres change nothing; presets named paper may do as papers did."""
    for preset in spec.presets:
        if preset.startswith("paper"):
            continue
        images = []
        for scale in (0.25, 0.25e-3):
            frame = dataclasses.replace(trained.data.training_from_world, scale=scale)
            data = dataclasses.replace(trained.data, training_from_world=frame)
            config = build_config(spec, preset=preset, overrides={"iterations": 3})
            method = import_object(spec.method)(config)
            tiny_training.seed_everything(0)
            method.setup(data, seed=0, device="cpu")
            for index in range(3):
                method.step(index, index / 3)
            images.append(method.render(data.views[0], 0.0).rgb)
        np.testing.assert_array_equal(*images, err_msg=preset)


def test_training_views_are_learned_at_their_periods(trained):
    """The error is well below that of the best constant image of each view."""
    for i in (0, len(trained.data.views) - 1):
        view, photo = trained.data.views[i], trained.data.load_image(i) / 255.0
        image = trained.method.render(view, float(view.period)).rgb
        constant = ((photo - photo.mean(axis=(0, 1))) ** 2).mean()
        assert ((image - photo) ** 2).mean() < 0.75 * constant


def test_an_equal_seed_gives_equal_bytes_in_another_process(trained, tmp_path):
    """Also with probes in between, another hash seed, and nothing written but the checkpoint."""
    folders = {name: tmp_path / name for name in ("out", "cwd", "tmp")}
    for folder in folders.values():
        folder.mkdir()
    script = Path(tiny_training.__file__)
    environment = {**os.environ, "PYTHONHASHSEED": "77", "TMPDIR": str(folders["tmp"])}
    done = subprocess.run(
        [sys.executable, str(script), trained.spec.name, str(folders["out"])],
        cwd=folders["cwd"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert contents(folders["out"]) == contents(trained.folder)
    assert not list(folders["cwd"].iterdir()) and not list(folders["tmp"].iterdir())


def test_one_and_two_threads_give_equal_bytes(trained, tmp_path):
    available = set_threads(None)
    if available < 2:
        pytest.skip("needs two processors")
    # The model of the fixture was trained with all threads there are.
    for threads in {1, 2} - {available}:
        method, reports = tiny_training.train(trained.spec, trained.data, threads=threads)
        assert reports == trained.reports
        folder = tmp_path / str(threads)
        folder.mkdir()
        method.save(folder)
        assert contents(folder) == contents(trained.folder)


def test_another_seed_gives_another_model(trained, tmp_path):
    method, _ = tiny_training.train(trained.spec, trained.data, seed=1, steps=10)
    same, _ = tiny_training.train(trained.spec, trained.data, seed=0, steps=10)
    for made, folder in ((method, tmp_path / "1"), (same, tmp_path / "0")):
        folder.mkdir()
        made.save(folder)
    first, second = (contents(tmp_path / n)["model.safetensors"] for n in ("0", "1"))
    assert first != second


def test_checkpoints_are_two_files_without_pickle(trained):
    files = contents(trained.folder)
    assert set(files) == {"model.safetensors", "model.json"}
    document = json.loads(files["model.json"])
    assert document["method"] == trained.spec.name
    assert document["num_periods"] == trained.data.num_periods
    expected = trained.data.training_from_world.to_matrix()
    np.testing.assert_array_equal(document["training_from_world"], expected)
    with safe_open(trained.folder / "model.safetensors", framework="numpy") as tensors:
        arrays = [tensors.get_tensor(key) for key in tensors.keys()]  # noqa: SIM118
    assert arrays and all(np.isfinite(a).all() for a in arrays if a.dtype.kind == "f")


def test_loading_unpickles_nothing(trained, monkeypatch):
    import pickle

    import torch

    def refuse(*args, **kwargs):
        raise AssertionError("a checkpoint must not be unpickled")

    for module, function in ((torch, "load"), (pickle, "load"), (pickle, "loads")):
        monkeypatch.setattr(module, function, refuse)
    trained.loaded()


def test_saving_again_gives_the_same_bytes(trained, tmp_path):
    trained.method.save(tmp_path)
    assert contents(tmp_path) == contents(trained.folder)


def test_a_loaded_model_renders_equal_pixels_and_saves_equal_bytes(trained, tmp_path):
    loaded = trained.loaded()
    for view in trained.data.views[::4]:
        for period in range(trained.data.num_periods):
            a = trained.method.render(view, float(period))
            b = loaded.render(view, float(period))
            for field in ("rgb", "alpha", "depth"):
                np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    assert loaded.size() == trained.method.size()
    loaded.save(tmp_path)
    assert contents(tmp_path) == contents(trained.folder)


def go_on(method, start, stop=tiny_training.STEPS):
    return [method.step(i, i / tiny_training.STEPS) for i in range(start, stop)]


@pytest.fixture(scope="module")
def interrupted(spec, trained, tmp_path_factory):
    """A method after part of the training, and what it saved to go on from."""
    if not spec.resumable:
        pytest.skip("the method cannot be resumed")
    method = import_object(spec.method)(tiny_training.small_config(spec))
    method.setup(trained.data, seed=0, device="cpu")
    go_on(method, 0, 63)
    folder = tmp_path_factory.mktemp(f"{spec.name}-training")
    method.save_training(folder)
    return method, folder


def resumed(trained, folder):
    method = import_object(trained.spec.method)(tiny_training.small_config(trained.spec))
    method.setup(trained.data, seed=0, device="cpu")
    method.load_training(folder)
    return method


def test_a_resumed_training_ends_with_the_same_bytes(trained, interrupted, tmp_path):
    folders = [tmp_path / name for name in ("model", "ours", "theirs")]
    for folder in folders:
        folder.mkdir()
    method = resumed(trained, interrupted[1])
    method.save_training(folders[1])
    assert contents(folders[1]) == contents(interrupted[1])
    assert go_on(method, 63) == trained.reports[63:]
    method.save(folders[0])
    assert contents(folders[0]) == contents(trained.folder)


def test_saving_a_training_and_a_step_that_is_not_finite_change_nothing(
    trained, interrupted, tmp_path, monkeypatch
):
    """The step counts as a drawn view, and nothing else of the training is different."""
    from chronoscene.training.losses import _PhotometricLoss

    method = resumed(trained, interrupted[1])
    backward = _PhotometricLoss.backward

    def poisoned(ctx, *grads):
        gradient, *others = backward(ctx, *grads)
        return gradient * np.inf, *others

    with monkeypatch.context() as patch:
        patch.setattr(_PhotometricLoss, "backward", staticmethod(poisoned))
        assert method.step(63, 63 / tiny_training.STEPS).skipped == "not finite"
    method.trainer.sampler.drawn -= 1
    method.save_training(tmp_path)
    before = json.loads((interrupted[1] / "training.json").read_text())
    after = json.loads((tmp_path / "training.json").read_text())
    assert after["tensors_sha256"] == before["tensors_sha256"]
    assert method.step(63, 63 / tiny_training.STEPS) == trained.reports[63]


@pytest.mark.parametrize("file", ["training.json", "training.safetensors"])
def test_a_damaged_training_is_refused(trained, interrupted, tmp_path, file):
    for name, content in contents(interrupted[1]).items():
        (tmp_path / name).write_bytes(content[:-9] if name == file else content)
    with pytest.raises(CheckpointError, match=file.replace(".", r"\.")):
        resumed(trained, tmp_path)


@pytest.mark.parametrize("damage", ["missing", "cut", "edited", "empty"])
def test_damaged_checkpoints_are_refused(trained, tmp_path, damage):
    files = contents(trained.folder)
    data = bytearray(files["model.safetensors"])
    if damage == "edited":
        data[-1] ^= 1
    for file, content in files.items():
        (tmp_path / file).write_bytes(content)
    changed = {"cut": data[: len(data) // 2], "edited": data, "empty": b""}.get(damage)
    path = tmp_path / "model.safetensors"
    path.unlink() if changed is None else path.write_bytes(changed)
    method = import_object(trained.spec.method)(tiny_training.small_config(trained.spec))
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        method.load(tmp_path, device="cpu")


@pytest.mark.parametrize("size", [(1, 1), (17, 9), (40, 30), (101, 77)])
def test_any_size_renders(trained, size):
    view = resized(trained.data.views[0], *size)
    rgb = trained.loaded().render(view, 0.0).rgb
    assert rgb.shape == (size[1], size[0], 3) and rgb.dtype == np.float32
    assert np.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1


def test_a_larger_image_shows_the_same(trained):
    """Doubling the size and averaging gives nearly the same picture."""
    view = trained.data.views[1]
    small = trained.method.render(view, 0.0).rgb
    large = trained.method.render(resized(view, 2 * view.width, 2 * view.height), 0.0).rgb
    averaged = large.reshape(view.height, 2, view.width, 2, 3).mean(axis=(1, 3))
    assert np.abs(averaged - small).mean() < 0.05


def test_declared_outputs_are_there(trained):
    view = trained.data.views[0]
    prediction = trained.method.render(view, 0.0)
    for field in ("alpha", "depth"):
        value = getattr(prediction, field)
        if field not in trained.spec.outputs:
            continue
        assert value.shape == (view.height, view.width) and value.dtype == np.float32
        assert np.isfinite(value).all() and value.min() >= 0
    if prediction.alpha is not None:
        assert prediction.alpha.max() <= 1 and prediction.alpha.max() > 0.5
    if prediction.depth is not None:
        # The balls lie within 0.7 of the origin, and the camera at distance 1 from it.
        middle = prediction.depth[view.height // 2, view.width // 2]
        assert 0.2 < middle < 1.8
        assert (prediction.depth[prediction.alpha == 0] == 0).all()


def test_a_view_of_nothing_renders(trained):
    view = trained.data.views[0]
    away = view.cam_from_world.copy()
    away[:3, 3] += [0.0, 0.0, -50.0]  # everything far behind
    rgb = trained.method.render(View(view.K, view.width, view.height, away), 0.0).rgb
    np.testing.assert_allclose(rgb, np.broadcast_to(trained.data.background, rgb.shape), atol=1e-6)


def test_periods_matter_where_they_are_taken(trained):
    if trained.spec.period_input == "none":
        pytest.skip("the method takes no period")
    view = trained.data.views[0]
    images = [trained.method.render(view, float(p)).rgb for p in range(3)]
    assert np.abs(images[0] - images[1]).mean() > 1e-4
    assert np.abs(images[1] - images[2]).mean() > 1e-4


def test_fractional_periods_lie_between(trained):
    if trained.spec.period_input != "continuous":
        pytest.skip("the method takes whole periods only")
    view = trained.data.views[0]
    first, half, second = (trained.method.render(view, p).rgb for p in (0.0, 0.5, 1.0))
    assert np.isfinite(half).all() and half.min() >= 0 and half.max() <= 1
    assert np.abs(half - first).mean() > 1e-5 and np.abs(half - second).mean() > 1e-5
    near = trained.method.render(view, 1e-4).rgb
    assert np.abs(near - first).mean() < 0.01


def test_size_counts_what_is_stored(trained):
    size = trained.method.size()
    assert size.primitives == trained.reports[-1].primitives > 0
    with safe_open(trained.folder / "model.safetensors", framework="numpy") as tensors:
        stored = sum(int(np.prod(tensors.get_slice(k).get_shape())) for k in tensors.keys())  # noqa: SIM118
    assert size.parameters == stored


def test_the_training_set_is_left_alone(trained):
    fresh = tiny_training.make_training_set(trained.data.num_periods)
    for field in ("points", "colors", "point_periods", "background"):
        np.testing.assert_array_equal(getattr(trained.data, field), getattr(fresh, field))
    for i, (a, b) in enumerate(zip(trained.data.views, fresh.views, strict=True)):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(trained.data.load_image(i), fresh.load_image(i))


def test_one_period_is_enough(spec):
    data = tiny_training.make_training_set(1)
    method, reports = tiny_training.train(spec, data, steps=5)
    assert all(np.isfinite(report.loss) for report in reports)
    assert np.isfinite(method.render(data.views[0], 0.0).rgb).all()


def hidden(data, seed):
    """The set with a rectangle of noise in every photo, which the masks ignore as they ignore one
    photo altogether."""
    mask = np.ones((tiny_training.HEIGHT, tiny_training.WIDTH), bool)
    mask[8:20, 5:18] = False
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (len(data.views), *mask.shape, 3), np.uint8)
    masks = [mask] * (len(data.views) - 1) + [np.zeros_like(mask)]
    return dataclasses.replace(
        data,
        load_image=lambda i: np.where(masks[i][..., None], data.load_image(i), noise[i]),
        load_mask=lambda i: masks[i],
    )


def test_what_masks_ignore_does_not_change_the_model(trained, tmp_path):
    models = []
    for seed in (0, 1):
        data = hidden(trained.data, seed)
        method, reports = tiny_training.train(trained.spec, data)
        (tmp_path / str(seed)).mkdir()
        method.save(tmp_path / str(seed))
        models.append((contents(tmp_path / str(seed)), reports))
    assert models[0] == models[1]
    empty = sum(report.skipped == "empty" for report in models[0][1])
    assert empty == tiny_training.STEPS // len(data.views)
    errors = [
        np.mean([squared_error(m, data, trained.data, i) for i in range(len(data.views) - 1)])
        for m in (trained.method, method)
    ]
    assert errors[1] < 1.15 * errors[0]


def squared_error(method, masked, clean, index):
    """Of a training view, where its mask lets it count."""
    view = clean.views[index]
    image = method.render(view, float(view.period)).rgb
    difference = image - clean.load_image(index) / 255.0
    return (difference[masked.load_mask(index)] ** 2).mean()
