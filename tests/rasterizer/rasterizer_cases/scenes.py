"""Scenes for the rasterizer's tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from chronoscene.rasterizer import Rasterization, rasterize
from chronoscene.rasterizer.constants import NEAR_PLANE

ANTIALIASED = (("antialiased", True),)
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
        self,
        backend: str,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        check_finite: bool = False,
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
            check_finite=check_finite,
            **dict(self.options),
        )
        return result, inputs


def well_posed(scene: SmallScene) -> bool:
    """Return True if float32 and float64 see the same Gaussians in order: no two depths are so
    close that rounding may swap them, no depth is at a plane, no opacity at the threshold."""
    if (np.abs(255 * scene.opacities - 1) < 1e-5).any():
        return False
    centres = np.concatenate([scene.means, np.ones_like(scene.means[:, :1])], axis=1)
    for viewmat in scene.viewmats.astype(np.float64):
        z = np.sort((centres.astype(np.float64) @ viewmat.T)[:, 2])
        gaps, least = np.diff(z), 1e-5 * np.maximum(1, np.abs(z))
        if ((gaps < least[1:]) & (gaps > 0)).any() or (np.abs(z - NEAR_PLANE) < 1e-5).any():
            return False
    return True


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
        options=ANTIALIASED if draw(st.booleans()) else (),
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


def crowd(count: int, width: int, height: int, seed: int = 0) -> SmallScene:
    """Many Gaussians of about a pixel, all inside the image, so faint that all of them are seen."""
    scene = random_scene(count, width, height, seed)
    g = np.random.default_rng((seed, 1))
    z = scene.means[:, 2:]
    pixels = g.uniform(0, 1, (count, 2)) * [width, height]
    sideways = (pixels - scene.Ks[0, :2, 2]) / np.diag(scene.Ks[0])[:2] * z
    means = np.concatenate([sideways, z], axis=1).astype(np.float32)
    spacing = np.sqrt(width * height / count)  # pixels from one to the next
    opacities = np.minimum(0.5, 0.4 * spacing**2 * g.uniform(0.5, 1.5, count))
    return scene.with_(
        means=means,
        scales=(0.5 / width * np.exp(g.uniform(-0.5, 0.5, (count, 3)))).astype(np.float32),
        opacities=np.maximum(opacities, 0.02).astype(np.float32),
    )


@st.composite
def extreme_scenes(draw: st.DrawFn) -> SmallScene:
    """Scales of 1e-8 to 1e4, quaternions of any length, opacities at their ends, distances from the
    near plane to 1e6, any focal length, principal points far outside.

    The first Gaussian is inside the image and can be seen, so that most scenes show something.
    """
    n = draw(st.integers(1, 8))
    width, height = draw(st.integers(1, 33)), draw(st.integers(1, 33))

    def array(shape: tuple[int, ...], low: float, high: float) -> np.ndarray:
        return draw(hnp.arrays(np.float32, shape, elements=_floats(low, high)))

    K = np.eye(3, dtype=np.float32)
    K[0, 0], K[1, 1] = np.float32(10) ** array((2,), 0, 5)
    # Rays up to 87 degrees off the axis.
    K[0, 2], K[1, 2] = array((2,), -1, 1) * np.minimum(1e3, 20 * K[[0, 1], [0, 1]])
    z = np.float32(10) ** array((n,), -1.9, 6)
    pixels = array((n, 2), -0.5, 1.5) * np.array([width, height], np.float32)
    pixels[0] = np.clip(pixels[0], 0, [width, height])
    sideways = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]] * z[:, None]
    seen = st.one_of(_floats(0.1, 1.0), st.sampled_from([1.0, 0.99, 0.999, 5.0]))
    opacities = st.one_of(
        _floats(0.005, 1.0), st.sampled_from([0.0, -0.0, 1.0, 1e-40, 0.99, 0.999, 5.0])
    )
    directions = array((n, 4), -1, 1)
    if not directions[0].any():
        directions[0, 0] = 1
    drawn = draw(hnp.arrays(np.float32, n, elements=opacities))
    drawn[0] = draw(seen)
    return SmallScene(
        means=np.concatenate([sideways, z[:, None]], axis=1).astype(np.float32),
        quats=directions * np.float32(10) ** array((n, 1), -17, 17),
        scales=np.float32(10) ** array((n, 3), -8, 4),
        opacities=drawn,
        colors=array((n, 3), 0, 1),
        viewmats=np.eye(4, dtype=np.float32)[None],
        Ks=K[None],
        width=width,
        height=height,
        backgrounds=array((1, 3), 0, 1),
        render_depth=draw(st.booleans()),
        options=ANTIALIASED if draw(st.booleans()) else (),
    )
