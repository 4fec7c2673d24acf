"""Samples per second of a radiance field, forward and backward, beside plain torch.

``python -m benchmarks.fields --threads 1`` times, in turns, the compiled field, the same in plain
torch (the definitions that kernels are tested against), and its networks as `torch.nn.Linear`.
Rates are by the computing time of the process, and by wall-clock time in parentheses; the best of
several rounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import click
import numpy as np
import torch
from torch import Tensor

from chronoscene.fields.compositing import composite
from chronoscene.fields.config import FieldConfig
from chronoscene.fields.mlp import make_groups
from chronoscene.fields.network import FieldNetwork
from chronoscene.kernels.runtime import keep_freed_memory, set_threads
from chronoscene.training import devices

RAYS, SAMPLES = 4_096, 24
GEOMETRY, COLOR = 16, 48  # Lengths of the codes of CLNeRF


@dataclass
class Batch:
    """Rays with evenly spaced samples."""

    places: Tensor
    directions: Tensor
    codes: tuple[Tensor, Tensor]
    starts: Tensor


def make_batch(seed: int = 0) -> Batch:
    """Draw rays through the middle of the cube."""
    generator = torch.Generator().manual_seed(seed)
    origins = 0.3 + 0.4 * torch.rand(RAYS, 1, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=1)
    along = 0.002 * torch.arange(SAMPLES)[:, None]
    places = (origins + along * directions[:, None]).clamp(0, 0.999).reshape(-1, 3)
    codes = tuple(torch.randn(RAYS, size, generator=generator) for size in (GEOMETRY, COLOR))
    starts = torch.arange(0, RAYS * SAMPLES + 1, SAMPLES)
    return Batch(places.contiguous(), directions, (codes[0], codes[1]), starts)


def field_step(network: FieldNetwork, batch: Batch) -> None:
    """Evaluate all samples, sum along the rays, and go back."""
    groups = make_groups(batch.starts, len(batch.places))
    densities, features = network.density(batch.places, groups, batch.codes[0])
    values = network.values(features, batch.places, groups, batch.directions, batch.codes[1])
    lengths = torch.full_like(densities, 0.005)
    sums, _ = composite(densities, values, lengths, groups)
    sums.square().mean().backward()  # type: ignore[no-untyped-call]


def plain(step: Callable[[], None]) -> Callable[[], None]:
    """Let a step run without kernels, as on a GPU."""

    def without() -> None:
        kernels, devices.has_kernels = devices.has_kernels, lambda *tensors: False
        try:
            step()
        finally:
            devices.has_kernels = kernels

    return without


def networks_alone(batch: Batch) -> Callable[[], None]:
    """Make a step of the two networks alone, as torch users write them."""
    density = torch.nn.Sequential(
        torch.nn.Linear(32 + GEOMETRY, 64), torch.nn.ReLU(), torch.nn.Linear(64, 16)
    )
    color = torch.nn.Sequential(
        torch.nn.Linear(32 + COLOR, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64),
        torch.nn.ReLU(), torch.nn.Linear(64, 3), torch.nn.Sigmoid(),
    )  # fmt: skip
    inputs = torch.randn(len(batch.places), 32 + GEOMETRY)
    more = torch.randn(len(batch.places), 16 + COLOR)

    def step() -> None:
        color(torch.cat((density(inputs), more), dim=1)).sum().backward()

    return step


@click.command()
@click.option("--threads", default=1, show_default=True)
@click.option("--rounds", default=7, show_default=True)
@click.option("--log2-rows", default=17, show_default=True)
def main(threads: int, rounds: int, log2_rows: int) -> None:
    """Time the field and print million samples a second."""
    set_threads(threads)
    keep_freed_memory()
    batch, config = make_batch(), FieldConfig(log2_rows=log2_rows)
    generator = torch.Generator().manual_seed(1)
    params = FieldNetwork.initial(config, GEOMETRY, COLOR, generator)
    network = FieldNetwork(config, {k: v.requires_grad_() for k, v in params.items()})
    steps = {
        "compiled": lambda: field_step(network, batch),
        "plain torch": plain(lambda: field_step(network, batch)),
        "its networks alone, torch": networks_alone(batch),
    }
    best = dict.fromkeys(steps, (np.inf, np.inf))
    for _ in range(rounds):
        for name, step in steps.items():
            wall, computed = time.perf_counter(), time.process_time()
            step()
            spent = time.process_time() - computed, time.perf_counter() - wall
            best[name] = min(best[name], spent)
    for name, (computed, wall) in best.items():
        rates = (len(batch.places) / seconds / 1e6 for seconds in (computed, wall))
        click.echo("{}: {:.3f} ({:.3f}) million samples a second".format(name, *rates))


if __name__ == "__main__":
    main()
