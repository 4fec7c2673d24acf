"""Command that trains a configuration, as a person would type it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from chronoscene.harness.files.records import variant_options
from chronoscene.methods import installed_methods, load_spec
from chronoscene.methods.preset_files import SUFFIX

OPTIONS = (
    "iterations",
    "budget",
    "separate_iterations",
    "max_width",
    "validation_seed",
    "protocol",
)
"""Names in a variant that are options of ``bench``, not of the method."""
FLAGS = ("validation", "fit_half")
"""Names of options without a value, likewise."""


def command_line(scene: str, config: Mapping[str, Any], seed: int | None = None) -> str:
    """Write the command that trains a configuration, and the one that compresses it, if any.

    ``module:SPEC`` stands for a method that is not installed: ``bench`` does not know its name.

    Args:
        scene: Argument that stands for its folder.
        config: ``method``, ``strategy``, ``preset`` and ``variant`` (`ResolvedMethod.run`, and what
            `compress_run` adds to it).
        seed: None leaves the option out.
    """
    words = ["chronoscene", "bench", scene]
    method = config["method"]
    words += ["--method", method if method in installed_methods() else "module:SPEC"]
    words += ["--strategy", config["strategy"], "--preset", _preset(method, config["preset"])]
    words += [] if seed is None else ["--seed", str(seed)]
    compress: list[str] = []
    for name, value in variant_options(config["variant"]).items():
        if name == "iterations" and "+" in value:
            words += ["--continue-to", value.rpartition("+")[2]]
        elif name == "compressed":
            loss = ["--plain"] if value == "plain" else ["--max-loss", value.removesuffix("dB")]
            compress = ["chronoscene", "compress", "RUN", *loss]
        elif name in FLAGS:
            words.append(f"--{name.replace('_', '-')}")
        elif name in OPTIONS:
            words += [f"--{name.replace('_', '-')}", value]
        else:
            words += ["--set", f"{name}={value}"]
    return " && ".join(map(shlex.join, filter(None, (words, compress))))


def _preset(method: str, name: str) -> str:
    """Return the name of a preset, or of its file if the method has none of this name."""
    is_known = method not in installed_methods() or name in load_spec(method).presets
    return name if is_known else f"{name}{SUFFIX}"
