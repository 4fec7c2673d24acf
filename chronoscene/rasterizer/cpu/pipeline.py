"""One image, forward and backward: the kernels in order, on flat numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from chronoscene.rasterizer.constants import CLAMP_MARGIN
from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.bins import (
    bound_pairs,
    list_pairs,
    scatter_pairs,
    tile_offsets,
)
from chronoscene.rasterizer.cpu.composite import (
    BACKWARD_NUMBERS,
    FORWARD_NUMBERS,
    composite,
    composite_backward,
)
from chronoscene.rasterizer.cpu.project import add_rows, project, project_backward
from chronoscene.rasterizer.cpu.simd import LANES
from chronoscene.rasterizer.cpu.sort import DIGIT_BITS, sort_by_depth
from chronoscene.rasterizer.cpu.workspace import Workspace

Array = NDArray[Any]

_MARGIN = 16
"""Entries that may be read past the end, to fetch records ahead."""


@dataclass(frozen=True, slots=True)
class View:
    """Where one image is taken from."""

    camera: Array
    """`layout.CAMERA` numbers, float32."""
    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        return -(-self.width // lay.TILE)

    @property
    def tiles(self) -> int:
        return self.tiles_x * -(-self.height // lay.TILE)


@dataclass(frozen=True, slots=True)
class Gaussians:
    """Flat float32 arrays of at least `simd.LANES` Gaussians."""

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array


@dataclass(slots=True)
class Binned:
    """What the forward pass leaves for the backward pass, in a workspace."""

    keys: Array
    records: Array
    numbering: tuple[Array, Array]
    """First row of each Gaussian in its chunk, first row of each chunk and the end of all."""
    tile_starts: Array
    tile_stops: Array
    entries: tuple[Array, Array, Array]
    """Gaussian, blocks and row of each (Gaussian, tile) pair, by tile, then by depth."""
    planes: tuple[Array, Array]


def make_view(
    viewmat: Array,
    K: Array,
    width: int,
    height: int,
    near: float,
    far: float,
    eps2d: float,
) -> View:
    """Numbers of a camera as the kernels want them."""
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x, margin_y = (
        CLAMP_MARGIN * 0.5 * width / fx,
        CLAMP_MARGIN * 0.5 * height / fy,
    )
    camera = np.zeros(lay.CAMERA, np.float32)
    camera[lay.ROTATION : lay.ROTATION + 9] = viewmat[:3, :3].reshape(-1)
    camera[lay.TRANSLATION : lay.TRANSLATION + 3] = viewmat[:3, 3]
    camera[lay.FX], camera[lay.FY], camera[lay.CX], camera[lay.CY] = fx, fy, cx, cy
    camera[lay.X_MIN], camera[lay.X_MAX] = (
        -cx / fx - margin_x,
        (width - cx) / fx + margin_x,
    )
    camera[lay.Y_MIN], camera[lay.Y_MAX] = (
        -cy / fy - margin_y,
        (height - cy) / fy + margin_y,
    )
    camera[lay.NEAR], camera[lay.FAR], camera[lay.BLUR] = near, far, eps2d
    return View(camera, width, height)


def _counter() -> Array:
    return np.zeros(1, np.int64)


def bin_gaussians(
    workspace: Workspace,
    scene: Gaussians,
    view: View,
    visible: tuple[Array, Array, Array],
) -> Binned:
    """Project, sort and list by tile; ``visible`` receives means2d, radii (as bits), depths."""
    threads, n, w = numba.get_num_threads(), scene.opacities.size, workspace.array
    records, keys = w("records", n * lay.RECORD, np.float32), w("keys", n, np.int32)
    row_starts, chunk_rows = (
        w("row_starts", n, np.int32),
        np.empty(max(1, n // lay.CHUNK), np.int64),
    )
    project(
        threads,
        _counter(),
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        scene.colors,
        view.camera,
        view.width,
        view.height,
        records,
        records.view(np.int32),
        keys,
        (row_starts, chunk_rows),
        visible,
    )
    numbering = (row_starts, np.concatenate([[0], np.cumsum(chunk_rows)]))
    digits = w("digits", threads << DIGIT_BITS, np.int64).reshape(threads, -1)
    pairs, spare = w("pairs", n, np.int64), w("spare", n, np.int64)
    count, in_spare = sort_by_depth(threads, keys, digits, pairs, spare)
    order = (spare if in_spare else pairs)[:count]
    tile_starts, entries = _bin_pairs(workspace, view, order, records, numbering[1])
    pixels = view.tiles * lay.TILE_PIXELS
    planes = (w("transmittance", pixels, np.float32), w("last", pixels, np.int32))
    tile_stops = w("tile_stops", view.tiles, np.int64)
    return Binned(keys, records, numbering, tile_starts, tile_stops, entries, planes)


def _bin_pairs(
    workspace: Workspace, view: View, order: Array, records: Array, row_bases: Array
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Start of each tile, and its entries, from the Gaussians in the order of drawing."""
    threads, w = numba.get_num_threads(), workspace.array
    counts = w("counts", threads * view.tiles, np.int64).reshape(threads, -1)
    scene = (records, records.view(np.int32), row_bases)
    # Most rectangles have one or two tiles; exact bounds cost another pass over the records.
    room = np.full(threads, 3 * (order.size // threads + 1), np.int64)
    while True:
        starts = np.concatenate([[0], np.cumsum(room)])
        names = (
            ("tile", np.int32),
            ("gaussian", np.int32),
            ("blocks", np.uint64),
            ("row", np.int32),
        )
        listed = tuple(w("list_" + name, int(starts[-1]), kind) for name, kind in names)
        ends = np.empty(threads, np.int64)
        list_pairs(
            threads,
            order,
            order.size,
            starts,
            ends,
            (view.width, view.tiles_x),
            scene,
            counts,
            listed,
        )
        if (ends <= starts[1:]).all():
            break
        bound_pairs(threads, order, order.size, scene[1], room)
    tile_starts = w("tile_starts", view.tiles + 1, np.int64)
    tile_offsets(counts, tile_starts)
    total = int(tile_starts[-1])
    entries = (
        w("entry_gaussian", total + _MARGIN, np.int32),
        w("entry_blocks", total, np.uint64),
        w("entry_row", total, np.int32),
    )
    entries[0][total:] = 0
    scatter_pairs(threads, starts, ends, counts, listed, entries)
    return tile_starts, entries


def render(
    workspace: Workspace,
    binned: Binned,
    view: View,
    background: Array,
    image: Array,
    alphas: Array,
) -> None:
    """Composite the three channels in the records."""
    threads = numba.get_num_threads()
    states = workspace.array("forward", threads * FORWARD_NUMBERS, np.float32)
    composite(
        threads,
        _counter(),
        view.width,
        view.height,
        binned.tile_starts,
        binned.tile_stops,
        binned.entries[0],
        binned.entries[1],
        binned.records,
        binned.planes,
        states.reshape(threads, -1),
        background,
        image,
        alphas,
    )


def render_backward(
    workspace: Workspace,
    binned: Binned,
    view: View,
    background: Array,
    image_grad: Array,
    alpha_grad: Array,
) -> tuple[Array, Array]:
    """Sums over pixels by entry: (touched, rows)."""
    threads, count = numba.get_num_threads(), int(binned.numbering[1][-1])
    states = workspace.array("backward", threads * BACKWARD_NUMBERS, np.float32)
    rows = workspace.array("rows", max(1, count) * lay.RECORD, np.float32)
    touched = workspace.array("touched", max(1, count), np.uint8)
    touched[:] = 0
    composite_backward(
        threads,
        _counter(),
        view.width,
        view.height,
        binned.tile_starts,
        binned.tile_stops,
        binned.entries,
        binned.records,
        binned.planes,
        states.reshape(threads, -1),
        background,
        image_grad,
        alpha_grad,
        touched,
        rows,
    )
    return touched, rows


def sum_rows(binned: Binned, touched: Array, rows: Array, sums: Array) -> None:
    """Add the rows to 16 numbers of each Gaussian."""
    add_rows(
        numba.get_num_threads(),
        _counter(),
        binned.numbering,
        touched,
        rows,
        sums,
    )


def gaussian_gradients(
    binned: Binned,
    scene: Gaussians,
    view: View,
    summed: tuple[Array, Array] | Array,
    depth_gradients: Array,
    grads: tuple[Array, ...],
) -> None:
    """Gradients of the inputs, written to ``grads``, from what was summed over pixels.

    Args:
        summed: (touched, rows) of one rendering, or 16 numbers of each Gaussian.
        depth_gradients: d loss / d z-depth of each Gaussian.
    """
    threads = numba.get_num_threads()
    if isinstance(summed, tuple):
        touched, rows = summed
        sums = np.zeros(threads * lay.RECORD * LANES, np.float32)
    else:
        touched, rows, sums = np.empty(0, np.uint8), np.empty(0, np.float32), summed
    project_backward(
        threads,
        _counter(),
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        depth_gradients,
        view.camera,
        binned.keys,
        binned.numbering,
        touched,
        rows,
        sums,
        grads,
    )
