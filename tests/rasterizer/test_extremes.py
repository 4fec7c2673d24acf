"""Numerical extremes: each is right, culled or a clear error, forward and backward.

What happens and the measured errors are in the README of the rasterizer.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from rasterizer_cases.comparison import Comparison, compare, everything, rounding, steady_pixels
from rasterizer_cases.exact import exact_pixels
from rasterizer_cases.extremes import AGREES, CULLED, EXTREMES, Extreme, in_training_frame, rounded
from rasterizer_cases.mixtures import FOUND
from rasterizer_cases.scenes import (
    ANTIALIASED,
    SmallScene,
    extreme_scenes,
    random_scene,
    well_posed,
)

import chronoscene.rasterizer
from chronoscene.errors import ShapeError
from chronoscene.rasterizer import rasterize

BY_NAME = {extreme.name: extreme for extreme in EXTREMES}
AGREEING = [e for e in EXTREMES if e.outcome == AGREES]
CULLING = [e for e in EXTREMES if e.outcome == CULLED]
REFUSED = [e for e in EXTREMES if e.outcome not in (AGREES, CULLED)]


LONG = ("1e5 on one pixel", "an image of 8191 x 1")
"""The reference takes ten seconds and more for each of these."""


def named(extremes: list[Extreme]) -> Any:
    params = [
        pytest.param(e, id=e.name, marks=pytest.mark.slow if e.name in LONG else ())
        for e in extremes
    ]
    return pytest.mark.parametrize("extreme", params)


def assert_close(
    comparison: Comparison, moved: Comparison, tolerances: ModuleType, mixture: bool = False
) -> None:
    """Every output and gradient is as near to the reference as float32 inputs allow."""
    for name in comparison.expected:
        if name != "radii":
            error, unavoidable = comparison.error(name), moved.error(name)
            limit = tolerances.of_extreme(name, unavoidable, mixture)
            assert error <= limit, (name, error, unavoidable)
    got, expected = comparison.got["radii"], comparison.expected["radii"]
    spread = radius_spread(moved) if mixture else 0.0
    limit = min(tolerances.EXTREME_MOST, 1e-5 + tolerances.EXTREME_RATIO * spread)
    assert (np.abs(got - expected) <= 1 + limit * expected).all()


def radius_spread(moved: Comparison) -> float:
    """Largest relative change of a radius by the rounding of inputs."""
    got, expected = moved.got["radii"], moved.expected["radii"]
    return float((np.abs(got - expected) / np.maximum(1, expected)).max(initial=0))


def of_both(comparison: Comparison) -> Comparison:
    """Without what is said of Gaussians that only one side draws: an ellipse may touch the image by
    less than rounding. Whether they leave a trace in the image is for the image to show."""
    got, expected = comparison.got, comparison.expected
    drawn = np.minimum(got["radii"], expected["radii"]).min(-1) > 0
    for side in (got, expected):
        side["z"] = np.where(drawn, side["z"], 0)
        for name in ("radii", "means2d"):
            side[name] = np.where(np.expand_dims(drawn, -1), side[name], 0)
    return comparison


@named(AGREEING)
def test_agrees_with_the_reference(extreme: Extreme, tolerances: ModuleType) -> None:
    comparison = compare(extreme.build(), truth=extreme.truth and extreme.truth())
    moved = rounding(comparison, fixed=extreme.fixed)
    assert comparison.expected["alphas"].mean() >= extreme.seen
    assert comparison.steady.mean() >= 0.99  # next to nothing is left out
    assert_close(comparison, moved, tolerances)


@pytest.mark.parametrize(
    "name",
    [
        "pancakes seen edge-on",
        "pancakes 1e4 by 1e-4",
        "opacity 1e20",
        "a world 1e-17 times as large",
        "a focal length of 1/1000 of the width",
    ],
)
def test_antialiased_extremes(name: str, tolerances: ModuleType) -> None:
    scene = BY_NAME[name].build()
    pixels = [(x, y) for y in range(0, scene.height, 5) for x in range(0, scene.width, 6)]
    scene = scene.with_(options=(*scene.options, *ANTIALIASED))
    comparison = compare(scene)
    assert comparison.expected["alphas"].mean() > 0.05
    assert_close(comparison, rounding(comparison), tolerances)
    result = scene.render("reference", torch.float64)[0]
    got = np.array([result.image[0, y, x].detach().numpy() for x, y in pixels])
    assert np.abs(got - exact_pixels(scene, pixels)[:, :3]).max() < 1e-11


def test_antialiased_what_has_no_area_is_culled() -> None:
    scene = BY_NAME["needles 1 by 1e-8"].build().with_(options=ANTIALIASED)
    for backend in ("reference", "cpu"):
        result, inputs = scene.render(backend)
        (result.image.sum() + result.alphas.sum()).backward()
        assert not result.alphas.any() and not result.info.radii.any()
        assert all(not inputs[name].grad.any() for name in ("means", "quats", "scales"))


@named(CULLING)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_culled_without_a_trace(extreme: Extreme, backend: str) -> None:
    scene = extreme.build()
    result, inputs = scene.render(backend, torch.float32)
    assert scene.backgrounds is not None and result.depths is not None
    background = torch.tensor(scene.backgrounds)[:, None, None].expand_as(result.image)
    assert torch.equal(result.image, background)
    assert not result.alphas.any() and not result.depths.any()
    assert not result.info.radii.any() and not result.info.means2d.any()
    (result.image.sum() + result.alphas.sum() + result.depths.sum()).backward()
    inputs.pop("backgrounds")
    for name, x in inputs.items():
        assert x.grad is not None and not x.grad.any(), name


@named(REFUSED)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_refused_with_a_clear_error(extreme: Extreme, backend: str) -> None:
    with pytest.raises(ShapeError, match=re.escape(extreme.outcome)):
        extreme.build().render(backend, check_finite=True)


@named([e for e in EXTREMES if e not in REFUSED and not e.name.startswith("nan")])
def test_the_check_lets_it_pass(extreme: Extreme) -> None:
    extreme.build().render("cpu", check_finite=True)


@named([*AGREEING, *CULLING])
def test_bits_do_not_depend_on_the_number_of_threads(extreme: Extreme, threads: Any) -> None:
    scene, results = extreme.build(), []
    for number in (1, 2):
        threads(number)
        results.append(everything(scene))
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two) and torch.isfinite(one).all()


@named([e for e in AGREEING if e.name != "1e5 on one pixel"])
def test_the_reference_itself_is_right(extreme: Extreme) -> None:
    """Against 60 digits, at pixels all over the image, to the rounding of its largest number."""
    scene = extreme.build()
    step = max(9, scene.width // 6)
    pixels = [(x, y) for y in range(0, scene.height, 7) for x in range(0, scene.width, step)]
    result = scene.render("reference", torch.float64)[0]
    values = torch.cat([result.image, result.alphas], dim=-1)[0].detach().numpy()
    got = np.array([values[y, x] for x, y in pixels])
    largest = max(np.abs(scene.viewmats).max(), np.abs(scene.Ks).max())
    assert np.abs(got - exact_pixels(scene, pixels)).max() < 1e-12 + 1e-15 * largest


GRADCHECKED = [
    "scales 1e-8",
    "scales 1e4",
    "needles 1 by 1e-8",
    "needles 1e4 by 1e-4",
    "pancakes 1 by 1e-8 without blur",
    "pancakes 1e4 by 1e-4",
    "quaternions of length 1e-18",
    "quaternions of length 3e38",
    "a world 1e17 times as large",
    "a world 1e-17 times as large",
    "a stack of opaque Gaussians",
    "a focal length of 1e7",
    "a focal length of 1/1000 of the width",
    "a principal point 1e5 pixels outside",
]


@pytest.mark.parametrize("name", GRADCHECKED)
def test_gradients_of_the_reference_are_right(name: str) -> None:
    """Against finite differences, each input moved in proportion to its size; by random projections
    (torch's fast mode), at pixels that no threshold is near to."""
    scene = BY_NAME[name].build()
    steady = steady_pixels(scene, 1e-3)
    assert steady.double().mean() > 0.9
    inputs = {k: x.detach() for k, x in scene.tensors(torch.float64).items()}
    inputs["backgrounds"] = torch.tensor(scene.backgrounds).double()
    steps = [torch.zeros_like(x, requires_grad=True) for x in inputs.values()]
    options: dict[str, Any] = dict(scene.options)
    options.update(viewmats=torch.tensor(scene.viewmats).double(), width=scene.width)
    options.update(Ks=torch.tensor(scene.Ks).double(), height=scene.height, check_finite=False)

    def outputs(*steps: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moved: dict[str, Any]
        moved = {k: x * (1 + step) for (k, x), step in zip(inputs.items(), steps, strict=True)}
        result = rasterize(**moved, **options, render_depth=True, backend="reference")
        assert result.depths is not None
        depths = torch.where(steady & (result.alphas.detach() > 0.1), result.depths, 0)
        unit = max(1e-18, float(inputs["means"][:, 2].max()))
        return result.image * steady, result.alphas * steady, depths / unit

    # Failing takes minutes: torch then computes all derivatives one by one for its message.
    assert torch.autograd.gradcheck(outputs, steps, eps=1e-7, atol=1e-9, rtol=1e-4, fast_mode=True)


def check_mixture(scene: SmallScene, tolerances: ModuleType) -> None:
    assume(well_posed(scene))
    comparison = compare(scene)
    moved = rounding(comparison)
    assert_close(of_both(comparison), of_both(moved), tolerances, mixture=True)


@settings(max_examples=30)
@given(scene=extreme_scenes())
def test_any_mixture_of_extremes(scene: SmallScene, tolerances: ModuleType) -> None:
    check_mixture(scene, tolerances)


@pytest.mark.slow
@settings(max_examples=500, derandomize=False)
@given(scene=extreme_scenes())
def test_any_mixture_of_extremes_drawn_afresh(scene: SmallScene, tolerances: ModuleType) -> None:
    check_mixture(scene, tolerances)


def test_most_mixtures_show_something() -> None:
    seen = []

    @settings(max_examples=100)
    @given(scene=extreme_scenes())
    def look(scene: SmallScene) -> None:
        with torch.no_grad():
            # Antialiased, what is tiny fades.
            seen.append(scene.with_(options=()).render("cpu")[0].alphas.max() > 0.01)

    look()
    assert np.mean(seen) > 0.9


@pytest.mark.parametrize("name", FOUND)
def test_mixtures_that_were_once_wrong(name: str, tolerances: ModuleType) -> None:
    scene = FOUND[name]
    assert well_posed(scene)
    comparison = compare(scene)
    moved = rounding(comparison)
    assert_close(of_both(comparison), of_both(moved), tolerances, mixture=True)


@pytest.mark.parametrize("survey", ["UTM", "ECEF"])
def test_survey_coordinates_are_harmless_unless_rounded(survey: str) -> None:
    """With float64 or recentred coordinates the images are equal; rounded ones are another world:
    that loss happened before rendering."""
    world = BY_NAME[f"{survey} coordinates, float64"].build()
    recentred = in_training_frame(world)
    exact = compare(world).expected["image"]
    same = compare(rounded(recentred), truth=recentred)
    np.testing.assert_allclose(same.expected["image"], exact, atol=1e-7)
    assert same.error("image") < 1e-5 and compare(world).error("image") < 1e-5
    assert compare(rounded(world), truth=world).error("image") > 0.1


def test_equal_depths_keep_the_order_of_the_input() -> None:
    """Reversing the input changes the image, as it does that of the reference."""
    scene = BY_NAME["all at equal depth"].build()
    names = ("means", "quats", "scales", "opacities", "colors")
    reverse = scene.with_(**{name: getattr(scene, name)[::-1].copy() for name in names})
    here, there = scene.render("cpu")[0].image, reverse.render("cpu")[0].image
    assert (here - there).abs().max() > 0.05
    np.testing.assert_allclose(
        there.detach(), reverse.render("reference", torch.float64)[0].image.detach(), atol=1e-5
    )


def test_the_far_end_of_the_widest_image_is_right() -> None:
    """The last pixels of 65536 are those of a small image whose principal point is moved."""
    wide, narrow = 65536, 32
    K = np.array([[[80.0, 0, wide - 16], [0, 80, 16], [0, 0, 1]]], np.float32)
    scene = random_scene(60, wide, narrow, seed=3, Ks=K)
    moved = K.copy()
    moved[0, 0, 2] = narrow - 16
    here = scene.render("cpu")[0].image[:, :, -narrow:]
    there = scene.with_(width=narrow, Ks=moved).render("cpu")[0].image
    assert there.max() > 0.3
    assert (here - there).abs().max() < 0.01  # centres are rounded to 0.004 pixels


def test_readme_has_every_extreme_and_no_other() -> None:
    text = Path(str(chronoscene.rasterizer.__file__)).with_name("README.md").read_text("utf-8")
    tables = text.split("## Extremes")[1].split("\n## ")[0].split("### ")
    outcomes, errors = (re.findall(r"^\| (.+?) \| (.+?) \|", t, re.M) for t in tables[1:3])
    assert outcomes[2:] == [(e.name, e.why) for e in EXTREMES]
    assert [name for name, _ in errors[2:]] == [e.name for e in EXTREMES if e.compared]


def test_a_gradient_that_is_wrong_by_a_thousandth_is_seen(tolerances: ModuleType) -> None:
    comparison = compare(BY_NAME["needles 1e4 by 1e-4"].build())
    moved = rounding(comparison)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        wrong = comparison.got | {"grad " + name: comparison.got["grad " + name] * 0.999}
        with pytest.raises(AssertionError, match="grad " + name):
            assert_close(replace(comparison, got=wrong), moved, tolerances)
