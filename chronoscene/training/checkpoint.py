"""Models on disk: ``model.safetensors`` for numbers, ``model.json`` for everything else. No pickle.

``model.compressed`` may stand in the place of ``model.safetensors``; see `chronoscene.compression`.

The JSON file is written last and holds the digest of the tensor file, so a folder whose
``model.json`` is present and agrees is complete. Equal models give equal bytes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from chronoscene.compression.file import COMPRESSED_FILE, META_FILE, read_compressed
from chronoscene.compression.file import TENSOR_FILE as TENSOR_FILE
from chronoscene.errors import CheckpointError, ShapeError
from chronoscene.io.documents import read_json_document
from chronoscene.io.staging import replacing, sha256_of, write_text_atomic
from chronoscene.io.wording import shown

TRAINING = "training"
"""Stem of the files that hold a training."""
FORMAT_VERSION = 1
MISFITS = (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError)
"""Errors of code that is given tensors and values that do not go together; see `misfit`."""
DAMAGED = "the file is damaged or was edited: copy it again or train again"


class TrainingState(NamedTuple):
    """State of a training: all that the steps to come depend on."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]
    """Other values, as JSON can hold them."""


def parts(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors ``<prefix>.<name>``, by name."""
    start = f"{prefix}."
    return {k.removeprefix(start): t for k, t in tensors.items() if k.startswith(start)}


def check_views(state: TrainingState, views: int) -> None:
    """Refuse a training that began with another number of views to a step."""
    begun = state.values.get("views_per_step", 1)  # earlier versions had one
    if begun != views:
        raise ShapeError(
            "views_per_step",
            expected=str(begun),
            found=str(views),
            todo="continue with as many threads as before: views_per_step=auto depends on them",
        )


def save_tensors(
    folder: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any], *, stem: str = "model"
) -> None:
    """Write ``model.safetensors`` and ``model.json`` into an existing folder.

    Args:
        folder: Where to.
        tensors: Stored contiguous, in the order of their names, from any device.
        meta: Whatever JSON can hold without NaN.
        stem: Of the names of the files.

    Raises:
        DiskFullError: If there is no space for them.
    """
    # Copies, since views that share memory cannot be distinguished in the file.
    stored = {k: tensors[k].detach().cpu().contiguous().clone() for k in sorted(tensors)}
    with replacing(folder / f"{stem}.safetensors") as partial:
        try:
            save_file(stored, partial)
        except SafetensorError as error:  # it wraps the errors of the system
            if (number := re.search(r"\(os error (\d+)\)", str(error))) is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1])), str(folder)) from error
        digest = sha256_of(partial)
    document = {**meta, "format_version": FORMAT_VERSION, "tensors_sha256": digest}
    text = json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    write_text_atomic(folder / f"{stem}.json", text)


def load_tensors(
    folder: Path, *, device: str = "cpu", method: str | None = None, stem: str = "model"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors by name and the content of ``model.json``, as `save_tensors` wrote them.

    Args:
        folder: Folder of the model.
        device: Where the tensors go.
        method: Name of the method that the model must be of, if given.
        stem: Of the names of the files.

    Raises:
        CheckpointError: If a file is missing or damaged, or the model is of another method.
    """
    described = folder / f"{stem}.json"
    meta = _read_meta(described)
    if method is not None and meta.get("method") != method:
        todo = "name another folder or another method"
        raise _refusal(described, f"a model of {method}", f"one of {meta.get('method')}", todo)
    path, compressed = folder / f"{stem}.safetensors", folder / COMPRESSED_FILE
    if not path.is_file() and f"{stem}.json" == META_FILE and compressed.is_file():
        path = compressed
    if not path.is_file():
        raise _refusal(path, "the tensors of the model", "no such file", "train again")
    if sha256_of(path) != meta["tensors_sha256"]:
        raise _refusal(path, f"the digest given in {described.name}", "another one")
    if path == compressed:
        arrays = read_compressed(path)
        return {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}, meta
    try:
        return load_file(path, device=device), meta
    except SafetensorError as error:
        raise _refusal(path, "a safetensors file", str(error)) from error


def check_finite(folder: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse models with numbers that are not finite: their pictures would be wrong silently."""
    wrong = [name for name, tensor in tensors.items() if not tensor.isfinite().all()]
    if wrong:
        raise _refusal(
            folder,
            "finite numbers in all tensors of the model",
            f"others in {shown(wrong)}",
            f"{DAMAGED}, with lower learning rates if the training gave it",
        )


def misfit(folder: Path, expected: str, error: Exception, todo: str = DAMAGED) -> CheckpointError:
    """Return the error for tensors and a description that do not go together."""
    return _refusal(folder, expected, f"{type(error).__name__}: {error}", todo)


def _read_meta(path: Path) -> dict[str, Any]:
    if not path.is_file():
        todo = "name the folder that a finished training wrote"
        raise _refusal(path, "the description of a trained model", "no such file", todo)
    meta: dict[str, Any] = read_json_document(path, error=CheckpointError, todo=DAMAGED)
    if "tensors_sha256" not in meta:
        raise _refusal(path, "an object with the key 'tensors_sha256'", "none")
    if (version := meta.get("format_version")) != FORMAT_VERSION:
        todo = "use the version of the software that wrote it, or train again"
        raise _refusal(path, f"format_version {FORMAT_VERSION}", repr(version), todo)
    return meta


def _refusal(path: Path, expected: str, found: str, todo: str = DAMAGED) -> CheckpointError:
    return CheckpointError(path, expected=expected, found=found, todo=todo)
