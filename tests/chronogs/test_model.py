"""What the forward pass does with features, periods and directions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from chronogs.method import ChronoGS
from chronoscene.anchors.config import HEADS
from chronoscene.anchors.model import TABLES, AnchorModel
from chronoscene.errors import ConfigError
from chronoscene.rasterizer import NEAR_PLANE
from chronoscene.training.drawing import Splats, draw
from chronoscene.training.losses import mean_volume

Make = Callable[..., ChronoGS]
CENTRE = torch.tensor([0.3, -0.2, 2.0])


def decode_all(model: AnchorModel, weights: list[float], centre: torch.Tensor = CENTRE) -> Splats:
    return model.decode(torch.tensor(weights), centre, torch.arange(len(model)))


@pytest.mark.parametrize(("num_periods", "official_columns"), [(3, 107), (4, 123)])
def test_counts(method: Make, num_periods: int, official_columns: int) -> None:
    model = method(num_periods).model
    counted = ("anchors", *TABLES)
    per_anchor = sum(t.numel() for n, t in model.tensors().items() if n in counted) / len(model)
    # The official file also holds a rotation (4) that is never anything but the identity.
    assert per_anchor == official_columns - 4
    assert sum(t.numel() for head in model.heads.values() for t in head) == 10_158
    assert model.global_features.shape == (num_periods, 32)


def test_before_training_equal_directions_give_equal_gaussians(method: Make) -> None:
    model = method(random_features=False).model
    with torch.no_grad():
        model.anchors[0] = CENTRE + torch.tensor([0.1, 0.2, -0.5])
        model.anchors[1] = CENTRE + 3.0 * torch.tensor([0.1, 0.2, -0.5])
    decoded = decode_all(model, [1.0, 0.0, 0.0])
    torch.testing.assert_close(decoded.opacities[:10], decoded.opacities[10:20])
    torch.testing.assert_close(decoded.colors[:10], decoded.colors[10:20])
    torch.testing.assert_close(
        decoded.means.reshape(-1, 10, 3), model.anchors[:, None].expand(-1, 10, 3)
    )


def gradient_blocks(made: ChronoGS, weights: list[float]) -> torch.Tensor:
    """Gradients of the period features as [A, T, Fv]."""
    model = made.model.requires_grad()
    decoded = decode_all(model, weights)
    (decoded.opacities.sum() + decoded.colors.square().sum() + decoded.scales.sum()).backward()
    grad = model.blocks.grad
    assert grad is not None
    return grad[model.block_rows]


def test_a_view_reaches_only_the_features_of_its_period(method: Make) -> None:
    blocks = gradient_blocks(method(), [0.0, 1.0, 0.0])
    assert blocks[:, 1].abs().amin(dim=0).max() > 0
    assert not blocks[:, [0, 2]].any()


def test_halfway_both_neighbours_get_the_same_gradient(method: Make) -> None:
    blocks = gradient_blocks(method(), [0.5, 0.5, 0.0])
    torch.testing.assert_close(blocks[:, 0], blocks[:, 1])
    assert blocks[:, 0].any()
    assert not blocks[:, 2].any()


def test_fractional_periods_mix_features_before_the_mlp(method: Make, noise_set: Callable) -> None:
    made = method()
    view = noise_set(3).views[0]
    whole = made.render(view, 1)
    np.testing.assert_array_equal(whole.rgb, made.render(view, 1.0).rgb)

    halfway = made.render(view, 0.5).rgb
    model = made.model
    with torch.no_grad():
        blocks = model.blocks.view(len(model), 3, 16)
        blocks[:, 2] = 0.5 * (blocks[:, 0] + blocks[:, 1])
        model.global_features[2] = 0.5 * (model.global_features[0] + model.global_features[1])
    np.testing.assert_allclose(made.render(view, 2).rgb, halfway, atol=1e-5)
    mean_image = 0.5 * (made.render(view, 0).rgb + made.render(view, 1).rgb)
    assert np.abs(mean_image - halfway).max() > 1e-3


def test_gaussians_that_are_off_leave_the_background(method: Make, noise_set: Callable) -> None:
    made = method()
    with torch.no_grad():
        made.model.heads["opacity"].w2.zero_()
        made.model.heads["opacity"].b2.fill_(-1.0)
    view = noise_set(3).views[0]
    prediction = made.render(view, 0)
    assert prediction.alpha is not None
    np.testing.assert_array_equal(prediction.alpha, 0.0)
    np.testing.assert_allclose(
        prediction.rgb, np.broadcast_to([0.1, 0.2, 0.3], prediction.rgb.shape), atol=1e-7
    )
    decoded = decode_all(made.model, [1.0, 0.0, 0.0])
    volume = mean_volume(decoded.scales, decoded.opacities)
    assert float(volume.detach()) == 0.0
    raster = draw(decoded, view, torch.zeros(3), near_plane=NEAR_PLANE)
    (raster.image.sum() + volume).backward()
    for name in TABLES:
        grad = getattr(made.model, name).grad
        assert grad is None or not grad.any()


def test_geometry_and_appearance_of_different_periods(method: Make, noise_set: Callable) -> None:
    made = method()
    view = noise_set(3).views[0]
    split = made.render_split(view, geometry_period=0, appearance_period=2)
    geometry, appearance = made.render(view, 0), made.render(view, 2)
    np.testing.assert_array_equal(split.alpha, geometry.alpha)
    assert np.abs(split.rgb - geometry.rgb).max() > 1e-3
    assert np.abs(split.rgb - appearance.rgb).max() > 1e-3
    both = made.render_split(view, geometry_period=2, appearance_period=2)
    np.testing.assert_array_equal(both.rgb, appearance.rgb)


def plain_inputs(model: AnchorModel, period: int, head: str, *, full: bool) -> torch.Tensor:
    """Inputs of an MLP written out, in the order of the trained columns."""
    layout = model.layout
    base, own = model.features, model.blocks[model.block_rows[:, period]]
    table = model.global_features[period].expand(len(model), -1)
    direction = model.anchors - CENTRE
    if not full:
        direction = direction / direction.norm(dim=1, keepdim=True)
    if layout.fusion == "sum":
        added = sum(part for part in (base, own, table) if part.shape[1])
        return torch.cat([added, direction], dim=1)
    table = table if head in layout.global_heads else table[:, :0]
    return torch.cat([base, own, direction, table], dim=1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"direction": "full"},
        {"fusion": "sum", "global_dim": 16},
        {"fusion": "sum", "global_dim": 16, "direction": "full"},
        {"fusion": "sum", "global_dim": 16, "base_dim": 0},
        {"global_heads": ("color",)},
        {"global_heads": ("opacity",), "direction": "full"},
    ],
    ids=str,
)
def test_variants_of_the_input_against_plain_torch(method: Make, options: dict) -> None:
    model = method(**options).model
    full = options.get("direction") == "full"
    decoded = decode_all(model, [0.0, 1.0, 0.0])
    outputs = {}
    for name in HEADS:
        w1, b1, w2, b2 = model.heads[name]
        inputs = plain_inputs(model, 1, name, full=full)
        outputs[name] = torch.relu(inputs @ w1.T + b1) @ w2.T + b2
    close = {"rtol": 1e-4, "atol": 1e-5}
    opacities = torch.tanh(outputs["opacity"]).flatten()
    torch.testing.assert_close(decoded.opacities, opacities, **close)
    colors = torch.sigmoid(outputs["color"]).view(-1, 3)
    torch.testing.assert_close(decoded.colors, colors, **close)
    shapes = torch.sigmoid(outputs["covariance"].view(-1, 10, 7)[..., :3])
    scales = shapes * model.log_scales[:, None, 3:].exp()
    torch.testing.assert_close(decoded.scales, scales.view(-1, 3), **close)


@pytest.mark.parametrize(
    "dims",
    [{"base_dim": 0}, {"period_dim": 0}, {"global_dim": 0}, {"period_dim": 0, "global_dim": 0}],
)
def test_ablations_render_and_train(method: Make, noise_set: Callable, dims: dict) -> None:
    made = method(**dims)
    reports = [made.step(i, i / 4) for i in range(4)]
    assert all(np.isfinite(r.loss) for r in reports)
    images = [made.render(noise_set(3).views[0], p).rgb for p in range(3)]
    timeless = made.model.layout.period_dim == made.model.layout.global_dim == 0
    assert np.array_equal(images[0], images[1]) == timeless


def test_a_trimmed_global_feature_grows_with_the_periods(method: Make, noise_set: Callable) -> None:
    made = method(1, trim_global=True)
    view, widths = noise_set(1).views[0], []
    for periods in (1, 2, 3):
        if periods > 1:
            before = made.render(view, periods - 2).rgb
            made.extend(noise_set(periods))
            np.testing.assert_allclose(made.render(view, periods - 2).rgb, before, atol=1e-6)
        for i in range(4):
            made.step(i, i / 4)
        table = made.model.global_features.detach()
        widths.append(table.shape)
        assert torch.linalg.matrix_rank(table - table[0]) == periods - 1
    assert widths == [(1, 0), (2, 1), (3, 2)]
    weights = made.model.heads["color"].w1[:, -2:]
    assert torch.linalg.matrix_rank(weights) == 2


def test_features_that_are_added_need_one_length(method: Make) -> None:
    with pytest.raises(ConfigError, match=r"fusion=sum: .*found 16, 16, 32"):
        method(fusion="sum")
