"""One image, forward and backward: the kernels in order, on flat numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.rasterizer.constants import CLAMP_MARGIN
from chronoscene.rasterizer.cpu import sizes as lay
from chronoscene.rasterizer.cpu.bins import BIN_PHASES
from chronoscene.rasterizer.cpu.bins import bin_gaussians as bin_all
from chronoscene.rasterizer.cpu.composite import FORWARD_NUMBERS, composite
from chronoscene.rasterizer.cpu.composite_backward import BACKWARD_NUMBERS, composite_backward
from chronoscene.rasterizer.cpu.project_backward import add_rows, project_backward
from chronoscene.rasterizer.cpu.simd import LANES
from chronoscene.rasterizer.cpu.sort import DIGIT_BITS
from chronoscene.rasterizer.cpu.thread_pool import launch, threads
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

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array, Array]:
        """In the order that kernels want."""
        return self.means, self.quats, self.scales, self.opacities, self.colors


@dataclass(slots=True)
class Binned:
    """What the forward pass leaves for the backward pass, in a workspace."""

    keys: Array
    records: Array
    numbering: tuple[Array, Array]
    """First row of each Gaussian in its chunk, first row of each chunk and the end of all."""
    tile_starts: Array
    tile_stops: Array
    tile_order: Array
    entries: tuple[Array, Array, Array]
    """Gaussian, blocks and row of each (Gaussian, tile) pair, by tile, then by depth; with room
    beyond the last."""
    total: int
    """How many entries there are."""
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
    rows = np.asarray(viewmat[:3, :3])
    camera[lay.ROTATION : lay.ROTATION + 9] = rows.reshape(-1)
    cofactors = np.cross(np.roll(rows, -1, axis=0), np.roll(rows, -2, axis=0))
    camera[lay.COFACTORS : lay.COFACTORS + 9] = cofactors.reshape(-1)
    centre = _centre(viewmat)
    camera[lay.CENTRE : lay.CENTRE + 3] = centre
    camera[lay.CENTRE_REST : lay.CENTRE_REST + 3] = centre - camera[lay.CENTRE : lay.CENTRE + 3]
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


def _centre(viewmat: Array) -> Array:
    """Where the camera stands, also if rounding has left the rotation not quite one."""
    try:
        return -np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
    except np.linalg.LinAlgError:  # nan: all is culled
        return np.full(3, np.nan)


def _parts(count: int) -> int:
    """Into how many parts a list is cut: several for each worker, so that one who comes late or
    has the hard ones holds up nobody, but not so many that their counts outweigh the list."""
    return max(1, min(4 * threads(), 64, count // 2048))


def bin_gaussians(
    workspace: Workspace, scene: Gaussians, view: View, visible: tuple[Array, Array, Array]
) -> Binned:
    """Project, sort and list by tile; ``visible`` receives means2d, radii (as bits), depths."""
    n, w = scene.opacities.size, workspace.array
    chunks, parts = max(1, n // lay.CHUNK), _parts(n)
    records, keys = w("records", n * lay.RECORD, np.float32), w("keys", n, np.int32)
    numbering = (w("row_starts", n, np.int32), w("row_bases", chunks + 1, np.int64))
    sorting = (
        w("digits", parts << DIGIT_BITS, np.int64).reshape(parts, -1),
        w("pairs", n, np.int64),
        w("spare", n, np.int64),
        np.zeros(4, np.int64),
    )
    ends, tile_starts = np.empty(parts, np.int64), w("tile_starts", view.tiles + 1, np.int64)
    tile_order = w("tile_order", view.tiles, np.int32)
    while True:
        starts = np.arange(parts + 1) * int(workspace.pairs_per_gaussian * (n // parts + 1))
        listed, entries = _lists(workspace, int(starts[-1]))
        counts = w("tile_counts", parts * view.tiles, np.int64).reshape(parts, -1)
        launch(
            bin_all,
            max(chunks, parts),
            scene.arrays,
            view.camera,
            (view.width, view.height, view.tiles_x),
            (records, records.view(np.int32)),
            keys,
            numbering,
            visible,
            sorting,
            (starts, ends),
            (counts, tile_starts, tile_order, listed, entries),
            phases=BIN_PHASES,
        )
        if sorting[3][3] == 0:
            break
        # A part has at most all rows; this is asked for once, then remembered.
        needed = numbering[1][-1] / (n // parts + 1)
        workspace.pairs_per_gaussian = min(needed, 4 * workspace.pairs_per_gaussian)
        sorting[3][3] = 0
    total, pixels = int(tile_starts[-1]), view.tiles * lay.TILE_PIXELS
    planes = (w("transmittance", pixels, np.float32), w("last", pixels, np.int32))
    tile_stops = w("tile_stops", view.tiles, np.int64)
    return Binned(
        keys, records, numbering, tile_starts, tile_stops, tile_order, entries, total, planes
    )


def _lists(
    workspace: Workspace, room: int
) -> tuple[tuple[Array, Array, Array, Array], tuple[Array, Array, Array]]:
    """Memory for (Gaussian, tile) pairs by part, and by tile."""
    w = workspace.array
    listed = (
        w("list_tile", room, np.int32),
        w("list_gaussian", room, np.int32),
        w("list_blocks", room, np.uint64),
        w("list_row", room, np.int32),
    )
    entries = (
        w("entry_gaussian", room + _MARGIN, np.int32),
        w("entry_blocks", room, np.uint64),
        w("entry_row", room + _MARGIN, np.int32),
    )
    return listed, entries


def render(
    workspace: Workspace,
    binned: Binned,
    view: View,
    background: Array,
    image: Array,
    alphas: Array,
) -> None:
    """Composite the three channels in the records."""
    workers = threads()
    states = workspace.array("forward", workers * FORWARD_NUMBERS, np.float32)
    launch(
        composite,
        view.tiles,
        view.width,
        view.height,
        binned.tile_starts,
        binned.tile_stops,
        binned.tile_order,
        binned.entries[0],
        binned.entries[1],
        binned.records,
        binned.planes,
        states.reshape(workers, -1),
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
    workers, count = threads(), int(binned.numbering[1][-1])
    states = workspace.array("backward", workers * BACKWARD_NUMBERS, np.float32)
    rows = workspace.array("rows", (count + 1) * lay.RECORD, np.float32)  # see project.py
    touched = workspace.array("touched", count + 1, np.uint8)
    touched[:] = 0
    launch(
        composite_backward,
        view.tiles,
        view.width,
        view.height,
        binned.tile_starts,
        binned.tile_stops,
        binned.tile_order,
        binned.entries,
        binned.records,
        binned.planes,
        states.reshape(workers, -1),
        background,
        image_grad,
        alpha_grad,
        touched,
        rows,
    )
    return touched, rows


def transmittance(binned: Binned, view: View) -> Array:
    """What light is left at each pixel, with more digits than 1 - opacity has. [H, W]"""
    tiles_y = view.tiles // view.tiles_x
    # By tile, block, row and column.
    plane = binned.planes[0].reshape(tiles_y, view.tiles_x, lay.BLOCKS, lay.BLOCKS, 4, 4)
    rows = plane.transpose(0, 2, 4, 1, 3, 5).reshape(tiles_y * lay.TILE, view.tiles_x * lay.TILE)
    return rows[: view.height, : view.width]


def sum_rows(binned: Binned, touched: Array, rows: Array, sums: Array) -> None:
    """Add the rows to 16 numbers of each Gaussian."""
    chunks = binned.numbering[1].size - 1
    launch(add_rows, chunks, binned.numbering, touched, rows, sums)


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
        depth_gradients: d loss / d z-depth of each Gaussian, or nothing.
    """
    if isinstance(summed, tuple):
        touched, rows = summed
        sums = np.zeros(threads() * lay.RECORD * LANES, np.float32)
    else:
        touched, rows, sums = np.empty(0, np.uint8), np.empty(0, np.float32), summed
    launch(
        project_backward,
        binned.numbering[1].size - 1,
        scene.arrays,
        depth_gradients,
        view.camera,
        binned.keys,
        binned.numbering,
        touched,
        rows,
        sums,
        grads,
    )
