"""Layout of weights in the decode kernels, and the sizes that follow from it.

The three heads become one: their first layers side by side (they share the input), their second
layers in one matrix whose blocks act on the hidden units of one head each. The global feature is
equal for all anchors, so its share of the first layer goes into the bias. Lengths are padded with
zeros to `PADDING`.

Outputs are grouped by kind: opacities, scales, quaternions, colours; each offset by offset.
"""

from __future__ import annotations

from typing import NamedTuple

from chronoscene.kernels.matmul import padded
from chronoscene.kernels.vectors import LANES

BLOCK = 64
"""Anchors whose rows go through the matrix products together; multiple of every ROW_TILE. What a
task works in stays in the second-level cache."""
CHUNK = 512
"""Anchors per partial sum of weight gradients. Fixed, so that sums do not depend on the number of
threads."""
MIN_DISTANCE = 1e-12  # Of an anchor from the camera, in world units; nearer, it has no direction
MIN_QUAT_NORM = 1e-12
"""Shorter quaternions carry no direction: they become the identity and get no gradient."""
CYCLE = 3 * LANES  # Three numbers in turn look the same every so many lanes


class Layout(NamedTuple):
    """Sizes; names ending in ``_pad`` are padded."""

    base: int
    period: int
    shared: int
    """G, length of the global feature."""
    features: int
    """Length of base and period feature."""
    inputs: int
    """Length of those and the direction."""
    hidden: int
    """Per head."""
    offsets: int
    """k"""
    features_pad: int
    inputs_pad: int
    hidden_pad: int
    hiddens: int
    """3 hidden_pad"""
    scales_at: int
    """Column of the first scale among the outputs; opacities are at 0."""
    quats_at: int
    colors_at: int
    outputs_pad: int


def make_layout(*, base: int, period: int, shared: int, hidden: int, offsets: int) -> Layout:
    """Derive all sizes."""
    scales_at = padded(offsets)
    quats_at = scales_at + padded(3 * offsets)
    colors_at = quats_at + padded(4 * offsets)
    return Layout(
        base=base,
        period=period,
        shared=shared,
        features=base + period,
        inputs=base + period + 3,
        hidden=hidden,
        offsets=offsets,
        features_pad=padded(base + period),
        inputs_pad=padded(base + period + 3),
        hidden_pad=padded(hidden),
        hiddens=3 * padded(hidden),
        scales_at=scales_at,
        quats_at=quats_at,
        colors_at=colors_at,
        outputs_pad=colors_at + padded(3 * offsets),
    )


class Weights(NamedTuple):
    """Addresses of the joined weights."""

    w1: int
    """[hiddens, features_pad]"""
    w1_t: int
    """[inputs_pad, hiddens]"""
    b1: int
    """[hiddens]"""
    w2: int
    """[outputs_pad, hidden_pad]"""
    w2_t: int
    """[hidden_pad, outputs_pad]"""
    b2: int
    """[outputs_pad]"""
    zeros: int
    """Zeros, as many as the longest row has numbers."""


class Gradients(NamedTuple):
    """Addresses of the gradients of the joined weights, in the same shapes."""

    w1_t: int
    b1: int
    w2: int
    b2: int


class Work(NamedTuple):
    """Addresses of the work space of one task."""

    rows: int
    """Visible anchors in the block. int64 [BLOCK]"""
    counts: int
    """Anchors of the block in which an offset has a gradient; zeros between blocks. int64 [k]"""
    slots: int
    """Pairs of row in the block and Gaussian, of these. int64 [k, BLOCK, 2]"""
    x: int
    """Inputs. [BLOCK, inputs_pad], and some more"""
    hidden: int
    """[BLOCK, hiddens]"""
    raw: int
    """Outputs before activation. [BLOCK, outputs_pad]"""
    d_hidden: int
    """[BLOCK, hiddens]"""
    d_x: int
    """[BLOCK, features_pad]"""
    row: int
    """Row of one anchor: exp(log_scales) of the Gaussians over and over. [2 CYCLE]"""
    opacities: int
    """Gradients of raw opacities, Gaussians of the block one after the other. [BLOCK k + LANES]"""
    scales: int
    """Raw scales, or their gradients. [3 (BLOCK k + LANES)]"""
    quats: int
    """[4 (BLOCK k + LANES)]"""
    colors: int
    """[3 (BLOCK k + LANES)]"""
    factors: int
    """Factors of the scales, or their gradients times the scales.
    [3 (BLOCK k + LANES)]"""


class Head(NamedTuple):
    """Addresses of the weights of one head, or of their gradients."""

    w1: int
    """[hidden, inputs + shared]"""
    b1: int
    w2: int
    """[outputs, hidden]"""
    b2: int


class Anchors(NamedTuple):
    """Addresses of the inputs; see `chronoscene.anchors.decode.DecodeInputs`."""

    anchors: int
    offsets: int
    features: int
    blocks: int
    log_scales: int
    centre: int
    num_anchors: int
    visible: int
    num_visible: int
    used_offsets: int
    """Bits. int64"""
    block_rows: int
    """int64"""
    periods: int
    """Periods of weight other than 0. int64"""
    weights: int
    """Their weights."""
    num_periods: int
    all_periods: int
    """Columns of ``block_rows``."""


class Outputs(NamedTuple):
    """Addresses of the outputs, L active Gaussians."""

    alphas: int
    """Opacities of all offsets. [M k]"""
    starts: int
    """First Gaussian of each visible anchor, and L at the end. int64 [M + 1]"""
    positions: int
    """Position of each Gaussian among all offsets. int64 [L]"""
    means: int
    quats: int
    scales: int
    opacities: int
    colors: int
    inverse_norms: int
    """1 / |q| of the quaternions before they were made unit, 0 without a direction. [L]"""


class OutputGradients(NamedTuple):
    """Addresses of the gradients of the loss with respect to the outputs."""

    means: int
    quats: int
    scales: int
    opacities: int
    colors: int


class AnchorGradients(NamedTuple):
    """Addresses of the gradients with respect to the tensors of the anchors."""

    offsets: int
    features: int
    blocks: int
    """Zeros at first."""
    log_scales: int


def weight_sizes(layout: Layout) -> tuple[int, ...]:
    """Numbers in each of `Weights`."""
    first, second = layout.hiddens, layout.outputs_pad * layout.hidden_pad
    return (
        first * layout.features_pad,
        layout.inputs_pad * first,
        first,
        second,
        second,
        layout.outputs_pad,
        max(layout.hidden_pad, layout.features_pad),
    )


def gradient_sizes(layout: Layout) -> tuple[int, ...]:
    """Numbers in each of `Gradients`."""
    first, second = layout.hiddens, layout.outputs_pad
    return (layout.inputs_pad * first, first, second * layout.hidden_pad, second)


def work_sizes(layout: Layout) -> tuple[int, ...]:
    """Numbers in each of `Work`."""
    return (
        2 * BLOCK,
        2 * layout.scales_at,
        4 * layout.offsets * BLOCK,
        BLOCK * layout.inputs_pad + 2 * LANES,
        BLOCK * layout.hiddens,
        BLOCK * layout.outputs_pad,
        BLOCK * layout.hiddens,
        BLOCK * layout.features_pad,
        2 * CYCLE,
        *(n * (BLOCK * layout.offsets + LANES) for n in (1, 3, 4, 3, 3)),
    )
