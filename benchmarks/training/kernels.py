"""Times of the compiled kernels of a training step, beside plain torch.

    python -m benchmarks.training.kernels [--repeats 30] [--anchors 31000] [--no-reference]

Prints milliseconds as the caller sees them, medians and minima, and the processor time of the
calling thread. The step is that of ChronoGS at the sizes of the paper, with all anchors visible:
10 offsets, features of 16 + 3 x 16 and 32, hidden layers of 32. "active" are offsets with a
positive opacity, the only ones that a rasterizer sends gradients to. "slice" is that of
realtime4DGS, with two orders of waves and gradients for half of the Gaussians. The last lines
compare Adam on all rows of ten times as many anchors with Adam on those in view; "forward" is the
fetch.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Sequence
from itertools import cycle

import torch
from torch import Tensor

from baselines.realtime_4dgs.slicing import SHAPES, slice_at, slice_reference
from chronoscene.anchors.blocks import own_blocks
from chronoscene.anchors.decode import (
    DecodeInputs,
    HeadWeights,
    decode,
    decode_active,
    decode_reference,
)
from chronoscene.kernels.runtime import available_threads, set_threads
from chronoscene.training.optimizers.adam import Adam, DenseTable
from chronoscene.training.optimizers.row_adam import RowAdam
from chronoscene.training.photometric import photometric_loss, photometric_loss_reference

OFFSETS, BASE, PERIOD, PERIODS, SHARED, HIDDEN = 10, 16, 16, 3, 32, 32
HEIGHT, WIDTH = 240, 320


class Step:
    """Arguments of one decode, near the start of a training."""

    def __init__(self, anchors: int) -> None:
        g = torch.Generator().manual_seed(0)

        def leaf(*shape: int, scale: float = 1.0) -> Tensor:
            return (torch.randn(*shape, generator=g) * scale).requires_grad_()

        inputs = BASE + PERIOD + 3 + SHARED

        def head(outputs: int) -> HeadWeights:
            w1, w2 = inputs**-0.5, HIDDEN**-0.5
            return HeadWeights(
                leaf(HIDDEN, inputs, scale=w1),
                leaf(HIDDEN, scale=w1),
                leaf(outputs, HIDDEN, scale=w2),
                leaf(outputs, scale=w2),
            )

        self.positions = torch.randn(anchors, 3, generator=g)
        self.leaves = (
            leaf(anchors, OFFSETS, 3),
            leaf(anchors, BASE),
            leaf(PERIODS * anchors, PERIOD),
            leaf(anchors, 6),
            leaf(PERIODS, SHARED),
        )
        self.heads = (head(OFFSETS), head(7 * OFFSETS), head(3 * OFFSETS))
        self.weights = torch.tensor([0.0, 1.0, 0.0])
        self.centre = torch.randn(3, generator=g)
        self.visible = torch.arange(anchors)
        self.used_offsets = torch.full((anchors,), -1)
        self.block_rows = own_blocks(anchors, PERIODS)

    def inputs(self) -> DecodeInputs:
        """Return the inputs of the decode."""
        return DecodeInputs(
            self.positions, *self.leaves, self.weights, *self.heads, self.centre, self.visible,
            self.used_offsets, self.block_rows,
        )  # fmt: skip

    def parameters(self) -> list[Tensor]:
        """All leaves."""
        return [*self.leaves, *(weight for head in self.heads for weight in head)]

    def switch_off(self, share: float) -> None:
        """Shift the opacities so that about this share of the offsets is off."""
        with torch.no_grad():
            out = decode(self.inputs())
            self.heads[0].b2.sub_(torch.atanh(out.opacities.quantile(share)))


def report(name: str, repeats: int, *parts: Callable[[], object]) -> None:
    """Time the parts one after the other, a line with the median and minimum of each."""
    times: list[list[tuple[float, float]]] = [[] for _ in parts]
    for _ in range(repeats):
        for part, found in zip(parts, times, strict=True):
            wall, processor = time.perf_counter(), time.thread_time()
            part()
            found.append((time.perf_counter() - wall, time.thread_time() - processor))
    cells = [f"{name:<44}"]
    for found in times:
        wall_times, processor_times = (
            sorted(1e3 * t for t in column) for column in zip(*found, strict=True)
        )
        cells.append(
            f"{wall_times[len(found) // 2]:7.2f} {wall_times[0]:7.2f} {processor_times[0]:7.2f} |"
        )
    print(" ".join(cells))


class TwoParts:
    """Forward and backward of something, to be timed apart."""

    def __init__(
        self,
        forward: Callable[[], Sequence[Tensor]],
        grads: Sequence[Tensor],
        parameters: Sequence[Tensor],
    ) -> None:
        self._forward, self._grads, self._parameters = forward, grads, parameters
        self._out: Sequence[Tensor] = ()

    def forward(self) -> None:
        """Run forward on parameters without gradients."""
        for parameter in self._parameters:
            parameter.grad = None
        self._out = self._forward()

    def backward(self) -> None:
        """Send the gradients back."""
        torch.autograd.backward(list(self._out), list(self._grads))


def time_decode(step: Step, repeats: int, reference: bool) -> None:
    """Decode with gradients for the active offsets, and with them for all."""
    whole = decode(step.inputs())
    active = whole.opacities.detach() > 0
    g = torch.Generator().manual_seed(1)
    every = [torch.randn(value.shape, generator=g) for value in whole]
    some = [grad * active.reshape(-1, *[1] * (grad.ndim - 1)) for grad in every]
    few = [grad[active] for grad in every]
    share = f"{100 * float(active.float().mean()):.0f} %"
    rows: list[tuple[str, Callable[[], Sequence[Tensor]], Sequence[Tensor]]] = [
        (f"decode_active, {share} active", lambda: decode_active(step.inputs())[0], few),
        (f"decode, gradients for {share}", lambda: decode(step.inputs()), some),
        ("decode, gradients for all", lambda: decode(step.inputs()), every),
    ]
    if reference:
        rows.append(("decode in torch", lambda: decode_reference(step.inputs()), some))
    for name, forward, grads in rows:
        parts = TwoParts(forward, grads, step.parameters())
        report(name, repeats, parts.forward, parts.backward)


def time_loss(repeats: int, reference: bool) -> None:
    """Loss of an image."""
    g = torch.Generator().manual_seed(2)
    image = torch.rand(HEIGHT, WIDTH, 3, generator=g).requires_grad_()
    target = torch.randint(0, 256, image.shape, generator=g, dtype=torch.uint8)
    for name, loss in (
        (f"loss {WIDTH}x{HEIGHT}", photometric_loss),
        ("loss in torch", photometric_loss_reference),
    )[: 1 + reference]:
        parts = TwoParts(lambda f=loss: [f(image, target)], [torch.ones(())], [image])  # type: ignore[misc]
        report(name, repeats, parts.forward, parts.backward)


def time_slice(count: int, repeats: int, reference: bool) -> None:
    """Gaussians in space and time, most of which are there."""
    g = torch.Generator().manual_seed(3)
    leaves = {n: torch.randn(count, *shape, generator=g) for n, shape in SHAPES.items()}
    for leaf in leaves.values():
        leaf.requires_grad_()
    for name, function in (
        (f"slice, {count} Gaussians", slice_at),
        ("slice in torch", slice_reference),
    )[: 1 + reference]:

        def forward(function: Callable[..., dict[str, Tensor]] = function) -> Sequence[Tensor]:
            return list(function(leaves, 0.5, cycle=1.0, order=2).values())

        grads = [torch.randn(value.shape, generator=g) for value in forward()]
        for grad in grads:
            grad[::2] = 0
        parts = TwoParts(forward, grads, list(leaves.values()))
        report(name, repeats, parts.forward, parts.backward)


def time_adam(step: Step, repeats: int, reference: bool) -> None:
    """One update of all parameters."""
    named = {str(index): value for index, value in enumerate(step.parameters())}
    for value in named.values():
        value.grad = torch.full_like(value, 1e-3)
    ours = Adam(named)
    # The same work as with any other rate, and the parameters stay what they are.
    rates = dict.fromkeys(named, 0.0)
    count = sum(value.numel() for value in named.values())
    report(f"Adam, {count / 1e6:.1f} M numbers", repeats, lambda: ours.step(rates))
    if reference:
        theirs = torch.optim.Adam(list(named.values()), lr=0.0, eps=1e-15)
        report("torch.optim.Adam", repeats, theirs.step)
        fused = torch.optim.Adam(list(named.values()), lr=0.0, eps=1e-15, fused=True)
        report("torch.optim.Adam, fused", repeats, fused.step)


class Tables:
    """Features and blocks of anchors under one optimiser; a step reads some at one period."""

    def __init__(self, kind: type[DenseTable | RowAdam], anchors: int, share: float) -> None:
        self.features = kind(torch.zeros(anchors, BASE))
        self.blocks = kind(torch.zeros(PERIODS * anchors, PERIOD))
        self.block_rows = own_blocks(anchors, PERIODS)[:, 0]
        self.views = (torch.arange(t, anchors, round(1 / share)) for t in cycle(range(10)))

    def fetch(self) -> None:
        """Fetch the rows that the next view sees, with gradients."""
        rows = next(self.views)
        for table, read in ((self.features, rows), (self.blocks, self.block_rows[rows])):
            leaf = table.fetch(read)
            leaf.grad = torch.full_like(leaf, 1e-3)

    def step(self) -> None:
        """One of Adam."""
        self.features.step(1e-3)
        self.blocks.step(1e-3)


def time_tables(anchors: int, repeats: int) -> None:
    """Features of some anchors at one of three periods: fetched, and moved by Adam."""
    for share in (0.5, 0.1):
        for name, kind in (("all rows", DenseTable), ("rows in view", RowAdam)):
            tables = Tables(kind, anchors, share)
            label = f"Adam, {name}, {100 * share:.0f} % of {anchors} in view"
            report(label, repeats, tables.fetch, tables.step)


def main() -> None:
    """Time everything with one thread and with all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--anchors", type=int, default=31_000)
    parser.add_argument("--gaussians", type=int, default=60_000, help="that are sliced")
    parser.add_argument("--active", type=float, default=0.21, help="share of offsets switched on")
    parser.add_argument("--no-reference", dest="reference", action="store_false")
    args = parser.parse_args()
    step = Step(args.anchors)
    step.switch_off(1 - args.active)
    print(f"{platform.processor() or platform.machine()}, {args.anchors} anchors x {OFFSETS}")
    print(f"{'ms: median, minimum, thread':<44} {'forward':^23} | {'backward':^23} |")
    for threads in sorted({1, available_threads()}):
        print(f"threads: {set_threads(threads)}")
        time_decode(step, args.repeats, args.reference)
        time_loss(args.repeats, args.reference)
        time_slice(args.gaussians, args.repeats, args.reference)
        time_adam(step, args.repeats, args.reference)
        time_tables(10 * args.anchors, args.repeats)


if __name__ == "__main__":
    main()
