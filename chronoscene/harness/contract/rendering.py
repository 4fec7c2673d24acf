"""Rules for rendering."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chronoscene.harness.contract.subject import NotApplicableError, Subject, demand, resized
from chronoscene.harness.contract.tiny_training import periods_for
from chronoscene.harness.score.regions import left_half
from chronoscene.harness.train.checks import check_prediction
from chronoscene.harness.train.painted_balls import VIEWS_PER_PERIOD
from chronoscene.methods import Prediction, View


def any_size_renders(subject: Subject) -> None:
    """Images of any size are rendered, with values 0 to 1."""
    for size in ((1, 1), (17, 9), (40, 30), (101, 77)):
        view = resized(subject.data.views[0], *size)
        prediction = subject.loaded().render(view, 0.0)
        place = f"{size[0]} x {size[1]} pixels"
        check_prediction(prediction, view, place)
        rgb = prediction.rgb
        demand(
            rgb.min() >= 0 and rgb.max() <= 1, f"{place}: Prediction.rgb", "values 0 to 1",
            f"{rgb.min():.4g} to {rgb.max():.4g}",
        )  # fmt: skip


def a_larger_image_shows_the_same(subject: Subject) -> None:
    """Twice the size, averaged, gives nearly the same image: K is obeyed."""
    view = subject.data.views[1]
    small = subject.method.render(view, 0.0).rgb
    large = subject.method.render(resized(view, 2 * view.width, 2 * view.height), 0.0).rgb
    averaged = large.reshape(view.height, 2, view.width, 2, 3).mean(axis=(1, 3))
    difference = np.abs(averaged - small).mean()
    demand(difference < 0.05, "Prediction.rgb at twice the size", "the same image", difference)


def declared_outputs_are_there(subject: Subject) -> None:
    """Alpha and depth are there where the spec names them, and mean what they should."""
    view = subject.data.views[0]
    prediction = subject.method.render(view, 0.0)
    check_prediction(prediction, view, "render")
    for field in ("alpha", "depth"):
        value = getattr(prediction, field)
        if field in subject.spec.outputs:
            place = f"Prediction.{field}"
            demand(value is not None, place, "an array, as MethodSpec.outputs names it", "None")
            demand(value.min() >= 0, place, "nothing below 0", value.min())
    if prediction.alpha is not None:
        most = prediction.alpha.max()
        demand(0.5 < most <= 1, "Prediction.alpha", "0 to 1, and more than 0.5 somewhere", most)
    if prediction.depth is not None:
        _check_depth(prediction, view)


def _check_depth(prediction: Prediction, view: View) -> None:
    assert prediction.depth is not None
    # The balls lie within 0.7 of the origin, and the camera at distance 1 from it.
    middle = prediction.depth[view.height // 2, view.width // 2]
    demand(0.2 < middle < 1.8, "Prediction.depth", "z in units of the training frame", middle)
    if prediction.alpha is not None:
        behind = prediction.depth[prediction.alpha == 0]
        demand((behind == 0).all(), "Prediction.depth", "0 where alpha is 0")


def a_view_of_nothing_is_background(subject: Subject) -> None:
    """A view of nothing shows the background."""
    if subject.spec.learns_background:
        raise NotApplicableError("the model says what is behind everything")
    view = subject.data.views[0]
    away = view.cam_from_world.copy()
    away[:3, 3] += [0.0, 0.0, -50.0]  # everything far behind
    rgb = subject.method.render(View(view.K, view.width, view.height, away), 0.0).rgb
    far = float(np.abs(rgb - subject.data.background).max())
    demand(far <= 1e-6, "Prediction.rgb of a view of nothing", "the background", f"{far:.3g} off")


def periods_matter(subject: Subject) -> None:
    """Periods that differ are rendered differently, where the method takes a period."""
    if subject.spec.period_input == "none":
        raise NotApplicableError("the method takes no period")
    images = [_image(subject, float(period)) for period in range(3)]
    for a, b in ((0, 1), (1, 2)):
        change = np.abs(images[a] - images[b]).mean()
        demand(change > 1e-4, f"render at periods {a} and {b}", "different images", change)


def fractional_periods_lie_between(subject: Subject) -> None:
    """Fractional periods lie between the whole ones, where the spec says continuous."""
    if subject.spec.period_input != "continuous":
        raise NotApplicableError("the method takes whole periods only")
    first, half, second = (_image(subject, period) for period in (0.0, 0.5, 1.0))
    demand(np.isfinite(half).all() and half.min() >= 0 and half.max() <= 1, "period 0.5", "0 to 1")
    for other, period in ((first, 0), (second, 1)):
        change = np.abs(half - other).mean()
        demand(change > 1e-5, "render at period 0.5", f"another image than at {period}", change)
    change = np.abs(_image(subject, 1e-4) - first).mean()
    demand(change < 0.01, "render at period 0.0001", "nearly the image of period 0", change)


BAKED = 0.02
"""Largest mean error of exported Gaussians: twice that of scaffold-gs, whose opacities depend on
the direction of view."""
LOST = 0.6
"""Largest part of what changes between periods that exports for the same views may lose: 0.4 of
chronogs, which has hardly learned it in so few steps, and 1 of an export that is the same at all
periods."""


def gaussians_look_like_the_model(subject: Subject) -> None:
    """Exported Gaussians look nearly like the model, and change with the period as it does."""
    method, periods = subject.method, range(periods_for(subject.spec))
    if not hasattr(method, "to_gaussians"):
        raise NotApplicableError("the method gives no Gaussians")
    views = subject.data.views[:VIEWS_PER_PERIOD]
    errors, images = [], []
    for period in periods:
        cloud = method.to_gaussians(float(period), subject.data.views)
        drawn = np.stack([method.render_gaussians(cloud, view).rgb for view in views[::3]])
        images.append(np.stack([method.render(view, float(period)).rgb for view in views[::3]]))
        errors.append(drawn - images[-1])
        error = np.abs(errors[-1]).mean()
        demand(error < BAKED, f"to_gaussians of period {period}", "the image of render", error)
    for a, b in pairwise(periods):
        change = np.abs(images[b] - images[a]).mean()
        lost = np.abs(errors[b] - errors[a]).mean() / max(change, 1e-9)
        place = f"to_gaussians of periods {a} and {b}"
        demand(lost < LOST, place, "what changes in render", f"{lost:.0%} of it lost")


def half_of_a_photo_fits_the_appearance(subject: Subject) -> None:
    """An appearance that is fitted to part of a photo reads that alone, and leaves the model."""
    method, view = subject.loaded(), subject.data.views[0]
    if not hasattr(method, "fitted_to"):
        raise NotApplicableError("no appearance belongs to a single photo")
    photo, known = subject.data.load_image(0), left_half(view.height, view.width)
    before = method.render(view, 0.0).rgb
    first, second = (
        method.fitted_to(view, 0.0, np.where(known[..., None], photo, unknown), known)
        .render(view, 0.0)
        .rgb
        for unknown in (photo, 255 - photo)
    )
    demand(np.array_equal(first, second), "fitted_to", "an image that unknown pixels do not change")
    after = method.render(view, 0.0).rgb
    demand(np.array_equal(after, before), "fitted_to", "a model that renders what it did")


def _image(subject: Subject, period: float) -> NDArray[np.float32]:
    return subject.method.render(subject.data.views[0], period).rgb


CHECKS = (
    any_size_renders,
    a_larger_image_shows_the_same,
    declared_outputs_are_there,
    a_view_of_nothing_is_background,
    periods_matter,
    fractional_periods_lie_between,
    gaussians_look_like_the_model,
    half_of_a_photo_fits_the_appearance,
)
