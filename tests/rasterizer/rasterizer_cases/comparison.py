"""A backend beside the reference: outputs and all gradients on the same numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch

from chronoscene.rasterizer import reference
from chronoscene.rasterizer.constants import EPS2D

from .scenes import SmallScene

BAND = 1e-4
"""Relative distance by which thresholds are moved to find the pixels to leave out."""


@contextmanager
def thresholds(**values: float) -> Iterator[None]:
    """The reference with other constants."""
    before = {name: getattr(reference, name) for name in values}
    try:
        for name, value in values.items():
            setattr(reference, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(reference, name, value)


def steady_pixels(scene: SmallScene, band: float) -> torch.Tensor:
    """Pixels whose colour does not depend on a threshold being passed by a hair. [C, H, W, 1]

    The image jumps where alpha crosses 1/255 and where the transmittance crosses its end; rounding
    decides on which side such a pixel falls. They are found by moving the thresholds by more than
    rounding can.
    """
    return _steady_and_alphas(scene, band)[0]


def _steady_and_alphas(scene: SmallScene, band: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The pixels of `steady_pixels`, and the alphas of all. [C, H, W, 1]"""
    with torch.no_grad():
        base = scene.render("reference", torch.float64)[0]
        steady = torch.ones_like(base.alphas, dtype=torch.bool)
        for name in ("ALPHA_MIN", "TRANSMITTANCE_MIN"):
            for factor in (1 - band, 1 + band):
                with thresholds(**{name: getattr(reference, name) * factor}):
                    other = scene.render("reference", torch.float64)[0]
                moved = (other.image != base.image).any(-1, keepdim=True)
                steady &= ~(moved | (other.alphas != base.alphas))
        for c in range(len(steady)):
            steady[c, ..., 0] &= ~_at_the_cap(scene, c, band)
    return steady, base.alphas


def _at_the_cap(scene: SmallScene, c: int, band: float) -> torch.Tensor:
    """Pixels where the cap of alpha is passed by a hair: the gradient jumps there. [H, W]"""
    opaque = scene.opacities > reference.ALPHA_MAX * (1 - band)
    arrays = (scene.means, scene.quats, scene.scales, scene.viewmats[c], scene.Ks[c])
    means, quats, scales, viewmat, K = (torch.tensor(x).double() for x in arrays)
    projected = reference._project(
        means[opaque], quats[opaque], scales[opaque], viewmat, K, scene.width, scene.height
    )
    x, y = torch.meshgrid(
        torch.arange(scene.width) + 0.5, torch.arange(scene.height) + 0.5, indexing="xy"
    )
    offsets = torch.stack([x, y], dim=-1).reshape(-1, 1, 2) - projected.means2d
    eps2d = dict(scene.options).get("eps2d", EPS2D)
    distances = reference._distances(offsets, projected.axes, eps2d)
    alphas = torch.tensor(scene.opacities[opaque]).double() * torch.exp(-0.5 * distances)
    if dict(scene.options).get("antialiased"):
        alphas = alphas * reference._compensations(projected.axes, eps2d)
    near = (alphas / reference.ALPHA_MAX - 1).abs() < band
    return near.any(-1).reshape(scene.height, scene.width)


@dataclass
class Comparison:
    """A backend beside the reference; arrays by name, float64."""

    scene: SmallScene
    got: dict[str, np.ndarray]
    expected: dict[str, np.ndarray]
    steady: np.ndarray
    counted: torch.Tensor
    """Pixels that the loss weighs."""

    def error(self, name: str, floor: float = 1e-37) -> float:
        """Largest difference, relative to the largest magnitude, of at least ``floor``."""
        got, expected = self.got[name], self.expected[name]
        if got.size == 0:
            return 0.0
        assert np.isfinite(got).all(), name
        scale = max(floor, np.abs(expected).max())
        if name == "means2d":
            scale = max(scale, 1.0)  # a pixel
        if name == "grad quats":
            scale = max(scale, self._turning().max())
        return float(np.abs(got - expected).max() / scale)

    def without_grazing(self) -> Comparison:
        """The same without the Gaussians beside the image that only gsplat counts as seen.

        It rounds half extents up before it asks whether they meet the image. No pixel shows them.
        """
        centres, extents = self.got["means2d"], self.got["radii"] - 1
        size = (self.scene.width, self.scene.height)
        inside = ((centres + extents > 0) & (centres - extents < size)).all(-1)
        grazing = ~inside & (self.expected["radii"] == 0).all(-1)
        got = dict(self.got)
        for name in ("means2d", "radii", "z"):
            got[name] = got[name].copy()
            got[name][grazing] = 0
        return replace(self, got=got)

    def _turning(self) -> np.ndarray:
        """Size of the terms whose difference is the gradient of a rotation. [N]

        They cancel altogether for a sphere; what is left is their rounding.
        """
        stretching = np.abs(self.expected["grad scales"] * self.scene.scales).sum(-1)
        length = np.linalg.norm(self.scene.quats.astype(np.float64), axis=-1)
        return np.where(length > 0, stretching / np.maximum(length, 1e-37), 0.0)


