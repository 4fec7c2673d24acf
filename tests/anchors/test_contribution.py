"""What Gaussians add to images, and which anchors and offsets carry nothing."""

import numpy as np
import pytest
import torch

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.contribution import (
    blending_weights,
    least,
    pack_offsets,
    unpack_offsets,
    used_offsets,
)
from chronoscene.anchors.decode import pack_bits
from chronoscene.anchors.model import AnchorLayout, AnchorModel
from chronoscene.methods import TrainingView, View
from chronoscene.scene.geometry import look_at
from chronoscene.training.drawing import Splats, draw

K = np.array([[60.0, 0.0, 24.0], [0.0, 60.0, 18.0], [0.0, 0.0, 1.0]])
ABOVE = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), up=np.array([0.0, 1.0, 0.0]))
LAYOUT = AnchorLayout(1, offsets=2, base_dim=4)


def splats(depths, opacities, scale=0.5):
    """Balls below each other under the camera."""
    count = len(depths)
    means = torch.zeros(count, 3)
    means[:, 2] = 2.0 - torch.tensor(depths)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous()
    scales = torch.full((count, 3), scale)
    return Splats(means, quats, scales, torch.tensor(opacities), torch.full((count, 3), 0.5))


def test_weights_of_all_gaussians_make_up_the_covered_part_of_the_image() -> None:
    gaussians, view = splats([1.0, 1.5, 3.0], [0.6, 0.9, 0.5]), View(K, 48, 36, ABOVE)
    weights = blending_weights(gaussians, view, LAYOUT)
    raster = draw(gaussians, view, torch.zeros(3), near_plane=0.01, antialiased=False)
    torch.testing.assert_close(weights.sum(), raster.alphas.sum())


def test_what_is_behind_adds_what_is_let_through() -> None:
    wide = splats([1.0, 1.0001], [0.75, 0.5], scale=100.0)
    weights = blending_weights(wide, View(K, 48, 36, ABOVE), LAYOUT)
    torch.testing.assert_close(
        weights / (48 * 36), torch.tensor([0.75, 0.25 * 0.5]), rtol=1e-3, atol=0
    )


def test_least_amounts() -> None:
    amounts = torch.tensor([[5.0, 1.0], [0.0, 4.0]])
    assert least(amounts, 0.1).tolist() == [[False, True], [True, False]]
    assert least(amounts, 0.09).tolist() == [[False, False], [True, False]]
    assert least(amounts, 0.5).tolist() == [[False, True], [True, True]]


def test_packing_keeps_what_is_used() -> None:
    used = torch.tensor([[True, False, True], [False, False, True]])
    tensors = {"offsets": torch.randn(2, 3, 3), "used_offsets": pack_bits(used)}
    packed = pack_offsets(tensors)
    assert torch.equal(packed["offsets"], tensors["offsets"][used])
    restored = unpack_offsets(packed, 3)
    assert torch.equal(restored["offsets"], tensors["offsets"] * used[:, :, None])
    assert torch.equal(restored["used_offsets"], tensors["used_offsets"])
    assert pack_offsets({"offsets": used}) == {"offsets": used}


def make_model() -> AnchorModel:
    """Anchors at three depths under the camera, the middle one opaque and large, and one behind the
    camera. Offset 1 is always off."""
    anchors = np.array([[0, 0, 0.8], [0, 0, 0.5], [0, 0, -0.5], [0, 0, 5.0]], np.float32)
    generator = torch.Generator().manual_seed(0)
    model = AnchorModel.start(LAYOUT, AnchorConfig(base_dim=4), anchors, generator)
    model.log_scales[:] = torch.tensor([0.1, 20.0, 0.1, 0.1]).log()[:, None]
    for head in model.heads.values():
        for weight in head:
            weight.zero_()
    model.heads["opacity"].b2.copy_(torch.tensor([8.0, -1.0]))
    return model


@pytest.mark.parametrize("periods", [(0,), (0, 1)])
def test_hidden_anchors_and_offsets_that_are_off_carry_nothing(periods: tuple[int, ...]) -> None:
    # In period 1, the camera is between the large anchor and what it hides.
    poses = (
        ABOVE,
        look_at(np.array([0, 0, 0.0]), np.array([0, 0, -1.0]), up=np.array([0, 1.0, 0])),
    )
    views = [TrainingView(K, 48, 36, poses[p], name=f"{p}", period=p) for p in periods]
    used = used_offsets(make_model(), views, [0] * len(views), 5e-3)
    assert used[:, 0].tolist() == [True, True, len(periods) == 2, False]
    assert not used[:, 1].any()
