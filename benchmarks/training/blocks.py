"""Two blocks of a scene trained apart and joined, beside one model of all of it.

    python -m benchmarks.training.blocks SCENE --out FOLDER [--method chronogs] [--preset fast]
        [--iterations 2000] [--block-iterations 1000] [--share 0.2] [--threads 1] [--picture FILE]

Cuts the scene in two at the median of its points, along the longer horizontal axis. A block gets
the photos that have at least so large a share of their points in it, and all points that these see.
All three are trained by `chronoscene bench`, the blocks as two jobs that two machines could share.
The joined model of a period has the Gaussians of each block whose centres lie on its side of the
cut.

Prints the PSNR of the test views, as Gaussians without the network in both cases: over all pixels,
and over those that show what is within ``--band`` of the cut, where a seam would be. For that the
scene needs depth (``gt/depth``), as generated ones have.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import chronoscene as cs
from benchmarks.markdown import table
from chronoscene.edit import Edits, edit
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.truth import load_depth
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame, Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.tracks import track_owners

Mask = NDArray[np.bool_]

HEADS = ("", "PSNR", "near the cut", "Gaussians of all periods", "longest training, s")


def cut_of(scene: Scene) -> tuple[int, float]:
    """Axis and place of the cut: the median of the points, along x or y."""
    low, high = np.percentile(scene.points.xyz[:, :2], (5, 95), axis=0)
    axis = int(np.argmax(high - low))
    return axis, float(np.median(scene.points.xyz[:, axis]))


def photos_of_block(scene: Scene, inside: Mask, share: float) -> tuple[str, ...]:
    """Names of the photos with at least so large a share of their observations inside."""
    points, frames = scene.points, len(scene.frames)
    counted = inside[track_owners(points.track_start)]
    all_of = np.bincount(points.track_frame, minlength=frames)
    some = np.bincount(points.track_frame[counted], minlength=frames)
    kept = some >= np.maximum(1, share * all_of)
    return tuple(frame.name for frame, keep in zip(scene.frames, kept, strict=True) if keep)


def joined(runs: Sequence[TrainedRun], period: int, axis: int, cut: float) -> GaussianCloud:
    """Gaussians of both blocks in the world frame, each from its side of the cut."""
    parts = []
    for side, run in enumerate(runs):
        cloud = run.gaussians(period)
        own = (cloud.means[:, axis] >= cut) == bool(side)
        parts.append([getattr(cloud, field.name)[own] for field in fields(cloud)])
    return GaussianCloud(*map(np.concatenate, zip(*parts, strict=True)))


def near_the_cut(scene: Scene, frame: Frame, axis: int, cut: float, band: float) -> Mask:
    """Pixels whose surface is within ``band`` world units of the cut. [H, W]"""
    depth = load_depth(scene.root / "gt", frame.name, None)
    if depth is None:
        raise SystemExit(f"{frame.name}: expected depth in {scene.root / 'gt'}, found none")
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(frame.camera.K).T
    world_from_cam = np.linalg.inv(frame.cam_from_world)
    places = (rays * depth[..., None]) @ world_from_cam[axis, :3] + world_from_cam[axis, 3]
    return np.asarray((depth > 0) & (np.abs(places - cut) <= band))


def render(run: TrainedRun, cloud: GaussianCloud, scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    """Draw Gaussians of the world frame as the run's renderer does. [H, W, 3]"""
    (view,) = run.frame_views(scene, [frame])
    shown = run.model(frame.period).render_gaussians(
        cloud.transformed(run.training_from_world), view
    )
    return to_bytes(shown.rgb)


def main() -> None:
    """Train what is not trained yet, join, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--method", default="chronogs")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, default=2000, help="of the one model")
    parser.add_argument("--block-iterations", type=int, default=1000, help="of each block")
    parser.add_argument("--share", type=float, default=0.2)
    parser.add_argument("--band", type=float, default=2.0, help="in units of the scene")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--picture", type=Path, help="a test view: photo, one model, joined")
    given = parser.parse_args()

    scene = cs.read_scene(given.scene)
    axis, cut = cut_of(scene)
    high = np.asarray(scene.points.xyz[:, axis] >= cut)
    places = [given.out / f"{scene.name}-{side}" for side in ("low", "high")]
    for place, inside in zip(places, (~high, high), strict=True):
        names = photos_of_block(scene, inside, given.share)
        if not place.exists():
            edit(scene, place, Edits(keep=names), image_source="link")
        print(f"{place.name}: {len(names)} of {len(scene.frames)} photos")

    options = {"preset": given.preset, "threads": given.threads, "log": print}
    out = given.out / "runs"
    whole = cs.bench(given.scene, given.method, out=out, iterations=given.iterations, **options)
    half = cs.bench(places, given.method, out=out, iterations=given.block_iterations, **options)
    run = cs.open_run(whole.runs[0])
    blocks = sorted(map(cs.open_run, half.runs), key=lambda r: r.record.scene.endswith("high"))
    store = run.photos(scene)
    one = [run.gaussians(period, scene=scene) for period in range(scene.num_periods)]
    two = [joined(blocks, period, axis, cut) for period in range(scene.num_periods)]

    scores: dict[str, list[tuple[float, float]]] = {"one model": [], "joined": []}
    for frame in scene.select(split="test"):
        photo = store.load(frame)
        band = near_the_cut(scene, frame, axis, cut, given.band)
        shown = [photo]
        for name, clouds in (("one model", one), ("joined", two)):
            image = render(run, clouds[frame.period], scene, frame)
            at_seam = psnr(image, photo, band) if band.any() else np.nan
            scores[name].append((psnr(image, photo, None), at_seam))
            shown.append(image)
        if given.picture and frame is scene.select(split="test")[0]:
            Image.fromarray(np.concatenate(shown, axis=1)).save(given.picture)

    numbers = {
        "one model": (sum(map(len, one)), run.record.seconds),
        "joined": (sum(map(len, two)), max(block.record.seconds or 0.0 for block in blocks)),
    }
    rows = []
    for name, values in scores.items():
        everywhere, seam = np.nanmean(np.array(values), axis=0)
        gaussians, seconds = numbers[name]
        rows.append((name, f"{everywhere:.2f}", f"{seam:.2f}", f"{gaussians:,}", f"{seconds:.0f}"))
    print(table(HEADS, rows))


if __name__ == "__main__":
    main()
