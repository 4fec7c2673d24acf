"""Workers wait for each other between the phases of the lists: one of them is held up in turn.

The kernels run as Python in two threads, on arrays of the same sizes. Vectors exist only in
compiled code, so what needs them is compiled by itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba import njit

from chronoscene.rasterizer.cpu import bins, layout, passes, sort
from chronoscene.rasterizer.cpu.project import chunk_range

COUNT, WIDTH, HEIGHT = 3_100, 100, 70  # three chunks, twelve tiles
SECONDS = 20.0


class Phases:
    """Stands in for the counters of a launch; who draws job 0 of a phase is held up there until the
    other worker waits or has returned."""

    def __init__(self, held_up: int) -> None:
        self.held_up = held_up
        self.drawn, self.finished = [0] * bins.BIN_PHASES, [0] * bins.BIN_PHASES
        self.lock, self.blocked = threading.Lock(), threading.Event()

    def draw(self, control: Any, phase: int) -> int:
        with self.lock:
            job = self.drawn[phase]
            self.drawn[phase] += 1
        if phase == self.held_up and job == 0:
            self.blocked.wait(SECONDS)
        return job

    def finish(self, control: Any, phase: int) -> None:
        with self.lock:
            self.finished[phase] += 1

    def wait_for(self, control: Any, phase: int, jobs: int) -> None:
        end = time.monotonic() + SECONDS
        while self.finished[phase] < jobs and time.monotonic() < end:
            if phase == self.held_up:
                self.blocked.set()
            time.sleep(1e-4)

    def run(self, kernel: Callable[..., None], args: tuple[Any, ...]) -> None:
        def work(worker: int) -> None:
            kernel(worker, None, *args)
            self.blocked.set()

        threads = [threading.Thread(target=work, args=(worker,)) for worker in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()


_compiled = bins._list_part
_WITH_VECTORS = ("_list_part", "_columns", "_tile_blocks")


@njit
def _list_part(first, last, at, limit, order, view, scene, counts, listed):  # type: ignore[no-untyped-def]
    return _compiled(first, last, at, limit, order, view, scene, counts, listed)


@pytest.fixture(scope="module")
def launched() -> SimpleNamespace:
    """The kernels as Python, and the arguments of one launch with what it gave."""
    from rasterizer_cases.scenes import NAMES, crowd

    scene = crowd(COUNT, WIDTH, HEIGHT)
    gaussians: Any = tuple(getattr(scene, name).reshape(-1) for name in NAMES)
    size: Any = SimpleNamespace(
        width=WIDTH, height=HEIGHT, near_plane=0.01, far_plane=1e10, eps2d=0.3, antialiased=False
    )
    view = layout.make_view(scene.viewmats[0], scene.Ks[0], size)
    rendering = passes.Rendering(view)
    out: Any = tuple(np.empty(k * COUNT, np.float32) for k in (2, 2, 1))
    rendering.bin_gaussians(gaussians, out)
    return SimpleNamespace(view=view, gaussians=gaussians, out=out, rendering=rendering)


def _project_from(rendering: passes.Rendering) -> Callable[..., None]:
    """Stands in for `project_chunk`: copies what it gave."""
    rows, (row_starts, row_bases) = rendering.records.reshape(COUNT, -1), rendering.numbering

    def project_chunk(
        chunk: int, chunks: int, gaussians: Any, camera: Any, size: Any,
        records: Any, keys: Any, numbering: Any, out: Any,
    ) -> None:  # fmt: skip
        first, last = chunk_range.py_func(chunk, chunks, COUNT)
        records[0].reshape(COUNT, -1)[first:last] = rows[first:last]
        # Where depths are now.
        records[1].reshape(COUNT, -1)[first:last, layout.ROW] = row_starts[first:last]
        keys[first:last] = rendering.keys[first:last]
        numbering[0][first:last] = row_starts[first:last]
        numbering[1][chunk + 1] = row_bases[chunk + 1] - row_bases[chunk]

    return project_chunk


def _as_python(
    monkeypatch: pytest.MonkeyPatch, rendering: passes.Rendering, phases: Phases
) -> None:
    for module in (sort, bins):
        for name, value in vars(module).copy().items():
            ours = getattr(value, "__module__", None) == module.__name__
            if ours and hasattr(value, "py_func") and name not in _WITH_VECTORS:
                monkeypatch.setattr(module, name, value.py_func)
        for name in ("draw", "finish", "wait_for"):
            monkeypatch.setattr(module, name, getattr(phases, name))
    monkeypatch.setattr(bins, "sort_phases", sort.sort_phases)
    monkeypatch.setattr(bins, "project_chunk", _project_from(rendering))
    monkeypatch.setattr(bins, "_list_part", _list_part)


@pytest.mark.parametrize("held_up", range(bins.BIN_PHASES))
def test_nobody_goes_on_before_a_phase_is_done(
    held_up: int, launched: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, rendering, parts = launched.view, launched.rendering, 3
    kernel = bins.bin_gaussians.py_func
    phases = Phases(held_up)
    _as_python(monkeypatch, rendering, phases)
    room = int(rendering.numbering[1][-1])
    # Zeros, so that a worker who is too early reads no number that leads outside the arrays.
    records = np.zeros(COUNT * layout.RECORD, np.float32)
    words = np.zeros(layout.ENTRY_BLOCKS * room * parts, np.uint64)
    entries = (words, words.view(np.int32))
    other = np.zeros_like(words)
    listed = (np.zeros(room * parts, np.int32), (other, other.view(np.int32)))
    starts, tile_order = np.zeros(view.tiles + 1, np.int64), np.zeros(view.tiles, np.int32)
    result = np.zeros(4, np.int64)
    phases.run(
        kernel,
        (
            launched.gaussians,
            view.camera,
            (WIDTH, HEIGHT, view.tiles_x),
            (records, records.view(np.int32)),
            np.zeros(COUNT, np.int32),
            (np.zeros(COUNT, np.int32), np.zeros(rendering.numbering[1].size, np.int64)),
            launched.out,
            (
                np.zeros((parts, 1 << sort.DIGIT_BITS), np.int64),
                np.zeros(COUNT, np.int64),
                np.zeros(COUNT, np.int64),
                result,
            ),
            (np.arange(parts + 1) * room, np.zeros(parts, np.int64)),
            (np.zeros((parts, view.tiles), np.int64), starts, tile_order, listed, entries),
        ),
    )
    assert phases.drawn[held_up] > 0 or held_up >= bins.BIN_PHASES - 6  # keys may need two passes
    total = starts[-1]
    np.testing.assert_array_equal(starts, rendering.tiles[0])
    np.testing.assert_array_equal(tile_order, rendering.tiles[2])
    written = layout.ENTRY_BLOCKS * total
    np.testing.assert_array_equal(words[:written], rendering.entries[0][:written])
    drawn = rendering.keys >= 0
    depths = records.reshape(COUNT, -1)[drawn, layout.DEPTH]
    np.testing.assert_array_equal(depths, launched.out[2][drawn])
