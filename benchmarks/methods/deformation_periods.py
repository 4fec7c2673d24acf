"""One camera at every period, as photographed and as finished runs show it.

    python -m benchmarks.methods.deformation_periods VIEW OUT.jpg TRUTH... --run TITLE=RUN [...]

VIEW is the name of a test image, TRUTH its photo at each period in turn: for a rendered scene, the
same camera at the others. Rows are periods, columns the truth and the runs, with PSNR below.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from chronoscene.harness.use.cameras import find_viewpoints
from chronoscene.harness.use.rendering import render_viewpoints
from chronoscene.harness.use.trained_run import open_run
from chronoscene.metrics.psnr_ssim import psnr

CELL = 2.0  # Inches per image


def renders(folder: Path, view: str, periods: int) -> list[np.ndarray]:
    """Render a test view of a run at each period."""
    run = open_run(folder)
    (viewpoint,) = (
        s for s in find_viewpoints("test", run, None, 0).viewpoints if s.name == f"{view}.png"
    )
    return list(
        render_viewpoints(run, [replace(viewpoint, period=float(p)) for p in range(periods)])
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("view")
    parser.add_argument("out", type=Path)
    parser.add_argument("truth", type=Path, nargs="+")
    parser.add_argument("--run", action="append", required=True, metavar="TITLE=RUN")
    options = parser.parse_args()
    truth = [np.asarray(Image.open(path).convert("RGB")) for path in options.truth]
    columns = {"truth": truth}
    for item in options.run:
        title, _, folder = item.partition("=")
        columns[title] = renders(Path(folder), options.view, len(truth))
    height, width, _ = truth[0].shape
    size = (CELL * len(columns), (CELL * height / width + 0.2) * len(truth) + 0.3)
    figure = Figure(figsize=size, layout="compressed", dpi=110)
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(truth), len(columns), squeeze=False)
    for c, (title, images) in enumerate(columns.items()):
        axes[0, c].set_title(title, fontsize=10)
        for p, image in enumerate(images):
            axes[p, c].imshow(image)
            axes[p, c].set_xticks([])
            axes[p, c].set_yticks([])
            value = f"{psnr(image, truth[p]):.1f} dB" if c else f"period {p}"
            axes[p, c].set_xlabel(value, fontsize=9)
    figure.savefig(options.out, pil_kwargs={"quality": 85}, bbox_inches="tight", pad_inches=0.05)


if __name__ == "__main__":
    main()
