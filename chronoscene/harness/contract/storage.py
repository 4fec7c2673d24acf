"""Rules for saving, loading and resuming."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from chronoscene.errors import CheckpointError
from chronoscene.harness.contract.subject import (
    PAUSE,
    NotApplicableError,
    Subject,
    contents,
    demand,
    go_on,
    same_files,
    tensors_of,
)
from chronoscene.harness.train.checks import check_size, refuse
from chronoscene.methods import POSITIONS

_ROUNDING = 1e-3
"""Largest difference of a pixel, as Gaussians at one depth may be drawn in another order."""


def a_model_is_two_files(subject: Subject) -> None:
    """A saved model is model.safetensors and model.json, which names method, periods and frame."""
    files = contents(subject.model)
    wanted = {"model.safetensors", "model.json"}
    demand(set(files) == wanted, "save", "the files model.safetensors and model.json", [*files])
    document = json.loads(files["model.json"])
    frame = subject.data.training_from_world.to_matrix()
    for key, value in (
        ("method", subject.spec.name),
        ("num_periods", subject.data.num_periods),
        ("training_from_world", frame.tolist()),
    ):
        found = document.get(key)
        demand(np.array_equal(found, value), f"model.json: {key}", str(value), found)
    arrays = tensors_of(subject.model).values()
    demand(
        arrays and all(np.isfinite(a).all() for a in arrays if a.dtype.kind == "f"),
        "model.safetensors", "finite tensors",
    )  # fmt: skip


def loading_unpickles_nothing(subject: Subject) -> None:
    """Loading unpickles nothing."""
    import torch

    def forbidden(*args: Any, **kwargs: Any) -> None:
        raise refuse("load", "no use of pickle or torch.load", "a call of it")

    _ = subject.model
    with (
        patch.object(torch, "load", forbidden),
        patch.object(pickle, "load", forbidden),
        patch.object(pickle, "loads", forbidden),
    ):
        subject.loaded()


def saving_again_gives_equal_bytes(subject: Subject) -> None:
    """Saving again gives the same bytes."""
    same_files(subject.save(subject.method), subject.model, "save", "equal bytes the second time")


def a_loaded_model_is_the_same(subject: Subject) -> None:
    """A loaded model renders equal pixels, has the same size and saves equal bytes."""
    loaded = subject.loaded()
    for view in subject.data.views[::4]:
        for period in range(subject.data.num_periods):
            a = subject.method.render(view, float(period))
            b = loaded.render(view, float(period))
            for field in ("rgb", "alpha", "depth"):
                same = np.array_equal(getattr(a, field), getattr(b, field))
                demand(same, f"Prediction.{field} after load", "equal pixels", "others")
    sizes = subject.method.size(), loaded.size()
    demand(sizes[0] == sizes[1], "size after load", str(sizes[0]), sizes[1])
    same_files(subject.save(loaded), subject.model, "save after load", "equal bytes")


def another_order_shows_the_same(subject: Subject) -> None:
    """A model whose anchors or Gaussians are put into another order is saved and shows the same."""
    sorted_model = subject.loaded()
    if not hasattr(sorted_model, "permute"):
        raise NotApplicableError("the model is no set of anchors or Gaussians")
    stored = tensors_of(subject.model)
    count = len(next(stored[name] for name in POSITIONS if name in stored))
    sorted_model.permute(np.arange(count)[::-1].copy())
    again = subject.fresh()
    again.load(subject.save(sorted_model), device="cpu")
    for period in range(subject.data.num_periods):
        a, b = (m.render(subject.data.views[0], float(period)).rgb for m in (subject.method, again))
        error = float(np.abs(a - b).max())
        demand(error < _ROUNDING, f"permute, period {period}", "nearly equal pixels", error)


def a_resumed_training_ends_the_same(subject: Subject) -> None:
    """A training that is saved and loaded goes on to the bytes of an undisturbed one."""
    method, again = subject.resumed(subject.interrupted), subject.folder()
    method.save_training(again)
    same_files(again, subject.interrupted, "save_training after load_training", "equal bytes")
    reports = go_on(method, PAUSE)
    demand(reports == subject.reports[PAUSE:], "steps after load_training", "equal losses")
    same_files(subject.save(method), subject.model, "training after load_training", "equal models")


def a_damaged_training_is_refused(subject: Subject) -> None:
    """A damaged training is refused with a CheckpointError that names the file."""
    for name in sorted(contents(subject.interrupted)):
        folder = subject.folder()
        for file, content in contents(subject.interrupted).items():
            (folder / file).write_bytes(content[:-9] if name == file else content)
        _refuses(partial(subject.resumed, folder), "load_training", name)


def a_damaged_model_is_refused(subject: Subject) -> None:
    """A model that is missing, cut off or edited is refused with a CheckpointError."""
    data = (subject.model / "model.safetensors").read_bytes()
    edited = data[:-1] + bytes([data[-1] ^ 1])
    for changed in (None, data[: len(data) // 2], edited, b""):
        folder = subject.folder()
        for file, content in contents(subject.model).items():
            (folder / file).write_bytes(content)
        path = folder / "model.safetensors"
        path.unlink() if changed is None else path.write_bytes(changed)
        _refuses(partial(subject.fresh().load, folder, device="cpu"), "load", path.name)


def _refuses(call: Callable[[], object], place: str, file: str) -> None:
    expected = f"a CheckpointError that names a damaged {file}"
    try:
        call()
    except CheckpointError as error:
        demand(file in str(error), place, expected, error)
    except Exception as error:
        raise refuse(place, expected, f"{type(error).__name__}: {error}") from error
    else:
        raise refuse(place, expected, "no error")


def size_counts_what_is_stored(subject: Subject) -> None:
    """The size is that of the last step and of the stored tensors."""
    size = subject.method.size()
    check_size(size, "size")
    last = subject.reports[-1].primitives
    demand(size.primitives == last > 0, "MethodSize.primitives", f"{last}", size.primitives)
    stored = sum(array.size for array in tensors_of(subject.model).values())
    demand(size.parameters == stored, "MethodSize.parameters", f"{stored}", size.parameters)


CHECKS = (
    a_model_is_two_files,
    loading_unpickles_nothing,
    saving_again_gives_equal_bytes,
    a_loaded_model_is_the_same,
    another_order_shows_the_same,
    a_resumed_training_ends_the_same,
    a_damaged_training_is_refused,
    a_damaged_model_is_refused,
    size_counts_what_is_stored,
)
