"""Sizes of a field, and how the kernels lay out its planes and weights in memory.

The kernels see a field at one time, where a plane with time is a line of cells: planes xy, xz and
yz of a level come one after the other, then the lines x, y and z. The hidden layers of the heads
become one matrix, since they share their input. The output layers of all heads but the colour's
become one too, whose blocks act on the hidden units of one head each. Lengths are padded with
zeros.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import NamedTuple

from chronoscene.kernels.matmul import padded
from chronoscene.kernels.vectors import LANES
from chronoscene.training.spherical_harmonics import NUM_BASES

PAIRS = ("xy", "xz", "xt", "yz", "yt", "zt")
"""Axes of the six planes of a level: that of the columns, that of the rows."""
HEADS = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh": 3 * NUM_BASES}
"""Parameters that heads change, and numbers of outputs; those for the colour go basis by basis."""
MIN_EDGE = 1e-6
"""Smallest edge of a box, in units of the training frame: all points may be in one place."""

Corner = tuple[float, float, float]

BLOCK = 64
"""Gaussians whose rows go through the matrix products together; multiple of every ROW_TILE."""
PARTS = 16
"""Partial sums of gradients at most. Fixed, so that sums do not depend on the number of threads."""
SMALL = 16
"""Columns of the outputs of all heads but the colour's, which are 11 at most."""
COLORS = HEADS["sh"]
"""Columns of the colour's: a multiple of every vector."""


@dataclass(frozen=True, slots=True)
class Field:
    """Sizes of a field and the box that it covers. Its tensors are kept beside it, by name."""

    low: Corner
    """Corner of the box, in units of the training frame. Outside, the nearest border counts."""
    high: Corner
    sizes: tuple[int, ...]
    """Cells along each spatial axis, level by level; at least 2."""
    time_cells: int
    """At least 2; the same on all levels."""
    channels: int
    width: int
    """Hidden units of the trunk, and of each head."""
    heads: tuple[str, ...]
    """Some of `HEADS`, in that order; the first three always."""
    offset_unit: float = 1.0
    """Unit in which the head of the positions counts, in units of the training frame."""

    @property
    def scale(self) -> tuple[float, ...]:
        """1 over the edges of the box."""
        edges = zip(self.low, self.high, strict=True)
        return tuple(1 / max(high - low, MIN_EDGE) for low, high in edges)

    @property
    def changed(self) -> tuple[str, ...]:
        """Groups of parameters that a head changes."""
        heads = (name for name in self.heads if name != "sh")
        return (*heads, "sh_dc", "sh_rest") if "sh" in self.heads else tuple(heads)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor; a plane has rows, columns and channels."""
        shapes: dict[str, tuple[int, ...]] = {}
        for level, size in enumerate(self.sizes):
            for pair in PAIRS:
                rows = self.time_cells if pair[1] == "t" else size
                shapes[f"planes.{level}.{pair}"] = (rows, size, self.channels)
        layers = {"trunk": (self.width, len(self.sizes) * self.channels)}
        for head in self.heads:
            layers[f"{head}.hidden"] = (self.width, self.width)
            layers[f"{head}.output"] = (HEADS[head], self.width)
        for name, shape in layers.items():
            shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
        return shapes


class Layout(NamedTuple):
    """Sizes; names ending in ``_pad`` are padded."""

    levels: int
    channels: int
    features: int
    features_pad: int
    width: int
    width_pad: int
    hiddens: int
    """Hidden units of all heads: width_pad each."""
    small: int
    """Hidden units of all heads but the colour's."""
    opacity: bool
    """True if there is a head for the opacity."""
    color: bool


def make_layout(field: Field) -> Layout:
    """Derive all sizes."""
    features, width_pad = len(field.sizes) * field.channels, padded(field.width)
    color = "sh" in field.heads
    hiddens = len(field.heads) * width_pad
    return Layout(
        levels=len(field.sizes),
        channels=field.channels,
        features=features,
        features_pad=padded(features),
        width=field.width,
        width_pad=width_pad,
        hiddens=hiddens,
        small=hiddens - color * width_pad,
        opacity="logit_opacities" in field.heads,
        color=color,
    )


