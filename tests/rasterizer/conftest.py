"""Scenes for the rasterizer's tests, and the comparison of a backend with the reference."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from chronoscene.rasterizer import Rasterization, rasterize, reference
from chronoscene.rasterizer.constants import NEAR_PLANE

NAMES = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class SmallScene:
    """Arguments of `rasterize` as float32 arrays; the reference sees the same numbers."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    width: int
    height: int
    backgrounds: np.ndarray | None = None
    render_depth: bool = False
    options: tuple[tuple[str, float], ...] = ()

    def with_(self, **changes: Any) -> SmallScene:
        return replace(self, **changes)

    def tensors(self, dtype: torch.dtype) -> dict[str, torch.Tensor]:
        return {
            name: torch.tensor(getattr(self, name)).to(dtype).requires_grad_() for name in NAMES
        }

    def render(
        self, backend: str, dtype: torch.dtype = torch.float32, device: str = "cpu"
    ) -> tuple[Rasterization, dict[str, torch.Tensor]]:
        """The images, and the inputs whose gradients a backward pass fills."""
        inputs = self.tensors(dtype)
        if self.backgrounds is not None:
            inputs["backgrounds"] = torch.tensor(self.backgrounds).to(dtype).requires_grad_()
        moved = {name: x.to(device) for name, x in inputs.items()}
        background = moved.pop("backgrounds", None)
        function: Callable[..., Rasterization] = rasterize
        result = function(
            **moved,
            viewmats=torch.tensor(self.viewmats).to(device, dtype),
            Ks=torch.tensor(self.Ks).to(device, dtype),
            width=self.width,
            height=self.height,
            backgrounds=background,
            render_depth=self.render_depth,
            backend=backend,
            check_finite=False,
            **dict(self.options),
        )
        return result, inputs


