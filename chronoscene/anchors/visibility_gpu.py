"""The rule of `visibility` as a kernel for a GPU."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 256


def marked(
    anchors: Tensor,
    log_scales: Tensor,
    camera: Tensor,
    *,
    size: tuple[int, int],
    depths: tuple[float, float],
    extent: float,
    blur: float,
    slack: float,
) -> Tensor:
    """Return True for visible anchors. bool [A]

    Args:
        anchors: Positions. float32 [A, 3]
        log_scales: Columns 0..2 are the logarithm of the anchor's extent. float32 [A, 3 or more]
        camera: The first three rows of the pose, then fx, fy, cx, cy. float64 [16]
        size: Width and height in pixels.
        depths: Of the nearest and the farthest anchor.
        extent: Half width of a footprint in standard deviations.
        blur: Variance in pixels squared that is added.
        slack: See `visibility`.
    """
    mask = torch.empty(len(anchors), dtype=torch.bool, device=anchors.device)
    if len(anchors):
        _mark[(triton.cdiv(len(anchors), BLOCK),)](
            anchors.contiguous(), log_scales.contiguous(), camera, mask, len(anchors),
            *map(float, size), *depths, extent, blur, slack,
            COLUMNS=log_scales.shape[1], BLOCK=BLOCK,
        )  # fmt: skip
    return mask


@triton.jit
def _mark(  # type: ignore[no-untyped-def]
    anchors, log_scales, camera, mask, count, width, height, near, far, extent, blur, slack,
    COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    px = tl.load(anchors + 3 * i, mask=inside, other=0.0).to(tl.float64)
    py = tl.load(anchors + 3 * i + 1, mask=inside, other=0.0).to(tl.float64)
    pz = tl.load(anchors + 3 * i + 2, mask=inside, other=0.0).to(tl.float64)
    z = _turned(camera + 8, px, py, pz)
    seen = (z >= near) & (z <= far)
    # The slope of a ray is held near the image before the projection is linearised, as in 3DGS.
    for axis in tl.static_range(2):
        size = width if axis == 0 else height
        focal, centre = tl.load(camera + 12 + axis), tl.load(camera + 14 + axis)
        ratio = _turned(camera + 4 * axis, px, py, pz) / z
        low, high = -(centre + slack * size) / focal, ((1 + slack) * size - centre) / focal
        slope = tl.minimum(tl.maximum(ratio, low), high)
        variance = tl.zeros([BLOCK], tl.float64) + blur
        for c in tl.static_range(3):
            size_log = tl.load(log_scales + COLUMNS * i + c, mask=inside, other=0.0)
            spread = tl.exp(2 * size_log.to(tl.float64))
            own, along = tl.load(camera + 4 * axis + c), tl.load(camera + 8 + c)
            change = focal / z * (own - slope * along)
            variance += spread * change * change
        radius = tl.ceil(extent * tl.sqrt(variance))
        place = focal * ratio + centre
        seen = seen & (place + radius > 0) & (place - radius < size)
    tl.store(mask + i, seen, mask=inside)


@triton.jit
def _turned(row, x, y, z):  # type: ignore[no-untyped-def]
    """Product of a row of the pose and of points."""
    one, two, three, four = tl.load(row), tl.load(row + 1), tl.load(row + 2), tl.load(row + 3)
    return one * x + two * y + three * z + four
