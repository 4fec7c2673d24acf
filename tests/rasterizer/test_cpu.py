"""Properties of the CPU backend: equal bits, buffers kept between calls, stages."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit
from rasterizer_cases.comparison import everything
from rasterizer_cases.scenes import NAMES

from chronoscene.kernels.runtime import set_threads
from chronoscene.kernels.thread_pool import launch
from chronoscene.rasterizer import rasterize
from chronoscene.rasterizer.cpu import layout, passes
from chronoscene.rasterizer.cpu.sort import DIGIT_BITS, SORT_PHASES, sort_phases

MAX_THREADS: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]


def assert_equal_bits(a: list[torch.Tensor], b: list[torch.Tensor]) -> None:
    for x, y in zip(a, b, strict=True):
        assert torch.equal(x, y)


@pytest.mark.parametrize(("count", "size"), [(3000, 150), (40, 20)])
def test_bits_do_not_depend_on_the_number_of_threads(
    count: int, size: int, tools: SimpleNamespace, threads: Any
) -> None:
    scene = tools.random_scene(
        count, size, size + 7, backgrounds=np.array([[0.1, 0.2, 0.3]], np.float32)
    )
    results = []
    for number in (1, 2, 1, MAX_THREADS):
        threads(number)
        results.append(everything(scene))
    for other in results[1:]:
        assert_equal_bits(results[0], other)


@pytest.mark.parametrize(("count", "size"), [(9_000, 70), (60_000, 96)])
def test_workers_that_share_lists_wait_for_each_other(
    count: int, size: int, tools: SimpleNamespace, threads: Any
) -> None:
    """Many times, as a worker that does not wait is not always too early."""
    scene = tools.crowd(count, size, size - 6)
    threads(1)
    alone = everything(scene)
    threads(2)
    for _ in range(40):
        assert_equal_bits(alone, everything(scene))


def test_buffers_of_other_scenes_leave_no_trace(tools: SimpleNamespace) -> None:
    """A small scene after a large one, and after one that has other pixels ended."""
    small = tools.random_scene(50, 45, 30, seed=1)
    passes.clear_workspaces()
    fresh = everything(small)
    large = tools.random_scene(3000, 120, 90, seed=2)
    everything(large.with_(opacities=np.full(3000, 0.99, np.float32), scales=large.scales * 4))
    assert_equal_bits(fresh, everything(small))


def test_two_graphs_at_once_do_not_share_buffers(tools: SimpleNamespace) -> None:
    a, b = tools.random_scene(60, 40, 40, seed=1), tools.random_scene(70, 30, 50, seed=2)
    alone = [everything(a), everything(b)]
    results = [scene.render("cpu") for scene in (a, b)]
    for (result, inputs), expected in zip(results, alone, strict=True):
        generator = torch.Generator().manual_seed(0)
        loss = (result.image * torch.randn(result.image.shape, generator=generator)).sum()
        (loss + (result.alphas**2).sum()).backward()
        assert_equal_bits([x.grad for x in inputs.values()], expected[5:])


def test_a_graph_can_be_walked_twice(tools: SimpleNamespace) -> None:
    result, inputs = tools.random_scene(60, 40, 40).render("cpu")
    loss = (result.image**2).sum()
    first = torch.autograd.grad(loss, list(inputs.values()), retain_graph=True)
    tools.random_scene(90, 40, 40, seed=5).render("cpu")[0].image.sum().backward()
    second = torch.autograd.grad(loss, list(inputs.values()))
    assert_equal_bits(list(first), list(second))


def test_workspaces_come_back(tools: SimpleNamespace) -> None:
    passes.clear_workspaces()
    scene = tools.random_scene(30, 20, 20)
    for _ in range(5):
        everything(scene)
        with torch.no_grad():
            scene.render("cpu")
    gc.collect()
    assert 1 <= len(passes._free) <= 2


def test_rendering_without_gradients_gives_equal_images(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(60, 40, 40)
    with torch.no_grad():
        plain = scene.render("cpu")[0]
    assert not plain.info.means2d.requires_grad and not plain.image.requires_grad
    assert torch.equal(plain.image, scene.render("cpu")[0].image)


def test_second_derivatives_are_refused_not_wrong(tools: SimpleNamespace) -> None:
    result, inputs = tools.random_scene(30, 20, 20).render("cpu")
    loss = (result.image**2).sum()
    (gradient,) = torch.autograd.grad(loss, inputs["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_arrays_may_be_strided_and_read_only(tools: SimpleNamespace) -> None:
    scene = tools.random_scene(60, 40, 40)
    expected = scene.render("cpu")[0].image
    inputs: dict[str, Any]
    inputs = {name: x.detach() for name, x in scene.tensors(torch.float32).items()}
    inputs["means"] = inputs["means"].T.contiguous().T
    inputs["colors"] = torch.cat([inputs["colors"], inputs["colors"]], dim=1)[:, :3]
    inputs["opacities"] = torch.stack([inputs["opacities"]] * 2, dim=1)[:, 0]
    inputs.update(viewmats=torch.tensor(scene.viewmats), Ks=torch.tensor(scene.Ks))
    with torch.inference_mode():
        image = rasterize(**inputs, width=40, height=40).image
    assert torch.equal(image, expected)


def test_only_asked_gradients(tools: SimpleNamespace) -> None:
    """Gradients of some inputs do not need those of others."""
    scene = tools.random_scene(60, 40, 40)
    expected = everything(scene)
    inputs: dict[str, Any]
    inputs = {name: x.detach() for name, x in scene.tensors(torch.float32).items()}
    inputs["opacities"].requires_grad_()
    result = rasterize(
        **inputs,
        viewmats=torch.tensor(scene.viewmats),
        Ks=torch.tensor(scene.Ks),
        width=40,
        height=40,
    )
    generator = torch.Generator().manual_seed(0)
    loss = (result.image * torch.randn(result.image.shape, generator=generator)).sum()
    (loss + (result.alphas**2).sum()).backward()
    assert_equal_bits([inputs["opacities"].grad], [expected[5 + 3]])


@njit
def _sort(control, keys, counts, pairs, spare, result):  # type: ignore[no-untyped-def]
    return sort_phases(control, 0, keys, counts, pairs, spare, result)


@settings(max_examples=50, deadline=None)
@given(
    keys=hnp.arrays(
        np.int32,
        st.integers(1, 300),
        elements=st.one_of(st.just(-1), st.integers(0, 2**31 - 1), st.integers(0, 7)),
    ),
    parts=st.integers(1, 5),
)
def test_sort_is_stable_and_leaves_out_negative_keys(keys: np.ndarray, parts: int) -> None:
    pairs, spare = np.empty(keys.size, np.int64), np.empty(keys.size, np.int64)
    counts, result = np.empty((parts, 1 << DIGIT_BITS), np.int64), np.empty(3, np.int64)
    in_spare = []

    def kernel(worker: int, control: np.ndarray) -> None:
        in_spare.append(_sort(control, keys, counts, pairs, spare, result)[1])

    set_threads(2)
    launch(kernel, 2, phases=SORT_PHASES)
    order = (spare if in_spare[0] else pairs)[: result[0]] & 0xFFFFFFFF
    expected = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(order, expected[keys[expected] >= 0])


def test_callers_from_several_threads_get_their_own_results(tools: SimpleNamespace) -> None:
    scenes = [tools.random_scene(400, 64, 64, seed=k) for k in range(4)]
    expected = [everything(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            for got, wanted in zip(pool.map(everything, scenes), expected, strict=True):
                assert_equal_bits(got, wanted)


def test_blocks_are_those_that_the_ellipse_touches(tools: SimpleNamespace) -> None:
    """No block with a pixel above the threshold is missing, and few others are listed."""
    scene = tools.random_scene(400, 100, 70, seed=3)
    names = ("means", "quats", "scales", "opacities", "colors")
    gaussians: Any = tuple(getattr(scene, name).reshape(-1) for name in names)
    size: Any = SimpleNamespace(
        width=100, height=70, near_plane=0.01, far_plane=1e10, eps2d=0.3, antialiased=False
    )
    view = layout.make_view(scene.viewmats[0], scene.Ks[0], size)
    visible = (np.empty(800, np.float32), np.empty(800, np.float32), np.empty(400, np.float32))
    binned = passes.Rendering(view)
    binned.bin_gaussians(gaussians, visible)
    listed = np.zeros((400, 3 * 32, 4 * 32), bool)
    words, numbers = binned.entries
    blocks_of, gaussians_of = (
        words[:: layout.ENTRY_BLOCKS],
        numbers[layout.GAUSSIAN :: layout.ENTRY_NUMBERS],
    )
    for tile in range(view.tiles):
        y, x = 32 * (tile // view.tiles_x), 32 * (tile % view.tiles_x)
        for entry in range(binned.tiles[0][tile], binned.tiles[0][tile + 1]):
            word = blocks_of[entry : entry + 1].copy()
            bits = np.unpackbits(word.view(np.uint8), bitorder="little")
            blocks = np.kron(bits.reshape(8, 8), np.ones((4, 4), np.uint8)).astype(bool)
            listed[gaussians_of[entry], y : y + 32, x : x + 32] |= blocks
    needed = _touched(binned.records.reshape(-1, layout.RECORD), binned.keys >= 0)
    assert needed.any() and not (needed & ~listed[:, :70, :100]).any()
    in_blocks = np.pad(needed, ((0, 0), (0, 2), (0, 0))).reshape(400, 18, 4, 25, 4).any((2, 4))
    assert listed[:, :70:4, :100:4].sum() <= 1.05 * in_blocks.sum()


def _touched(records: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Pixels where alpha counts, from the records. [N, 70, 100]"""
    y, x = np.mgrid[:70, :100] + 0.5
    dx, dy = x - records[:, 0, None, None], y - records[:, 1, None, None]
    u = records[:, 2, None, None] * dx + records[:, 3, None, None] * dy
    v = records[:, 4, None, None]
    v = v * np.where(v > 0, dy, dx)
    power = records[:, 5, None, None] - u**2 - v**2
    return (power >= layout.LEVEL_MIN) & drawn[:, None, None]


