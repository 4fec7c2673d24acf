"""One image, forward and backward: the kernels in order, on flat numpy arrays.

Their buffers are in a `Workspace`, which is kept between calls: the first touch of fresh memory can
cost more than rendering. Nothing may rely on what an earlier call left in it.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from chronoscene.kernels.thread_pool import launch, num_workers
from chronoscene.rasterizer.cpu import bins, layout
from chronoscene.rasterizer.cpu.composite import FORWARD_NUMBERS, composite
from chronoscene.rasterizer.cpu.composite_backward import BACKWARD_NUMBERS, composite_backward
from chronoscene.rasterizer.cpu.layout import LANES, AnyArray, View
from chronoscene.rasterizer.cpu.project_backward import add_rows, project_backward
from chronoscene.rasterizer.cpu.sort import DIGIT_BITS

Gaussians = tuple[AnyArray, AnyArray, AnyArray, AnyArray, AnyArray]
"""Means, quats, scales, opacities and colors of `layout.LANES` Gaussians or more, flat float32."""

_GROWTH = 1.25
_PAIRS_PER_GAUSSIAN = 3
"""Room for (Gaussian, tile) pairs at first; most Gaussians touch one or two tiles. Memory that is
not used is not touched."""
_LIST_GROWTH = 4
_MAX_ATTEMPTS = 64
"""More than 64-bit numbers of pairs can need: room grows by `_LIST_GROWTH` each time."""
_MAX_FREE_WORKSPACES = 4
_CACHE_LINE = 64
_MARGIN = 16  # Entries that may be read past the end, to fetch records ahead

_free: list[Workspace] = []
_lock = threading.Lock()


class Workspace:
    """Named arrays of one rendering, forward and backward. They only grow."""

    def __init__(self) -> None:
        self._arrays: dict[str, AnyArray] = {}
        self.max_pairs = 0
        """Most (Gaussian, tile) pairs that an image has needed room for in one part of its list."""

    def array(self, name: str, size: int, dtype: type) -> AnyArray:
        """Array of ``size`` elements with any content."""
        have = self._arrays.get(name)
        if have is None or have.size < size:
            capacity = size if have is None else max(size, int(have.size * _GROWTH))
            have = self._arrays[name] = _aligned(capacity, dtype)
        return have[:size]


def _aligned(size: int, dtype: type) -> AnyArray:
    """Uninitialised array that begins on a cache line, so that no vector straddles two."""
    count = size * np.dtype(dtype).itemsize
    raw = np.empty(count + _CACHE_LINE, np.uint8)
    start = -raw.ctypes.data % _CACHE_LINE
    return raw[start : start + count].view(dtype)


def clear_workspaces() -> None:
    """Give the memory of unused workspaces back to the system."""
    with _lock:
        _free.clear()


class Rendering:
    """One image on its way through the kernels, forward and backward.

    What the forward pass leaves for the backward pass is in a workspace, which goes back to the
    free ones when this is dropped.
    """

    keys: AnyArray
    records: AnyArray
    numbering: tuple[AnyArray, AnyArray]
    """First row of each Gaussian in its chunk, first row of each chunk and the end of all."""
    tiles: tuple[AnyArray, AnyArray, AnyArray]
    """First entry of each tile and the end of all, where its compositing stopped, and the order in
    which to take tiles."""
    entries: tuple[AnyArray, AnyArray]
    """The (Gaussian, tile) pairs by tile, then by depth, with room beyond the last: the same memory
    as uint64 and as int32, see `layout`."""
    planes: tuple[AnyArray, AnyArray]
    """Transmittance, and the end of the entries that count, of each pixel, by tile."""

    def __init__(self, view: View) -> None:
        self.view = view
        with _lock:
            self.workspace = _free.pop() if _free else Workspace()

    def __del__(self) -> None:
        with _lock:
            if len(_free) < _MAX_FREE_WORKSPACES:
                _free.append(self.workspace)

    def bin_gaussians(
        self, gaussians: Gaussians, visible: tuple[AnyArray, AnyArray, AnyArray]
    ) -> None:
        """Project, sort and list by tile; ``visible`` receives means2d, radii (as bits), depths."""
        n, view, w = gaussians[3].size, self.view, self.workspace.array
        # Several parts for each worker, so that one who comes late or has the hard ones holds up
        # nobody, but not so many that their counts outweigh the list.
        parts = max(1, min(4 * num_workers(), 64, n // 2048))
        chunks = max(1, n // layout.CHUNK)
        self.records, self.keys = (
            w("records", n * layout.RECORD, np.float32),
            w("keys", n, np.int32),
        )
        self.numbering = (w("row_starts", n, np.int32), w("row_bases", chunks + 1, np.int64))
        sorting = (
            w("digits", parts << DIGIT_BITS, np.int64).reshape(parts, -1),
            w("pairs", n, np.int64),
            w("spare", n, np.int64),
            np.zeros(4, np.int64),
        )
        ends, tile_starts = np.empty(parts, np.int64), w("tile_starts", view.tiles + 1, np.int64)
        tile_order = w("tile_order", view.tiles, np.int32)
        room = max(_PAIRS_PER_GAUSSIAN * (n // parts + 1), self.workspace.max_pairs)
        for _ in range(_MAX_ATTEMPTS):
            listed = self._make_lists(room * parts)
            counts = w("tile_counts", parts * view.tiles, np.int64).reshape(parts, -1)
            launch(
                bins.bin_gaussians,
                max(chunks, parts),
                gaussians,
                view.camera,
                (view.width, view.height, view.tiles_x),
                (self.records, self.records.view(np.int32)),
                self.keys,
                self.numbering,
                visible,
                sorting,
                (np.arange(parts + 1) * room, ends),
                (counts, tile_starts, tile_order, listed, self.entries),
                phases=bins.BIN_PHASES,
            )
            if sorting[3][3] == 0:
                break
            # A part has at most all pairs; this is asked for once, then remembered.
            pairs = int(self.numbering[1][-1])
            room = self.workspace.max_pairs = min(pairs, _LIST_GROWTH * room)
            sorting[3][3] = 0
        else:
            raise AssertionError(
                f"no room for {pairs} pairs of {n} Gaussians and {view.tiles} tiles "
                f"in {parts} lists of {room} pairs"
            )
        self.tiles = (tile_starts, w("tile_stops", view.tiles, np.int64), tile_order)
        pixels = view.tiles * layout.TILE_PIXELS
        self.planes = (w("transmittance", pixels, np.float32), w("last", pixels, np.int32))

    def _make_lists(self, room: int) -> tuple[AnyArray, tuple[AnyArray, AnyArray]]:
        """Memory for (Gaussian, tile) pairs by part, which is returned, and by tile."""
        w = self.workspace.array
        entries = w("entries", layout.ENTRY_BLOCKS * (room + _MARGIN), np.uint64)
        self.entries = entries, entries.view(np.int32)
        listed = w("listed", layout.ENTRY_BLOCKS * room, np.uint64)
        return w("list_tile", room, np.int32), (listed, listed.view(np.int32))

    def _launch_tiles(self, kernel: Any, scratch: tuple[str, int], *args: Any) -> None:
        """Run a kernel over the tiles, with scratch numbers for each worker."""
        workers, (name, numbers) = num_workers(), scratch
        states = self.workspace.array(name, workers * numbers, np.float32).reshape(workers, -1)
        size = (self.view.width, self.view.height)
        frame = (size, self.tiles, self.entries, self.records, self.planes)
        launch(kernel, self.view.tiles, *frame, states, *args)

    def composite(
        self, background: AnyArray, image: AnyArray, alphas: AnyArray, depth: AnyArray | None = None
    ) -> None:
        """Composite the three channels in the records, and the depth where it is to be written."""
        written = (image, alphas, () if depth is None else (depth,))
        self._launch_tiles(composite, ("forward", FORWARD_NUMBERS), background, *written)

    def composite_backward(
        self,
        background: AnyArray,
        image_grad: AnyArray,
        alpha_grad: AnyArray,
        depth_grad: AnyArray | None = None,
        *,
        absgrad: bool,
    ) -> tuple[AnyArray, AnyArray]:
        """Sums over pixels by entry: (touched, rows); of absolute gradients too if asked for."""
        count = int(self.numbering[1][-1])
        # One more than there are: `project_backward` may read the row after the last.
        rows = self.workspace.array("rows", (count + 1) * layout.RECORD, np.float32)
        touched = self.workspace.array("touched", count + 1, np.uint8)
        touched[:] = 0
        scratch = ("backward", BACKWARD_NUMBERS)
        grads, out = (image_grad, alpha_grad), (touched, rows)
        options = (() if depth_grad is None else (depth_grad,), (1,) if absgrad else ())
        self._launch_tiles(composite_backward, scratch, background, grads, *options, out)
        return touched, rows

    def transmittance(self) -> AnyArray:
        """Transmittance of each pixel, with more digits than 1 - opacity has. [H, W]"""
        tiles_x, tiles_y = self.view.tiles_x, self.view.tiles // self.view.tiles_x
        # By tile, block, row and column.
        plane = self.planes[0].reshape(tiles_y, tiles_x, layout.BLOCKS, layout.BLOCKS, 4, 4)
        rows = plane.transpose(0, 2, 4, 1, 3, 5)
        rows = rows.reshape(tiles_y * layout.TILE, tiles_x * layout.TILE)
        return rows[: self.view.height, : self.view.width]

    def sum_rows(self, touched: AnyArray, rows: AnyArray, sums: AnyArray) -> None:
        """Add the rows to 16 numbers of each Gaussian."""
        launch(add_rows, self.numbering[1].size - 1, self.numbering, touched, rows, sums)

    def gaussian_gradients(
        self,
        gaussians: Gaussians,
        summed: tuple[AnyArray, AnyArray] | AnyArray,
        grads: tuple[AnyArray, ...],
    ) -> None:
        """Gradients of the inputs, written to ``grads``, from what was summed over pixels.

        Args:
            gaussians: As in the forward pass.
            summed: (touched, rows) of one rendering, or 16 numbers of each Gaussian.
            grads: Of means, quats, scales, opacities, colors and means2d.
        """
        if isinstance(summed, tuple):
            touched, rows = summed
            sums = np.zeros(num_workers() * layout.RECORD * LANES, np.float32)
        else:
            touched, rows, sums = np.empty(0, np.uint8), np.empty(0, np.float32), summed
        launch(
            project_backward,
            self.numbering[1].size - 1,
            gaussians,
            self.view.camera,
            self.keys,
            self.numbering,
            touched,
            rows,
            sums,
            grads,
        )
