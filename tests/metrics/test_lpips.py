"""LPIPS against the authors' package and against its formula, with random weights."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from fresh_process import loaded_by
from safetensors.torch import save_file

from chronoscene.errors import MetricUnavailableError, ShapeError
from chronoscene.metrics.lpips import Lpips, unit_length
from chronoscene.metrics.lpips_weights import ENVIRONMENT, candidate_files, load_weights
from chronoscene.metrics.registry import make_scorers

# lpips 0.1.4 with torchvision 0.28.0 and torch 2.13.0 on a CPU, fed with the weights and images of
# the fixture `random_lpips`: inputs scaled to [-1, 1], and inputs left in [0, 1].
GOLDEN = {"lpips_vgg": 0.05493166670203209, "lpips_vgg_3dgs": 0.014885136857628822}
# The same backbone with the package's own heads 0.1.
GOLDEN_REAL_HEADS = {"lpips_vgg": 0.010795742273330688, "lpips_vgg_3dgs": 0.0029044197872281075}
# Two float32 implementations add in different orders; seen: 6e-8 relative.
RELATIVE = 1e-5


@pytest.fixture
def folder(random_lpips, no_weights):
    backbone, heads, _, _ = random_lpips
    folder = no_weights / "weights"
    folder.mkdir()
    torch.save(backbone, folder / "vgg16-397923af.pth")
    torch.save(heads, folder / "vgg.pth")
    return folder


@pytest.mark.parametrize("name", list(GOLDEN))
def test_values_are_those_of_the_authors_package(name, folder, random_lpips):
    _, _, image, other = random_lpips
    scorers = make_scorers([name], lpips_weights=folder)
    assert scorers.functions[name](image, other) == pytest.approx(GOLDEN[name], rel=RELATIVE)
    assert scorers.functions[name](image, image) == 0.0
    half = np.arange(image.shape[0] * image.shape[1]).reshape(image.shape[:2]) % 2 == 0
    value = scorers.functions[name](image, other, half)
    assert value == pytest.approx(GOLDEN[name] / half.mean(), rel=RELATIVE)


@pytest.mark.skipif(find_spec("lpips") is None, reason="the lpips package is not installed")
@pytest.mark.parametrize("name", list(GOLDEN_REAL_HEADS))
def test_values_with_the_real_heads(name, random_lpips, tmp_path):
    backbone, _, image, other = random_lpips
    torch.save(backbone, tmp_path / "vgg16.pth")
    scorers = make_scorers([name], lpips_weights=tmp_path)
    value = scorers.functions[name](image, other)
    assert value == pytest.approx(GOLDEN_REAL_HEADS[name], rel=RELATIVE)


def test_formula_step_by_step(folder, random_lpips):
    """The published formula in float64 numpy on the activations of the network."""
    backbone, heads, image, other = random_lpips
    metric = Lpips(load_weights(folder))
    total = 0.0
    x, y = (
        2 * torch.from_numpy(i / 255.0).float().permute(2, 0, 1)[None] - 1 for i in (image, other)
    )
    first = torch.nn.functional.conv2d(
        (x - torch.tensor([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1))
        / torch.tensor([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1),
        backbone["features.0.weight"],
        backbone["features.0.bias"],
        padding=1,
    ).relu()
    second = torch.nn.functional.conv2d(
        first, backbone["features.2.weight"], backbone["features.2.bias"], padding=1
    ).relu()
    assert torch.equal(metric.features(x)[0], second)
    for i, (f, g) in enumerate(zip(metric.features(x), metric.features(y), strict=True)):
        f, g = f[0].double().numpy(), g[0].double().numpy()
        f = f / (np.sqrt((f**2).sum(0, keepdims=True)) + 1e-10)
        g = g / (np.sqrt((g**2).sum(0, keepdims=True)) + 1e-10)
        weight = heads[f"lin{i}.model.1.weight"].double().numpy().reshape(-1, 1, 1)
        total += (weight * (f - g) ** 2).sum(0).mean()
    assert metric.vgg(image, other) == pytest.approx(total, rel=RELATIVE)


def test_taps_have_the_channels_and_sizes_of_vgg16(folder):
    shapes = [
        tuple(f.shape[1:]) for f in Lpips(load_weights(folder)).features(torch.zeros(1, 3, 33, 48))
    ]
    assert shapes == [(64, 33, 48), (128, 16, 24), (256, 8, 12), (512, 4, 6), (512, 2, 3)]


def test_features_of_zero_length_stay_finite():
    assert torch.equal(unit_length(torch.zeros(1, 4, 2, 2)), torch.zeros(1, 4, 2, 2))


def test_one_safetensors_file_with_both_parts(folder, random_lpips):
    backbone, heads, image, other = random_lpips
    names = {f"net.slice{n}.{i}" for n, i in ((1, 0), (1, 2), (2, 5), (2, 7))}
    combined = {}
    for name, tensor in backbone.items():
        index = int(name.split(".")[1])
        number = 1 + sum(index > last for last in (2, 7, 14, 21))
        combined[f"net.slice{number}.{index}.{name.split('.')[2]}"] = tensor
    assert names <= {name.rsplit(".", 1)[0] for name in combined}
    save_file({**combined, **heads}, folder / "lpips.safetensors")
    metric = Lpips(load_weights(folder / "lpips.safetensors"))
    assert metric.vgg(image, other) == pytest.approx(GOLDEN["lpips_vgg"], rel=RELATIVE)


def test_environment_variable_and_hub_cache(folder, random_lpips, monkeypatch):
    backbone, _, _, _ = random_lpips
    monkeypatch.setenv(ENVIRONMENT, str(folder))
    assert load_weights().files == (folder / "vgg16-397923af.pth", folder / "vgg.pth")
    cache = folder.parent / "torch-home" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    torch.save(backbone, cache / "vgg16-397923af.pth")
    monkeypatch.setenv(ENVIRONMENT, str(folder / "vgg.pth"))
    assert load_weights().files == (cache / "vgg16-397923af.pth", folder / "vgg.pth")
    (folder / "vgg.pth").rename(cache / "lpips-vgg-v0.1.pth")
    monkeypatch.delenv(ENVIRONMENT)
    assert load_weights().files == (cache / "vgg16-397923af.pth", cache / "lpips-vgg-v0.1.pth")


def test_heads_inside_an_installed_package_are_found_without_importing_it(no_weights, monkeypatch):
    monkeypatch.undo()
    package = no_weights / "site" / "lpips"
    (package / "weights" / "v0.1").mkdir(parents=True)
    (package / "weights" / "v0.1" / "vgg.pth").write_bytes(b"x")
    (package / "__init__.py").write_text("raise RuntimeError('must not be imported')")
    monkeypatch.syspath_prepend(no_weights / "site")
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    assert package / "weights" / "v0.1" / "vgg.pth" in list(candidate_files())


def test_without_weights_the_reason_is_one_short_line(no_weights):
    scorers = make_scorers(["psnr", "lpips_vgg", "lpips_vgg_3dgs"])
    assert list(scorers.functions) == ["psnr"]
    reason = "LPIPS weights: no file; run chronoscene download lpips-weights"
    assert scorers.skipped == {"lpips_vgg": reason, "lpips_vgg_3dgs": reason}


def test_without_weights_torch_is_not_imported(no_weights):
    code = (
        "from chronoscene.metrics.registry import make_scorers\n"
        "assert make_scorers().skipped.keys() == {'lpips_vgg', 'lpips_vgg_3dgs'}"
    )
    assert "torch" not in loaded_by(code)


def test_weights_named_by_the_user_must_work(no_weights):
    with pytest.raises(MetricUnavailableError, match="nothing at"):
        make_scorers(["lpips_vgg"], lpips_weights=no_weights / "absent")
    assert "lpips_vgg" not in make_scorers(["psnr"], lpips_weights=no_weights / "absent").skipped


def test_a_missing_part_is_named(folder):
    (folder / "vgg.pth").unlink()
    with pytest.raises(MetricUnavailableError, match="expected LPIPS heads, found neither in"):
        load_weights(folder)


def test_weights_of_another_shape_are_refused(folder, random_lpips):
    _, heads, _, _ = random_lpips
    torch.save({**heads, "lin4.model.1.weight": torch.ones(1, 7, 1, 1)}, folder / "vgg.pth")
    with pytest.raises(MetricUnavailableError, match=r"\(1, 7, 1, 1\) for lin4"):
        load_weights(folder)


class Trap:
    """Pickles to a call; loading must not make it."""

    def __reduce__(self):
        return (open, ("trap-was-sprung", "w"))


def test_pickled_code_is_never_run(folder, monkeypatch):
    monkeypatch.chdir(folder.parent)
    torch.save({"features.0.weight": Trap()}, folder / "a.pth")
    with pytest.raises(MetricUnavailableError, match=r"a\.pth: expected weights"):
        load_weights(folder)
    assert not (folder.parent / "trap-was-sprung").exists()


def test_tiny_images_are_refused(folder):
    tiny = np.zeros((15, 40, 3), np.uint8)
    with pytest.raises(ShapeError, match="at least 16 x 16"):
        Lpips(load_weights(folder)).vgg(tiny, tiny)