def steady_and_counted(scene: SmallScene, band: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Steady pixels, and those of them that count: with depth only those where the reference shows
    something, as the depth of what is hardly there is not well defined. Both sides of a comparison
    count the same ones: an opacity may be the limit itself. [C, H, W, 1]"""
    steady, alphas = _steady_and_alphas(scene, band)
    return steady, steady & (alphas > 0.1) if scene.render_depth else steady


def run(
    scene: SmallScene, backend: str, dtype: torch.dtype, device: str, counted: torch.Tensor
) -> dict[str, np.ndarray]:
    """Outputs and gradients of a loss that weighs every counted pixel at random.

    Depths count in units of the largest: in the gradient of an expected depth everything cancels
    but differences of depth, so that its rounding is relative to depth itself.
    """
    result, inputs = scene.render(backend, dtype, device)
    generator = torch.Generator().manual_seed(0)
    outputs = {"image": result.image, "alphas": result.alphas}
    if result.depths is not None:
        outputs["depths"] = result.depths
    loss = torch.zeros((), dtype=dtype, device=device)
    weights = counted.to(dtype)
    units = {"depths": _largest_depth(scene)}
    for name, output in outputs.items():
        draw = _loss_weights(output.shape, generator).to(dtype)
        loss = loss + (output * (draw * weights / units.get(name, 1)).to(device)).sum()
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


def _loss_weights(shape: torch.Size, generator: torch.Generator) -> torch.Tensor:
    """Random weights of pixels whose sum does not happen to cancel.

    Under a Gaussian that is equally opaque everywhere, the gradient of its depth is that sum: with
    weights that cancel to 1e-4 of their sizes (as the first ones for depths of 4 by 29 pixels do)
    float32 leaves it three digits, whatever the kernels do.
    """
    draw = torch.randn(shape, generator=generator)
    size = draw.abs().sum()
    return draw + 0.1 if draw.sum().abs() < 1e-3 * size else draw


def _largest_depth(scene: SmallScene) -> float:
    means, viewmats = scene.means.astype(np.float64), scene.viewmats.astype(np.float64)
    depths = means @ viewmats[:, 2, :3].T + viewmats[:, 2, 3]
    return float(depths.max(initial=0)) or 1.0


def compare(
    scene: SmallScene,
    backend: str = "cpu",
    device: str = "cpu",
    *,
    truth: SmallScene | None = None,
    band: float = BAND,
) -> Comparison:
    """Run a backend, and the reference in float64 on the same numbers.

    Args:
        scene: Its arrays say in which type the backend receives them.
        backend, device: What to compare with the reference.
        truth: What the reference gets instead.
        band: How far, relatively, the thresholds are moved to find the pixels to leave out.
    """
    truth = truth or scene
    steady, counted = steady_and_counted(truth, band)
    dtype = torch.float64 if scene.means.dtype == np.float64 else torch.float32
    return Comparison(
        truth,
        got=run(scene, backend, dtype, device, counted),
        expected=run(truth, "reference", torch.float64, "cpu", counted),
        steady=steady.numpy(),
        counted=counted,
    )


def at_camera(scene: SmallScene) -> SmallScene:
    """Move the origin of a scene, in float64, to its first camera."""
    viewmats, means = scene.viewmats.astype(np.float64), scene.means.astype(np.float64)
    origin = -np.linalg.solve(viewmats[0, :3, :3], viewmats[0, :3, 3])
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ origin
    return scene.with_(means=means - origin, viewmats=viewmats)


def rounding(comparison: Comparison, *, fixed: bool = False) -> Comparison:
    """The reference beside itself with every input moved by up to one unit of its last float32
    place: the error that float32 inputs have before anything is computed.

    Of four draws the largest difference is kept, put where `Comparison.error` finds it. What
    counts is where things are as seen from the first camera, not where the origin is.

    Args:
        comparison: Of any scene; what it says of the reference is not computed again where the
            first camera is the origin.
        fixed: Leave positions and cameras as they are.
    """
    base = _seen_from_its_camera(comparison)
    worst = dict(base.expected)
    for seed in range(4):
        moved = _moved(base.scene, seed, fixed)
        other = run(moved, "reference", torch.float64, "cpu", base.counted)
        for name, usual in base.expected.items():
            if usual.size and np.abs(other[name] - usual).max() > np.abs(worst[name] - usual).max():
                worst[name] = other[name]
    return replace(base, got=worst)


def _seen_from_its_camera(comparison: Comparison) -> Comparison:
    """The reference on both sides, with the origin at the first camera."""
    before, scene = comparison.scene, at_camera(comparison.scene)
    if all(np.array_equal(getattr(before, n), getattr(scene, n)) for n in ("means", "viewmats")):
        return replace(comparison, expected=dict(comparison.expected))
    steady, counted = steady_and_counted(scene, BAND)
    expected = run(scene, "reference", torch.float64, "cpu", counted)
    return Comparison(scene, expected, dict(expected), steady.numpy(), counted)


def _moved(scene: SmallScene, seed: int, fixed: bool) -> SmallScene:
    g = np.random.default_rng(seed)
    names = ["quats", "scales", "opacities", "colors", "Ks"]
    names += [] if fixed else ["means", "viewmats"]
    moved = {}
    for name in names:
        array = getattr(scene, name).astype(np.float64)
        moved[name] = array * (1 + 2.0**-23 * g.uniform(-1, 1, array.shape))
    return scene.with_(**moved)


def everything(scene: SmallScene) -> list[torch.Tensor]:
    """All outputs and all gradients of one rendering by the CPU backend."""
    result, inputs = scene.render("cpu")
    generator = torch.Generator().manual_seed(0)
    loss = (result.image * torch.randn(result.image.shape, generator=generator)).sum()
    loss = loss + (result.alphas**2).sum()
    if result.depths is not None:
        loss = loss + (result.depths * result.alphas.detach()).sum()
    loss.backward()
    outputs = [result.image, result.alphas, result.info.means2d, result.info.means2d.grad]
    gradients = [result.info.radii, *(x.grad for x in inputs.values())]
    return [x for x in (*outputs, *gradients) if x is not None]
