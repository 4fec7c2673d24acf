"""Messages for wrong arguments, and the contract of the outputs."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import chronoscene
from chronoscene.errors import BackendError, ShapeError
from chronoscene.kernels.runtime import GSPLAT_ALPHA_MAX
from chronoscene.rasterizer import gsplat_backend, rasterize


@pytest.fixture
def arguments() -> dict[str, Any]:
    g = torch.Generator().manual_seed(0)
    return {
        "means": torch.randn(5, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0]),
        "quats": torch.randn(5, 4, generator=g),
        "scales": torch.rand(5, 3, generator=g),
        "opacities": torch.rand(5, generator=g),
        "colors": torch.rand(5, 3, generator=g),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0, 6], [0, 20, 5], [0, 0, 1]]]),
        "width": 12,
        "height": 10,
    }


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.zeros(5, 2), r"means: expected shape \[5, 3\], found \[5, 2\]"),
        ("quats", torch.zeros(4, 4), r"quats: expected shape \[5, 4\], found \[4, 4\]"),
        ("scales", torch.zeros(5), r"scales: expected shape \[5, 3\], found \[5\]"),
        ("opacities", torch.zeros(5, 1), r"opacities: expected shape \[5\], found \[5, 1\]"),
        ("colors", torch.zeros(5), r"colors: expected shape \[5, \*\], found \[5\]"),
        ("viewmats", torch.eye(4), r"viewmats: expected shape \[4, 4, 4\], found \[4, 4\]"),
        ("viewmats", torch.zeros(0, 4, 4), r"viewmats: expected at least one camera, found none"),
        ("Ks", torch.eye(3), r"Ks: expected shape \[1, 3, 3\], found \[3, 3\]"),
        ("backgrounds", torch.zeros(3), r"backgrounds: expected shape \[1, 3\], found \[3\]"),
        ("means", torch.zeros(5, 3, dtype=torch.int64), r"means: expected floating point"),
        ("width", 0, r"width: expected 1 to 65536 whole pixels, found 0"),
        ("width", 12.5, r"width: expected 1 to 65536 whole pixels, found 12.5"),
        ("height", 65537, r"height: expected 1 to 65536 whole pixels, found 65537"),
        ("near_plane", 0.0, r"expected 1e-18 <= near_plane < far_plane <= 1e\+18, found 0\.0"),
        ("near_plane", float("nan"), r"expected 1e-18 <= near_plane < far_plane .* found nan"),
        ("far_plane", float("inf"), r"expected 1e-18 <= near_plane < far_plane .* inf"),
        ("eps2d", -1.0, r"eps2d: expected 0 to 1e\+15, found -1\.0"),
        ("eps2d", float("nan"), r"eps2d: expected 0 to 1e\+15, found nan"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], name: str, value: Any, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        rasterize(**{**arguments, name: value}, backend="reference")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize(
    "name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"]
)
def test_numbers_that_are_not_finite_are_named(
    arguments: dict[str, Any], name: str, bad: float
) -> None:
    array = arguments[name].clone()
    index = tuple(n - 1 for n in array.shape)
    array[index] = bad
    place = rf"{name}\[{', '.join(map(str, index))}\]: expected a finite number"
    with pytest.raises(ShapeError, match=place):
        rasterize(**{**arguments, name: array})


def test_large_finite_numbers_are_not_refused(arguments: dict[str, Any]) -> None:
    arguments["scales"] = torch.full((5, 3), 3e38)
    rasterize(**arguments)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_without_the_check_bad_gaussians_are_culled(
    arguments: dict[str, Any], name: str, backend: str
) -> None:
    for channels in (3, 2):
        inputs = {**arguments, "colors": arguments["colors"][:, :channels].clone()}
        good = {k: v[1:] for k, v in inputs.items() if torch.is_tensor(v) and len(v) == 5}
        expected = rasterize(**{**inputs, **good}, backend=backend).image
        bad = inputs[name].clone()
        bad[0] = float("nan")
        bad.requires_grad_()
        result = rasterize(**{**inputs, name: bad}, backend=backend, check_finite=False)
        assert torch.equal(result.image, expected)
        result.image.sum().backward()
        assert bad.grad is not None and torch.isfinite(bad.grad).all()
        assert bad.grad[0].abs().sum() == 0


def test_a_mirrored_intrinsic_matrix_is_refused(arguments: dict[str, Any]) -> None:
    arguments["Ks"] = arguments["Ks"] * torch.tensor([-1.0, 1.0, 1.0])
    with pytest.raises(ShapeError, match=r"Ks\[0\]: expected positive focal lengths"):
        rasterize(**arguments)


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (2, 0), (2, 1), (2, 2)])
def test_intrinsics_that_would_be_ignored_are_refused(
    arguments: dict[str, Any], place: tuple[int, int]
) -> None:
    arguments["Ks"] = arguments["Ks"].clone()
    arguments["Ks"][0][place] += 0.5
    with pytest.raises(ShapeError, match=r"Ks\[0\]: expected \[\[fx, 0, cx\]"):
        rasterize(**arguments)


def test_unknown_backend(arguments: dict[str, Any]) -> None:
    with pytest.raises(BackendError, match=r"expected one of auto, cpu, cuda, reference"):
        rasterize(**arguments, backend="cdua")


@pytest.fixture
def other_gsplat(
    monkeypatch: pytest.MonkeyPatch, set_gsplat: Callable[..., None]
) -> Iterator[Callable[..., None]]:
    """Pretends that another gsplat is installed: its version, its module, its kernels."""

    def pretend(version: str | None, module: Any = None, kernels: Any = None) -> None:
        modules = {"gsplat": module, "gsplat.cuda._backend": SimpleNamespace(_C=kernels)}
        monkeypatch.setattr(gsplat_backend, "import_module", modules.__getitem__)
        set_gsplat(version)
        gsplat_backend._load.cache_clear()

    yield pretend
    gsplat_backend._load.cache_clear()


def test_cuda_without_gsplat_or_gpu_says_what_to_install(
    arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch, other_gsplat: Callable[..., None]
) -> None:
    other_gsplat(None)
    with pytest.raises(BackendError, match=r"found none; pip install 'chronoscene\[cuda\]'"):
        rasterize(**arguments, backend="cuda")
    for version in ("1.4.0", "1.7.0"):
        other_gsplat(version)
        with pytest.raises(BackendError, match=rf"expected version 1.5 or 1.6, found {version}"):
            rasterize(**arguments, backend="cuda")
    other_gsplat("1.5.3")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BackendError, match=r"expected an NVIDIA GPU"):
        rasterize(**arguments, backend="cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(BackendError, match=r"expected tensors on a GPU, found cpu"):
        rasterize(**arguments, backend="cuda")


def test_versions_in_the_packaging_are_those_that_were_looked_at() -> None:
    path = Path(chronoscene.__file__).parents[1] / "pyproject.toml"
    (extra,) = tomllib.loads(path.read_text())["project"]["optional-dependencies"]["cuda"]
    minors = [int(version.removeprefix("1.")) for version in GSPLAT_ALPHA_MAX]
    assert extra == f"gsplat>=1.{min(minors)},<1.{max(minors) + 1}"


def test_cuda_backend_speaks_gsplats_language(
    arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names of arguments, shapes and culling, with a stand-in for gsplat on the CPU."""
    seen: dict[str, Any] = {}

    def rasterization(means: Any, quats: Any, *rest: Any, **options: Any) -> Any:
        seen.update(options, means=means, quats=quats, opacities=rest[1])
        n, depth = len(means), options["render_mode"] == "RGB+ED"
        means2d = means[None, :, :2] * 2
        meta = {
            "means2d": means2d,
            "radii": torch.ones(1, n, 2, dtype=torch.int32),
            "depths": means[None, :, 2],
        }
        image = means2d.sum() * torch.ones(1, 10, 12, 3 + depth)
        return image, torch.zeros(1, 10, 12, 1), meta

    gsplat = SimpleNamespace(rasterization=rasterization)
    monkeypatch.setattr(gsplat_backend, "_load", lambda device: gsplat)
    arguments["opacities"] = torch.tensor([0.5, -0.5, float("nan"), 0.5, 0.5])
    arguments["quats"][3] = 0
    arguments["means"].requires_grad_()
    result = rasterize(**arguments, backend="cuda", render_depth=True, check_finite=False)
    assert seen["packed"] is False and seen["render_mode"] == "RGB+ED"
    assert seen["rasterize_mode"] == "classic" and seen["eps2d"] == 0.3
    assert seen["opacities"].tolist() == [0.5, 0, 0, 0, 0.5]
    assert seen["quats"][3].tolist() == [1, 0, 0, 0]
    assert result.image.shape == (1, 10, 12, 3) and result.depths is not None
    assert result.depths.shape == (1, 10, 12, 1)
    assert result.info.radii[0, :, 0].tolist() == [1, 0, 0, 0, 1]
    result.image.sum().backward()
    assert result.info.means2d.grad is not None
    rasterize(**arguments, backend="cuda", antialiased=True, check_finite=False)
    assert seen["rasterize_mode"] == "antialiased"


