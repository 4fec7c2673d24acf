"""Mixtures of extremes that drawing at random has found, cut down to the Gaussians that count.

In most of them the CPU backend once lost digits that the inputs have: along an ellipse that the
image cuts short, in the rounding of a unit quaternion, in what light is left. Three are
mostly rounding: there the inputs themselves have few digits for a radius or a gradient. In the last
two the tests were wrong: their loss lost the digits (`comparison._loss_weights`), or the two sides
counted other pixels (`comparison.counted_pixels`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .scenes import SmallScene


def _mixture(
    size: tuple[int, int],
    camera: tuple[float, ...],
    background: tuple[float, ...],
    *gaussians: Any,
    render_depth: bool = False,
) -> SmallScene:
    """From (width, height), (fx, fy, cx, cy), a colour and rows of (mean, quaternion, scales,
    opacity, colour)."""
    fx, fy, cx, cy = camera
    columns = (np.array(column, np.float32) for column in zip(*gaussians, strict=True))
    means, quats, scales, opacities, colors = columns
    return SmallScene(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=colors,
        viewmats=np.eye(4, dtype=np.float32)[None],
        Ks=np.array([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], np.float32),
        width=size[0],
        height=size[1],
        backgrounds=np.array([background], np.float32),
        render_depth=render_depth,
    )


FOUND: dict[str, SmallScene] = {
    "a needle along a row, far beside the image": _mixture(
        (1, 15),
        (32.6865, 1.0, -441.3294, -0.9486),
        (0.2, 0.4, 0.6),
        ((13.5, 0.0, 1.0), (0.0, 1.0, 1.0, 1.0), (1.0, 1e-8, 1e-7), 0.9, (0.8, 0.3, 0.1)),
    ),
    "a needle along a row of the image": _mixture(
        (4, 28),
        (1000.0, 3.0, 0.1, 0.0),
        (0.3, 0.2, 0.4),
        ((0.0323, 0.0, 26.0), (0.94, 0.83, -0.87, -0.72), (7e-6, 6e-6, 30.0), 0.4, (0.2, 0.2, 0.2)),
    ),
    "a needle along a row, seen from its end": _mixture(
        (8, 32),
        (55000.0, 1.0, 817.0, -20.1),
        (0.3, 0.7, 0.1),
        ((-0.37, 1300.0, 25.0), (1.0, 0.0, -1.0, -1.0), (1e-4, 0.02, 300.0), 1.0, (1.0, 1.0, 0.8)),
    ),
    "a needle almost on the line of sight": _mixture(
        (27, 27),
        (131.6, 1224.0, 310.3, 84.89),
        (0.8, 0.07, 2e-16),
        (
            (-0.176, -0.00477, 0.0794),
            (0.922, 0.922, 0.922, 0.922),
            (5e-5, 5e-5, 500.0),
            0.999,
            (0.01, 0.6, 0.7),
        ),
    ),
    "a needle of 2e6 by 30 pixels": _mixture(
        (6, 18),
        (100000.0, 2.07, -354.7, -2.665),
        (0.5, 1.0, 0.01),
        (
            (0.001863, 1.695, 0.5225),
            (-1.0, 1.1, 1.1, -0.78),
            (5e-7, 2e-8, 10.0),
            0.7,
            (0.2, 1.0, 0.1),
        ),
    ),
    "a needle 1e9 pixels long": _mixture(
        (30, 6),
        (60000.0, 2.0, -1000.0, 4.0),
        (0.5, 0.0, 0.04),
        (
            (0.0005, 0.009, 0.03),
            (-1.0, -1.0, -1.0, 0.8),
            (2e-6, 300.0, 1e-8),
            0.059,
            (0.1, 1.0, 0.7),
        ),
    ),
    "an axis at right angles to a row of the image": _mixture(
        (17, 11),
        (80000.0, 80000.0, 300.0, 90.0),
        (0.6, 0.6, 0.6),
        (
            (-0.04, -0.009, 10.0),
            (0.01, -0.09, 0.9, 0.9),
            (0.5, 3000.0, 2e-5),
            5.0,
            (0.7, 0.07, 0.5),
        ),
    ),
    "a needle at right angles to the columns": _mixture(
        (3, 19),
        (100.0, 4000.0, 6e-5, 4e-12),
        (0.01, 0.8, 0.6),
        (
            (0.0007, 0.001, 0.6),
            (1.06, -0.436, -2.86e-16, 0.969),
            (9e-7, 2000.0, 1e-6),
            0.9,
            (0.9, 0.5, 1.0),
        ),
    ),
    "a needle at right angles to the rows, near the plane": _mixture(
        (5, 5),
        (50000.0, 2.0, 0.01, 0.3),
        (0.3, 0.1, 0.7),
        (
            (2e-6, 0.04, 0.02),
            (-0.77, 0.77, -0.77, -0.77),
            (1000.0, 0.01, 0.0009),
            1.0,
            (0.3, 0.3, 0.3),
        ),
    ),
    "little light left of a background": _mixture(
        (1, 7),
        (60.0, 500.0, 1000.0, -700.0),
        (1.0, 0.9, 2e-16),
        ((-22.7, 1.92, 1.33), (0.0, 0.8, 0.8, 0.8), (10.0, 10.0, 10.0), 1.0, (0.1, 0.07, 0.2)),
        (
            (-17.1, 1.44, 1.0),
            (-1.0, 0.2, 0.2, 0.2),
            (10.0, 10.0, 10.0),
            0.585346,
            (0.06, 0.06, 0.0),
        ),
        (
            (-5.67, 0.479, 0.333),
            (-0.01, 1e-6, 1.0, 1.0),
            (9000.0, 10.0, 1e-8),
            0.585346,
            (0.7, 0.06, 0.6),
        ),
    ),
    "a dark image behind a cap": _mixture(
        (3, 1),
        (72800.0, 18.7, 763.0, 55.4),
        (0.6, 0.6, 0.4),
        (
            (-0.004525, -1.279, 0.4341),
            (-1.0, -1.0, -1.0, -1.0),
            (0.119, 0.119, 0.119),
            0.3,
            (1e-5, 1e-5, 1e-5),
        ),
        (
            (-0.007302, -2.054, 0.697),
            (-0.7, -0.7, -0.7, -0.7),
            (0.119, 0.119, 0.119),
            1.0,
            (1e-5, 1e-5, 1e-5),
        ),
    ),
    "a large depth behind a cap": _mixture(
        (26, 30),
        (100000.0, 2.0, -1000.0, 9.0),
        (0.3, 0.2, 0.3),
        (
            (0.000122, -0.0924, 0.0126),
            (0.6, -0.6, 0.8, 0.8),
            (40.0, 40.0, 40.0),
            0.026976,
            (0.1, 0.8, 1e-5),
        ),
        ((0.00425, 5.72, 0.443), (0.8, 0.8, 0.8, 0.8), (40.0, 40.0, 1.0), 1.0, (1e-5, 0.7, 1e-5)),
        (
            (766.0, -315000.0, 79800.0),
            (1.0, 0.0, 0.003, 0.0),
            (40.0, 40.0, 40.0),
            0.42028,
            (1e-5, 1e-5, 1e-5),
        ),
        render_depth=True,
    ),
    "an axis whose angle to a row is mostly rounding": _mixture(
        (1, 3),
        (53884.98, 11037.035, 622.2686, 983.1049),
        (0.6, 0.1, 0.3),
        (
            (-0.019391224, -0.14950514, 1.6808931),
            (0.1964447, -1.1888857, 0.26600957, -1.1888857),
            (3557.064, 3.316394e-6, 4.312318e-8),
            0.999,
            (0.2, 0.4, 0.8),
        ),
    ),
    "the middle of the only pixel": _mixture(
        (1, 1),
        (10.32786, 100000.0, -93.52193, 936.4799),
        (0.3, 1.0, 1e-4),
        (
            (1119.37, -1.151542, 122.9574),
            (0.0, 1.0, 3e-5, -6e-16),
            (1.0, 1.0, 0.1),
            0.6,
            (0.2, 0.4, 0.9),
        ),
    ),
    "a pancake seen edge-on along the rows": _mixture(
        (7, 13),
        (8000.0, 1.0, -500.0, 0.0),
        (0.09, 0.09, 0.09),
        (
            (0.1, 0.0, 2.0),
            (0.7206081, 0.7206081, 0.7206081, 0.7206081),
            (1e-4, 3000.0, 3000.0),
            1.0,
            (0.3, 0.8, 0.5),
        ),
    ),
    "a wall whose depth is weighed with a sum of zero": _mixture(
        (4, 29),
        (10000.0, 10000.0, 0.0, 0.0),
        (0.0, 0.5, 0.5),
        ((-0.002, -0.0111432, 10.0), (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 1.0, (0.0, 0.0, 0.0)),
        render_depth=True,
    ),
    "a wall as opaque as depth must be to be compared": _mixture(
        (5, 4),
        (30.0, 30.0, 2.0, 2.0),
        (0.3, 0.5, 0.7),
        ((0.0, 0.0, 3.0), (1.0, 0.0, 0.0, 0.0), (1000.0, 1000.0, 1.0), 0.1, (0.9, 0.2, 0.4)),
        render_depth=True,
    ),
}