def test_lists_grow_when_gaussians_cover_many_tiles(
    tools: SimpleNamespace, check_agreement: Any
) -> None:
    """Every Gaussian covers all 20 tiles: more pairs than the first guess has room for."""
    scene = tools.random_scene(30, 150, 120, seed=4)
    check_agreement(scene.with_(scales=np.full((30, 3), 3.0, np.float32)))


@pytest.mark.parametrize(
    ("width", "height"), [(96, 96), (160, 96), (224, 224), (352, 32), (33, 416)]
)
def test_lists_have_room_for_any_number_of_huge_gaussians(
    width: int, height: int, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first guess on: every count of Gaussians that all cover every tile."""
    # The room may at most be asked for once for each factor of four, and once exactly.
    monkeypatch.setattr(passes, "_MAX_ATTEMPTS", 6)
    scene = tools.random_scene(64, width, height)
    scene = scene.with_(scales=np.full((64, 3), 30.0, np.float32))
    arrays = {name: getattr(scene, name) for name in NAMES}
    for count in range(1, 65):
        passes.clear_workspaces()
        few = scene.with_(**{name: array[:count] for name, array in arrays.items()})
        with torch.no_grad():
            assert few.render("cpu")[0].alphas.min() > 0


def test_lists_that_never_have_room_are_an_error(
    tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tools.random_scene(30, 96, 96).with_(scales=np.full((30, 3), 30.0, np.float32))
    monkeypatch.setattr(passes, "_LIST_GROWTH", 1)
    passes.clear_workspaces()
    with torch.no_grad(), pytest.raises(AssertionError, match="no room for 270 pairs of 30 Gaus"):
        scene.render("cpu")
    passes.clear_workspaces()