def level_sizes(field: Field) -> list[int]:
    """Numbers of each level at one time: three planes and three lines."""
    return [3 * (size + 1) * size * field.channels for size in field.sizes]


class Planes(NamedTuple):
    """Addresses of a field at one time."""

    values: int
    """Level by level, and LANES more."""
    sizes: int
    """Cells along an axis. int64 [levels]"""
    starts: int
    """First number of each level. int64 [levels]"""
    box: int
    """Low corner, then 1 over the edges. [6]"""


class Weights(NamedTuple):
    """Addresses of the joined weights, or of some of them; ``_t``: transposed."""

    trunk: int
    """[width_pad, features_pad]"""
    trunk_t: int
    trunk_bias: int
    hidden: int
    """[hiddens, width_pad]"""
    hidden_t: int
    hidden_bias: int
    small: int
    """[SMALL, layout.small]"""
    small_t: int
    small_bias: int
    color: int
    """[COLORS, width_pad]"""
    color_t: int
    color_bias: int
    zeros: int
    """Zeros, as many as the longest row has numbers."""


class Gradients(NamedTuple):
    """Addresses of one partial sum: gradients of the planes as in `Planes`, then of the weights."""

    planes: int
    trunk_t: int
    trunk_bias: int
    hidden_t: int
    hidden_bias: int
    small: int
    small_bias: int
    color: int
    color_bias: int


class Work(NamedTuple):
    """Addresses of what one worker works in."""

    rows: int
    """Indices of the Gaussians in the block. int64 [BLOCK]"""
    x: int
    """Features. [BLOCK, features_pad], and some more"""
    trunk: int
    """[BLOCK, width_pad]"""
    hidden: int
    """[BLOCK, hiddens]"""
    small: int
    """Outputs, or their gradients. [BLOCK, SMALL]"""
    colors: int
    """[BLOCK, COLORS]"""
    d_hidden: int
    """[BLOCK, hiddens]"""
    d_trunk: int
    """[BLOCK, width_pad]"""
    d_x: int
    """[BLOCK, features_pad], and some more"""


class Gaussians(NamedTuple):
    """Addresses of parameters, of deformed ones or of gradients; 0 where there is no head."""

    means: int
    log_scales: int
    quats: int
    logit_opacities: int = 0
    sh_dc: int = 0
    sh_rest: int = 0


def weight_shapes(layout: Layout) -> dict[str, tuple[int, ...]]:
    """Shapes of the joined weights, by their names in `Weights`."""
    width = layout.width_pad
    shapes: dict[str, tuple[int, ...]] = {}
    for name, shape in (
        ("trunk", (width, layout.features_pad)),
        ("hidden", (layout.hiddens, width)),
        ("small", (SMALL, layout.small)),
        ("color", (COLORS * layout.color, width)),
    ):
        shapes |= {name: shape, f"{name}_t": shape[::-1], f"{name}_bias": shape[:1]}
    return shapes | {"zeros": (max(layout.hiddens, layout.features_pad),)}


def gradient_shapes(layout: Layout, planes: int) -> dict[str, tuple[int, ...]]:
    """Shapes of `Gradients`; ``planes`` numbers are for the planes."""
    shapes = weight_shapes(layout) | {"planes": (planes + LANES,)}
    return {name: shapes[name] for name in Gradients._fields}


def work_sizes(layout: Layout) -> tuple[int, ...]:
    """Numbers in each of `Work`."""
    features = BLOCK * layout.features_pad + LANES
    return (
        2 * BLOCK,
        features,
        BLOCK * layout.width_pad,
        BLOCK * layout.hiddens,
        BLOCK * SMALL,
        BLOCK * COLORS,
        BLOCK * layout.hiddens,
        BLOCK * layout.width_pad,
        features,
    )


def rows_per_part(count: int) -> int:
    """Gaussians of each partial sum, whole blocks."""
    return max(1, -(-count // (PARTS * BLOCK))) * BLOCK


def numbers(shapes: dict[str, tuple[int, ...]]) -> list[int]:
    """Numbers in arrays of these shapes."""
    return [prod(shape) for shape in shapes.values()]
