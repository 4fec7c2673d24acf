"""Procedural multi-period city scenes with exact ground truth, ray-cast on the CPU.

Importing this package is cheap; `generate` imports the ray caster when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chronoscene.synth.settings import PRESETS, SynthSettings, preset

__all__ = ["PRESETS", "SynthSettings", "generate", "preset"]


def generate(out: Path | str, settings: SynthSettings, progress: Any = None) -> None:
    """Make a scene folder with images, COLMAP model, split and ground truth.

    Equal settings give equal bytes, whatever the number of threads.

    Args:
        out: Folder to create; it must not exist, or be empty.
        settings: What to make; see `preset`.
        progress: Callable ``(done, total, what)`` that is told about finished units of work.

    Raises:
        ChronoSceneError: If ``out`` holds files already.
    """
    from chronoscene.synth.generation import run

    run(Path(out), settings, progress)