BUILD_OUTPUT = """Error building extension 'gsplat_cuda': [1/30] nvcc -O3 Projection.cu
Projection.cu(7): error: identifier "make_float9" is undefined
ninja: build stopped: subcommand failed."""


@pytest.mark.parametrize(
    ("failure", "found"),
    [
        (None, "no CUDA toolkit"),
        (ImportError("gsplat_cuda.so"), "gsplat_cuda.so"),
        (RuntimeError(BUILD_OUTPUT), 'error: identifier "make_float9" is undefined'),
        (RuntimeError("Ninja is required to load C++ extensions"), "Ninja is required"),
    ],
)
def test_kernels_that_cannot_be_built_are_one_error(
    monkeypatch: pytest.MonkeyPatch,
    other_gsplat: Callable[..., None],
    failure: Exception | None,
    found: str,
) -> None:
    """Both first failures: without nvcc the kernels are None, or else the build ends."""
    other_gsplat("1.5.3")

    def load(name: str) -> Any:
        if failure is not None:
            raise failure
        return SimpleNamespace(_C=None)

    monkeypatch.setattr(gsplat_backend, "import_module", load)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(BackendError, match=r"install the CUDA toolkit.*nvcc") as error:
        gsplat_backend._load(torch.device("cuda"))
    assert found in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_shapes_and_types_of_the_result(arguments: dict[str, Any], backend: str) -> None:
    arguments["means"].requires_grad_()
    result = rasterize(**arguments, backend=backend, render_depth=True)
    assert result.image.shape == (1, 10, 12, 3) and result.alphas.shape == (1, 10, 12, 1)
    assert result.depths is not None and result.depths.shape == (1, 10, 12, 1)
    assert result.info.means2d.shape == (1, 5, 2) and result.info.depths.shape == (1, 5)
    assert result.info.radii.shape == (1, 5, 2) and result.info.radii.dtype == torch.int32
    assert result.info.means2d.is_leaf and not result.info.depths.requires_grad
    assert rasterize(**arguments, backend=backend).depths is None
