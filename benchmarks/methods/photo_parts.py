"""Photos as a finished run of NeRF-W explains them: light, what lasts, and what passes.

    python -m benchmarks.methods.photo_parts RUN OUT.webp PHOTO...

PHOTO is the name of a training image. Columns: the photo; what lasts in the light of that photo,
and in the mean light of each date; what lasts and what passes, as the training sees them; the
uncertainty, from 0 (black) to the largest of all photos.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.errors import ChronoSceneError, ConfigError
from chronoscene.fields.method import FieldMethod
from chronoscene.fields.network import Codes
from chronoscene.fields.rays import view_rays
from chronoscene.harness.use.trained_run import TrainedRun, open_run
from chronoscene.methods import View

CELL = 1.9  # Inches per image
RAYS = 2_048  # At a time


@torch.no_grad()
def values(method: FieldMethod, view: View, codes: Codes) -> NDArray[np.float32]:
    """Render a view with codes of one row: colours and what is behind them. [H, W, C]"""
    parts = []
    for first in range(0, view.width * view.height, RAYS):
        rays = view_rays(view, torch.arange(first, min(first + RAYS, view.width * view.height)))
        count, middle = len(rays.views), torch.full_like(rays.depths, 0.5)
        samples = method.march(rays, torch.zeros_like(rays.views), middle)
        drawn, _ = method.draw(rays, samples, Codes(*(code.expand(count, -1) for code in codes)))
        parts.append(torch.cat((drawn.rgb, drawn.values[:, 3:]), dim=1))
    return torch.cat(parts).reshape(view.height, view.width, -1).numpy()


def explain(run: TrainedRun, names: list[str]) -> list[dict[str, NDArray[np.floating]]]:
    """Return the pictures of each photo by their titles; the uncertainty comes last.

    Raises:
        ConfigError: If a photo is no training image of the run.
    """
    scene = run.scene()
    frames = scene.select(split="train")
    numbers = {frame.name: i for i, frame in enumerate(frames)}
    for name in names:
        if name not in numbers:
            raise ConfigError(
                "PHOTO",
                expected=f"the name of a training image, such as {min(numbers)}",
                found=name,
                todo="choose one of sparse/split.txt that is no test image",
            )
    method: Any = run.model(0)
    lights: Tensor = method.network.params["light_codes"]
    passing: Tensor = method.network.params["transient_codes"]
    periods = torch.tensor([frame.period for frame in frames])
    store, rows = run.photos(scene), []
    for name in names:
        number = numbers[name]
        (view,) = run.frame_views(scene, [frames[number]])

        def lasting(light: Tensor, view: View = view) -> NDArray[np.float32]:
            return values(method, view, Codes(light[:, :0], light))[..., :3]

        own = lights[number : number + 1]
        row = {"photo": store.load(frames[number]) / 255, "what lasts": lasting(own)}
        for period, label in run.record.period_labels.items():
            row[f"… in the light of\n{label}"] = lasting(
                lights[periods == int(period)].mean(0, keepdim=True)
            )
        full = values(method, view, Codes(passing[number : number + 1], own))
        rows.append(row | {"with what passes": full[..., :3], "uncertainty": full[..., 3]})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("photo", nargs="+")
    options = parser.parse_args()
    try:
        rows = explain(open_run(options.run), options.photo)
    except ChronoSceneError as error:
        parser.error(str(error))
    most = max(float(row["uncertainty"].max()) for row in rows)
    height, width = rows[0]["uncertainty"].shape
    size = (CELL * len(rows[0]), (CELL * height / width + 0.05) * len(rows) + 0.4)
    figure = Figure(figsize=size, layout="compressed", dpi=110)
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    for r, row in enumerate(rows):
        for c, (title, image) in enumerate(row.items()):
            if r == 0:
                axes[0, c].set_title(title, fontsize=8)
            axes[r, c].imshow(image.clip(0, most if image.ndim == 2 else 1), "gray", vmin=0)
            axes[r, c].set_axis_off()
    figure.savefig(options.out, pil_kwargs={"quality": 85}, bbox_inches="tight", pad_inches=0.05)


if __name__ == "__main__":
    main()
