"""The kernel that makes bad Gaussians invisible against the same in plain torch."""

import pytest
import torch
from gpu_kernels import DEVICE, MARKS, gpu_kernels

from chronoscene.rasterizer import gsplat_backend
from chronoscene.rasterizer.constants import ALPHA_MIN, QUATERNION_MIN

pytestmark = MARKS


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_bad_rows_are_replaced_and_others_learn(channels: int) -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = ((300, 3), (300, 4), (300, 3), (300,), (300, channels))
    arrays = [torch.rand(shape, generator=generator) for shape in shapes]
    arrays[3] += 0.1
    for row, array in enumerate(arrays):
        for place, bad in enumerate((torch.nan, torch.inf, -torch.inf)):
            array[20 * row + place].view(-1)[-1] = bad
    arrays[1][200], arrays[3][210], arrays[3][211] = 0.0, ALPHA_MIN, -1.0
    expected, fine = gsplat_backend._without_bad_rows(*arrays)
    leaves = [array.to(DEVICE).requires_grad_() for array in arrays]
    found, good = gpu_kernels("rasterizer.clean_gpu").cleaned(
        leaves, least_length=QUATERNION_MIN, least_opacity=ALPHA_MIN
    )
    assert torch.equal(good.cpu(), fine) and (~fine).sum() == 18
    for mine, theirs in zip(found, expected, strict=True):
        assert torch.equal(mine.detach().cpu(), theirs)
    sum((array * array)[good].sum() for array in found).backward()
    for leaf in leaves:
        torch.testing.assert_close(leaf.grad[good], 2 * leaf.detach()[good])