@contextmanager
def _thresholds(**values: float) -> Iterator[None]:
    """The reference with other constants."""
    before = {name: getattr(reference, name) for name in values}
    try:
        for name, value in values.items():
            setattr(reference, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(reference, name, value)


def _steady_pixels(scene: SmallScene, band: float) -> torch.Tensor:
    """Pixels whose colour does not depend on a threshold being passed by a hair. [C, H, W, 1]

    The image jumps where alpha crosses 1/255 and where the transmittance crosses its end; rounding
    decides on which side such a pixel falls. They are found by moving the thresholds by more than
    rounding can.
    """
    with torch.no_grad():
        base = scene.render("reference", torch.float64)[0]
        steady = torch.ones_like(base.alphas, dtype=torch.bool)
        for name in ("ALPHA_MIN", "TRANSMITTANCE_MIN"):
            for factor in (1 - band, 1 + band):
                with _thresholds(**{name: getattr(reference, name) * factor}):
                    other = scene.render("reference", torch.float64)[0]
                moved = (other.image != base.image).any(-1, keepdim=True)
                steady &= ~(moved | (other.alphas != base.alphas))
    return steady


def _well_posed(scene: SmallScene) -> bool:
    """Whether float32 and float64 see the same Gaussians in the same order: no two depths are so
    close that rounding may swap them, no depth is at a plane, no opacity at the threshold."""
    if (np.abs(255 * scene.opacities - 1) < 1e-5).any():
        return False
    centres = np.concatenate([scene.means, np.ones_like(scene.means[:, :1])], axis=1)
    for viewmat in scene.viewmats.astype(np.float64):
        z = np.sort((centres.astype(np.float64) @ viewmat.T)[:, 2])
        gaps = np.diff(z)
        if ((gaps < 1e-5) & (gaps > 0)).any() or (np.abs(z - NEAR_PLANE) < 1e-5).any():
            return False
    return True


@dataclass
class Comparison:
    """A backend beside the reference; arrays by name, float64."""

    scene: SmallScene
    got: dict[str, np.ndarray]
    expected: dict[str, np.ndarray]
    steady: np.ndarray

    def error(self, name: str, floor: float) -> float:
        """Largest difference, relative to the largest magnitude."""
        got, expected = self.got[name], self.expected[name]
        if got.size == 0:
            return 0.0
        assert np.isfinite(got).all(), name
        scale = max(floor, np.abs(expected).max())
        if name == "grad quats":
            scale = max(scale, self._turning().max())
        return float(np.abs(got - expected).max() / scale)

    def _turning(self) -> np.ndarray:
        """Size of the terms whose difference is the gradient of a rotation. [N]

        They cancel altogether for a sphere; what is left is their rounding.
        """
        stretching = np.abs(self.expected["grad scales"] * self.scene.scales).sum(-1)
        length = np.linalg.norm(self.scene.quats.astype(np.float64), axis=-1)
        return np.where(length > 0, stretching / np.maximum(length, 1e-37), 0.0)


def _run(
    scene: SmallScene, backend: str, dtype: torch.dtype, device: str, steady: torch.Tensor
) -> dict[str, np.ndarray]:
    """Outputs and gradients of a loss that weighs every steady pixel at random."""
    result, inputs = scene.render(backend, dtype, device)
    generator = torch.Generator().manual_seed(0)
    outputs = {"image": result.image, "alphas": result.alphas}
    if result.depths is not None:
        outputs["depths"] = result.depths
    loss = torch.zeros((), dtype=dtype, device=device)
    weights = steady.to(dtype)
    if result.depths is not None:  # the depth of what is hardly there is not well defined
        weights = weights * (result.alphas.detach().cpu() > 0.1)
    for output in outputs.values():
        draw = torch.randn(output.shape, generator=generator).to(dtype)
        loss = loss + (output * (draw * weights).to(device)).sum()
    loss.backward()
    arrays = {name: (x.detach().cpu() * weights).double().numpy() for name, x in outputs.items()}
    arrays["means2d"] = result.info.means2d.detach().cpu().double().numpy()
    arrays["radii"] = result.info.radii.cpu().double().numpy()
    arrays["z"] = result.info.depths.cpu().double().numpy()
    assert result.info.means2d.grad is not None
    arrays["grad means2d"] = result.info.means2d.grad.cpu().double().numpy()
    for name, x in inputs.items():
        assert x.grad is not None
        arrays["grad " + name] = x.grad.double().numpy()
    return arrays


def compare(scene: SmallScene, backend: str = "cpu", device: str = "cpu") -> Comparison:
    """Run a backend in float32 and the reference in float64 on the same numbers."""
    steady = _steady_pixels(scene, 1e-4)
    return Comparison(
        scene,
        got=_run(scene, backend, torch.float32, device, steady),
        expected=_run(scene, "reference", torch.float64, "cpu", steady),
        steady=steady.numpy(),
    )


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(
        float(np.float32(low)), float(np.float32(high)), width=32, allow_subnormal=False
    )


@st.composite
def scenes(draw: st.DrawFn, max_count: int = 20) -> SmallScene:
    """Small scenes: behind, beside and across the camera, any principal point, odd sizes."""
    n = draw(st.integers(0, max_count))
    channels, cameras = draw(st.sampled_from([3, 3, 3, 1, 4])), draw(st.sampled_from([1, 1, 2]))
    width, height = draw(st.integers(1, 45)), draw(st.integers(1, 45))

    def array(shape: tuple[int, ...], low: float, high: float) -> np.ndarray:
        return draw(hnp.arrays(np.float32, shape, elements=_floats(low, high)))

    viewmats = np.tile(np.eye(4, dtype=np.float32), (cameras, 1, 1))
    viewmats[:, :3, 3] = array((cameras, 3), -1.0, 1.0)
    viewmats[:, 2, 3] += 2.0
    Ks = np.zeros((cameras, 3, 3), np.float32)
    Ks[:, 0, 0], Ks[:, 1, 1] = draw(_floats(5.0, 80.0)), draw(_floats(5.0, 80.0))
    Ks[:, 0, 2], Ks[:, 1, 2] = draw(_floats(-10.0, 55.0)), draw(_floats(-10.0, 55.0))
    Ks[:, 2, 2] = 1.0
    return SmallScene(
        means=array((n, 3), -2.5, 2.5),
        quats=array((n, 4), -1.0, 1.0),
        scales=np.exp2(array((n, 3), -9.0, 0.0)),
        opacities=array((n,), -0.2, 1.1),
        colors=array((n, channels), -0.5, 1.5),
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
        backgrounds=array((cameras, channels), 0.0, 1.0) if draw(st.booleans()) else None,
        render_depth=draw(st.booleans()),
    )


def random_scene(count: int, width: int, height: int, seed: int = 0, **changes: Any) -> SmallScene:
    """A scene of Gaussians around the optical axis at distances 2 to 6."""
    g = np.random.default_rng(seed)

    def f(x: Any) -> np.ndarray:
        return np.asarray(x, np.float32)

    K = np.array([[1.1 * width, 0, 0.45 * width], [0, 1.2 * width, 0.55 * height], [0, 0, 1]])
    scene = SmallScene(
        means=f(g.uniform([-2, -2, 2], [2, 2, 6], (count, 3))),
        quats=f(g.normal(size=(count, 4))),
        scales=f(np.exp(g.uniform(-4.5, -1.0, (count, 3)))),
        opacities=f(g.uniform(0.05, 0.95, count)),
        colors=f(g.uniform(0, 1, (count, 3))),
        viewmats=f(np.eye(4)[None]),
        Ks=f(K[None]),
        width=width,
        height=height,
    )
    return scene.with_(**changes)


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parent / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def tolerances() -> ModuleType:
    return _load("tolerances")


@pytest.fixture(scope="session")
def tools() -> SimpleNamespace:
    """What the test files share."""
    return SimpleNamespace(
        SmallScene=SmallScene,
        compare=compare,
        random_scene=random_scene,
        scenes=scenes,
        well_posed=_well_posed,
        steady_pixels=_steady_pixels,
        thresholds=_thresholds,
    )


@pytest.fixture(scope="session")
def check_agreement(tolerances: ModuleType) -> Callable[..., Comparison]:
    """Assert that a backend agrees with the reference on a scene."""

    def check(scene: SmallScene, backend: str = "cpu", device: str = "cpu") -> Comparison:
        comparison = compare(scene, backend, device)
        limits = {
            "image": tolerances.IMAGE,
            "alphas": tolerances.ALPHA,
            "depths": tolerances.DEPTH,
            "means2d": tolerances.MEANS2D,
            "z": tolerances.MEANS2D,
        }
        for name in comparison.expected:
            if name != "radii":
                error = comparison.error(name, tolerances.FLOOR)
                assert error <= limits.get(name, tolerances.GRADIENT), (name, error)
        radii = comparison.got["radii"] - comparison.expected["radii"]
        assert np.abs(radii).max(initial=0) <= 1  # rounded up: a hair above an integer is one more
        return comparison

    return check
