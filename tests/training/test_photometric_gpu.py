"""The kernels of the loss for a GPU against the same in plain torch."""

import pytest
import torch
from gpu_kernels import DEVICE, MARKS, gpu_kernels

from chronoscene.training.photometric import ssim_torch

pytestmark = MARKS


@pytest.mark.parametrize(
    ("size", "dtype"),
    [
        ((13, 7), torch.uint8),
        ((4, 7), torch.float32),  # the interpreter takes a third of a second for each row
        ((1, 1), torch.uint8),
        ((1, 1), torch.float32),
        pytest.param((13, 7), torch.float32, marks=pytest.mark.slow),
        pytest.param((3, 530), torch.uint8, marks=pytest.mark.slow),
        pytest.param((3, 530), torch.float32, marks=pytest.mark.slow),
    ],
)
def test_loss_and_gradient_are_those_of_plain_torch(
    size: tuple[int, int], dtype: torch.dtype
) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(*size, 3, generator=generator)
    photo = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    target = photo.float() / 255
    weights = (0.8 / image.numel(), 0.2 / image.numel())
    value, gradient = ssim_torch.l1_ssim(image, target, weights)
    given = photo if dtype == torch.uint8 else target
    found = gpu_kernels("training.photometric.ssim_gpu").l1_ssim(
        image.to(DEVICE), given.to(DEVICE), weights
    )
    torch.testing.assert_close(found[0].cpu(), value, atol=1e-6, rtol=1e-6)
    scale = gradient.abs().max().item()
    torch.testing.assert_close(found[1].cpu(), gradient, atol=2e-6 * scale, rtol=0)


def test_equal_images_have_no_loss() -> None:
    image = torch.rand(3, 20, 3, generator=torch.Generator().manual_seed(1)).to(DEVICE)
    value, gradient = gpu_kernels("training.photometric.ssim_gpu").l1_ssim(image, image, (0.8, 0.2))
    assert value == 0 and not gradient.any()
