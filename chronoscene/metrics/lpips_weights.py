"""Search for the weights of LPIPS. Nothing is unpickled, and nothing is downloaded from here:
``chronoscene download lpips-weights`` does that.

Two parts are needed: the convolutions of VGG16 trained on ImageNet (``vgg16-397923af.pth``, the
file that torchvision downloads) and the five linear heads of LPIPS 0.1 (``vgg.pth`` of the
``lpips`` package, 7 kB). Both are recognised by the names of their tensors, so one file may hold
both, also a saved ``lpips.LPIPS`` module.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from chronoscene.errors import MetricUnavailableError

if TYPE_CHECKING:
    from torch import Tensor

ENVIRONMENT = "CHRONOSCENE_LPIPS_WEIGHTS"
BACKBONE_FILE = "vgg16-397923af.pth"
HEADS_FILE = "lpips-vgg-v0.1.pth"
"""Our name in torch's cache for what is ``weights/v0.1/vgg.pth`` in the lpips package."""
CONVOLUTIONS = (
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
"""VGG16 by slices that end in a tap: index in torchvision's ``features``, channels in and out."""

TODO = "run chronoscene download lpips-weights, or name a folder with both by --lpips-weights"


@dataclass(frozen=True, slots=True, eq=False)
class LpipsWeights:
    """Checked tensors, float32 on the CPU."""

    backbone: Mapping[str, Tensor]
    """``<index>.weight`` [out, in, 3, 3] and ``<index>.bias`` [out] of each convolution."""
    heads: tuple[Tensor, ...]
    """Weights of the five channels-to-one heads. [channels]"""
    files: tuple[Path, Path]
    """Files that backbone and heads were read from."""


def candidate_files(explicit: Path | None = None) -> Iterator[Path]:
    """Existing files that may hold weights, in the order in which they are tried.

    Raises:
        MetricUnavailableError: If the path given by the user does not exist.
    """
    for place, path in (("--lpips-weights", explicit), (ENVIRONMENT, _environment_path())):
        if path is not None and not path.exists():
            raise MetricUnavailableError(
                place, expected="a folder or file", found=f"nothing at {path}", todo=TODO
            )
        if path is not None and path.is_dir():
            yield from sorted(p for p in path.iterdir() if p.suffix in (".pth", ".safetensors"))
        elif path is not None:
            yield path
    for path in (hub_cache() / BACKBONE_FILE, hub_cache() / HEADS_FILE, _package_heads()):
        if path is not None and path.is_file():
            yield path


def hub_cache() -> Path:
    """Torch's folder for downloaded weights, found without importing torch."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    home = Path(os.environ.get("TORCH_HOME") or cache / "torch")
    return home.expanduser() / "hub" / "checkpoints"


def _environment_path() -> Path | None:
    value = os.environ.get(ENVIRONMENT)
    return Path(value).expanduser() if value else None


def _package_heads() -> Path | None:
    """Heads inside an installed ``lpips``, which is not imported: it needs torchvision."""
    try:
        spec = find_spec("lpips")
    except ValueError:  # a module put into sys.modules by hand has no spec
        return None
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations))) / "weights" / "v0.1" / "vgg.pth"


def check_available(explicit: Path | None = None) -> None:
    """Cheap test, without torch, that there is something to load.

    Raises:
        MetricUnavailableError: If no file can hold the backbone.
    """
    files = list(candidate_files(explicit))
    if not any(p.stat().st_size > 10**6 for p in files):
        found = ", ".join(str(p) for p in files) or "no file"
        raise MetricUnavailableError(
            "LPIPS weights", expected="VGG16 and the LPIPS heads", found=found, todo=TODO
        )


def load_weights(explicit: Path | None = None) -> LpipsWeights:
    """Find and check both parts.

    Raises:
        MetricUnavailableError: If a part is missing, damaged or of another shape.
    """
    backbone: tuple[Path, dict[str, Tensor]] | None = None
    heads: tuple[Path, tuple[Tensor, ...]] | None = None
    seen = []
    for path in candidate_files(explicit):
        tensors = read_tensors(path)
        seen.append(str(path))
        if backbone is None and (convolutions := pick_backbone(tensors)):
            backbone = path, _check_backbone(path, convolutions)
        if heads is None and (linear := pick_heads(tensors)):
            heads = path, _check_heads(path, linear)
        if backbone and heads:
            return LpipsWeights(backbone[1], heads[1], (backbone[0], heads[0]))
    missing = [name for name, part in (("VGG16", backbone), ("LPIPS heads", heads)) if part is None]
    raise MetricUnavailableError(
        "LPIPS weights",
        expected=" and ".join(missing),
        found=f"neither in {', '.join(seen)}" if seen else "no file",
        todo=TODO,
    )


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a ``.safetensors`` or ``.pth`` file by name; never runs code from the file."""
    import torch
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            return dict(load_file(path))
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch, pickle, zip and safetensors errors share no base class
        raise _unusable(path, f"{type(error).__name__}") from error
    if not isinstance(content, Mapping):
        raise _unusable(path, type(content).__name__)
    return {str(k): v for k, v in content.items() if isinstance(v, torch.Tensor)}


def pick_backbone(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convolutions under torchvision's names or those of a saved ``lpips.LPIPS``; {} if none."""
    picked = {}
    for number, layers in enumerate(CONVOLUTIONS, start=1):
        for index, _, _ in layers:
            for part in ("weight", "bias"):
                for prefix in ("features", f"net.slice{number}"):
                    if (tensor := tensors.get(f"{prefix}.{index}.{part}")) is not None:
                        picked[f"{index}.{part}"] = tensor.float()
    return picked


def pick_heads(tensors: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """The five linear heads; () if the file has none."""
    names = [f"lin{i}.model.1.weight" for i in range(len(CONVOLUTIONS))]
    return tuple(tensors[n].float() for n in names) if all(n in tensors for n in names) else ()


def _check_backbone(path: Path, picked: dict[str, Tensor]) -> dict[str, Tensor]:
    for index, channels_in, channels_out in (layer for part in CONVOLUTIONS for layer in part):
        for name, shape in (
            (f"{index}.weight", (channels_out, channels_in, 3, 3)),
            (f"{index}.bias", (channels_out,)),
        ):
            found = tuple(picked[name].shape) if name in picked else "nothing"
            if found != shape:
                raise _unusable(path, f"{found} for features.{name}, not {shape}")
    return picked


def _check_heads(path: Path, picked: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    for number, (layers, head) in enumerate(zip(CONVOLUTIONS, picked, strict=True)):
        if head.numel() != layers[-1][2]:
            raise _unusable(path, f"{tuple(head.shape)} for lin{number}.model.1.weight")
    return tuple(head.reshape(-1) for head in picked)


def _unusable(path: Path, found: str) -> MetricUnavailableError:
    return MetricUnavailableError(
        path, expected="weights of VGG16 or of the LPIPS heads", found=found, todo=TODO
    )
