"""Procedural multi-period city scenes with exact ground truth, ray-cast on the CPU.

Importing this package is cheap; `generate` imports the ray caster when it is called.
"""

from __future__ import annotations

from pathlib import Path

from chronoscene.io.processes import Report
from chronoscene.synth.settings import PRESETS, SynthSettings, preset

__all__ = ["PRESETS", "SynthSettings", "generate", "preset"]


def generate(
    out: Path | str,
    settings: SynthSettings,
    report: Report = lambda what, done, total: None,
    *,
    truth: bool = True,
) -> None:
    """Generate a scene folder with images, COLMAP model, split and ground truth.

    The same settings give the same bytes, whatever the number of threads.

    Args:
        out: Folder to create; must not exist or must be empty.
        settings: What to generate; see `preset`.
        report: Called after each unit of work.
        truth: False for no ground truth, which takes half as long as all photos where there are
            many periods.

    Raises:
        ChronoSceneError: If ``out`` already contains files.
    """
    from chronoscene.synth.generation import run

    run(Path(out), settings, report, truth=truth)
