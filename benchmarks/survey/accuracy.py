"""Compare the files of a survey with the truth of a scene that has depth maps in ``gt/``.

    python -m benchmarks.survey.accuracy SCENE SURVEY

The true height of a cell is the highest point that the test views see in it at a period. Changes of
0.5 m and more are to be detected, and cells that change by less than 0.1 m count as stable; those
in between count in neither. Volumes are compared over the cells whose truth is known, over the
whole area and over squares of 20 m.
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import click
import laspy
import numpy as np
import rasterio

from chronoscene.arrays import Array
from chronoscene.formats import detect
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.changes import back_project
from chronoscene.images.truth import load_depth
from chronoscene.scene import Scene
from chronoscene.scene.similarity import median_and_nmad
from chronoscene.survey.difference import Difference, measure_volumes
from chronoscene.survey.grid import Grid
from chronoscene.survey.uncertainty import Registration, StableGround

CHANGED, STABLE = 0.5, 0.1  # Metres
SQUARE = 20.0  # Metres
MIN_KNOWN = 0.5  # Share of a square whose truth must be known


def true_heights(scene: Scene, grid: Grid, period: int) -> Array:
    """Height of the highest point that a test view sees in each cell. [H, W]"""
    heights = np.full(grid.shape, -np.inf)
    for frame in scene.select(split="test"):
        depth = load_depth(
            scene.root / "gt", frame.name, None if frame.period == period else period
        )
        if depth is not None:
            depth = np.where(depth > 0, depth, np.inf)
            viewpoint = Viewpoint(frame.name, frame.camera, frame.cam_from_world, period)
            xyz = back_project(depth, viewpoint)
            xyz = xyz[grid.holds(xyz)]
            np.maximum.at(heights, grid.cells(xyz), xyz[:, 2])
    return np.where(np.isfinite(heights), heights, np.nan)


def read(path: Path) -> Array:
    """Read the bands of a raster. [B, H, W]"""
    with rasterio.open(path) as file:
        return np.asarray(file.read(masked=True).astype(float).filled(np.nan))


def robust(errors: Array) -> str:
    """Describe errors in metres."""
    errors = errors[np.isfinite(errors)]
    median, nmad = median_and_nmad(errors)
    rmse = np.sqrt(np.mean(errors**2))
    return f"median {median:+.3f} NMAD {nmad:.3f} RMSE {rmse:.2f} m of {len(errors):,} cells"


@click.command(help=__doc__)
@click.argument("scene_root", metavar="SCENE", type=click.Path(path_type=Path))
@click.argument("survey", type=click.Path(path_type=Path))
def main(scene_root: Path, survey: Path) -> None:
    """Print all comparisons."""
    scene = detect(scene_root).read()
    summary = json.loads((survey / "survey.json").read_text())
    grid = Grid(**summary["raster"])
    print(f"{summary['run']}; cells of {grid.resolution:g} m")
    truth = {}
    for item in summary["periods"]:
        period = item["period"]
        truth[period] = true_heights(scene, grid, period)
        heights, spread, _ = read(next(survey.glob(f"surface_*{period}.tif")))
        error = heights - truth[period]
        known = np.isfinite(error)
        inside = np.mean(np.abs(error[known]) <= 1.96 * spread[known])
        print(
            f"height of period {period}: {robust(error)}; within 1.96 spreads {100 * inside:.0f} %"
        )
    squares: list[bool] = []
    for pair in summary["pairs"]:
        squares += compare(pair, survey, grid, truth)
    inside = f"{sum(squares)} of {len(squares)}"
    print(f"squares of {SQUARE:g} m: net volume within its interval in {inside}")


def compare(pair: dict, survey: Path, grid: Grid, truth: dict[int, Array]) -> list[bool]:
    """Print the comparisons of a pair; whether each square has its net volume in the interval."""
    a, b = pair["periods"]
    values, level, significant = read(survey / f"difference_{a}_{b}.tif")
    change = truth[b] - truth[a]
    known = np.isfinite(values) & np.isfinite(change)
    stable, changed = known & (np.abs(change) < STABLE), known & (np.abs(change) >= CHANGED)
    found = significant == 1
    right = (found & changed & (np.sign(values) == np.sign(change))).sum()
    print(f"difference {a} {b}: stable ground {robust(values[stable])}")
    print(f"  level of detection, median {np.nanmedian(level):.2f} m; false alarms "
          f"{100 * found[stable].mean():.1f} % of stable ground")  # fmt: skip
    print(f"  precision {right / found[stable | changed].sum():.3f}, recall "
          f"{right / changed.sum():.3f} of {changed.sum():,} changed cells")  # fmt: skip
    registration = Registration(**pair["registration"])
    ground = StableGround(**pair["stable_ground"])
    variance = ((level / 1.96) ** 2 - registration.sigma**2) / ground.factor**2
    made = Difference((a, b), np.where(known, values, np.nan), variance, ground, registration)
    volumes = measure_volumes(made, grid, "", np.ones(grid.shape, bool))
    real = change[known] * grid.resolution**2
    sums = {"fill": real[real > 0].sum(), "cut": -real[real < 0].sum(), "net": real.sum()}
    for kind, value in sums.items():
        mine, interval = getattr(volumes, f"{kind}_m3"), getattr(volumes, f"{kind}_interval_m3")
        print(f"  {kind}: {mine:,.0f} +- {interval:,.0f} m3, truth {value:,.0f}")
    clouds = laspy.read(survey / f"m3c2_{a}_{b}.laz")
    print(f"  M3C2: {describe(clouds, grid, change)}")
    steps = round(SQUARE / grid.resolution)
    covered = []
    for row, column in product(range(0, grid.height, steps), range(0, grid.width, steps)):
        inside = np.zeros(grid.shape, bool)
        inside[row : row + steps, column : column + steps] = True
        if known[inside].sum() >= MIN_KNOWN * steps**2:
            square = measure_volumes(made, grid, "", inside)
            error = square.net_m3 - change[inside & known].sum() * grid.resolution**2
            covered.append(bool(abs(error) <= square.net_interval_m3))
    return covered


def describe(clouds: laspy.LasData, grid: Grid, change: Array) -> str:
    """Distances where the ground is level, and false alarms where nothing changed around them."""
    from scipy.ndimage import maximum_filter

    size = 2 * round(2 / grid.resolution) + 1
    moved = maximum_filter(np.nan_to_num(np.abs(change), nan=np.inf), size)
    column = ((np.asarray(clouds.x) - grid.left) / grid.resolution).astype(int)
    row = ((grid.top - np.asarray(clouds.y)) / grid.resolution).astype(int)
    inside = (column < grid.width) & (row < grid.height)
    still = np.zeros(len(row), bool)
    still[inside] = moved[row[inside], column[inside]] < STABLE
    alarms = np.asarray(clouds["significant"])[still].mean()
    level = np.median(np.asarray(clouds["level_of_detection"])[still])
    return (
        f"{robust(np.asarray(clouds['m3c2_distance'])[still])} where nothing within 2 m changed, "
        f"level {level:.2f} m, false alarms {100 * alarms:.1f} %"
    )


if __name__ == "__main__":
    main()
