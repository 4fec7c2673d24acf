"""Change masks of CL-Splats: as pictures, and against the truth of a scene that has it.

    python -m benchmarks.methods.cl_splats_masks SCENE OUT [--preset fast] [--seed 0]
        [--set NAME=VALUE ...]

Trains as ``chronoscene bench --strategy sequential`` does. Before each period but the first, the
model is compared with the photos of the new one: the masks of all its views are written below OUT
as PNG images, white where they have changed. Scores are of the test views that have a change mask
in SCENE/gt, those of a period together.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from baselines.cl_splats import SPEC
from baselines.cl_splats.changes import change_mask, change_scores
from baselines.cl_splats.method import CLSplats
from chronoscene.formats import read_scene
from chronoscene.harness.files.predictions import encode_png
from chronoscene.harness.plan.parts import Part, make_parts
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train.loop import seed_everything
from chronoscene.images.store import MAX_WIDTH, ImageStore
from chronoscene.images.truth import UNCHANGED, load_changes, truth_place
from chronoscene.methods import build_config
from chronoscene.metrics.change import change_scores as score
from chronoscene.scene import Scene

COLUMNS = ("changed", "marked", "AP", "AP geometry", "AP appearance", "F1", "IoU")


def look(method: CLSplats, part: Part, scene: Scene, out: Path) -> list[float]:
    """Write the masks of a new period; what `COLUMNS` says of them, if there is a truth."""
    scores, masks, truths = [], [], []
    for frame in scene.select(period=part.last):
        photo, counts = part.store.load(frame), part.store.load_mask(frame)
        image = method.render(part.view(frame), part.last - 1.0).rgb
        found = change_scores(image, photo, counts)
        changed = change_mask(found, method.config)
        path = (out / frame.name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(np.repeat(255 * changed[..., None].astype(np.uint8), 3, 2)))
        truth = scene.root / "gt" / truth_place("change", frame.name, part.last - 1)
        if truth.is_file():
            counted = np.ones_like(changed) if counts is None else counts
            size = part.store.camera(frame).size
            truths.append(load_changes(truth, size, MAX_WIDTH)[counted])
            scores.append(found[counted])
            masks.append(changed[counted])
    if not truths:
        return []
    changes, marked = np.concatenate(truths), np.concatenate(masks)
    values = score(np.concatenate(scores), changes)
    values |= {k: v for k, v in score(marked, changes, threshold=1).items() if "_ap" not in k}
    names = ("ap", "ap_geometry", "ap_appearance", "f1", "iou")
    columns = [values.get(f"change_{name}", np.nan) for name in names]
    return [float((changes != UNCHANGED).mean()), float(marked.mean()), *columns]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    overrides = dict(item.split("=", 1) for item in options.set)
    method = CLSplats(build_config(SPEC, preset=options.preset, overrides=overrides))
    scene = read_scene(options.scene)
    parts = make_parts(scene, ImageStore(scene), "sequential")
    rules = StopRule(method.config.iterations, None).split(len(parts))
    print("period", *(f"{name:>13}" for name in COLUMNS))
    for part, rule in zip(parts, rules, strict=True):
        seed_everything(options.seed)
        if part.extends:
            values = look(method, part, scene, options.out)
            print(f"{part.last:6}", *(f"{value:13.3f}" for value in values), flush=True)
            method.extend(part.train)
        else:
            method.setup(part.train, seed=options.seed, device="cpu")
        for index in range(rule.iterations or 0):
            method.step(index, index / (rule.iterations or 1))


if __name__ == "__main__":
    main()
