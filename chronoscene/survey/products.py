"""All products of a survey, written to a folder, and their summary."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.checks import import_extra
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import safe_part
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.io.documents import read_json_document
from chronoscene.io.laz import write_laz
from chronoscene.io.processes import Report
from chronoscene.io.tables import csv_text
from chronoscene.registration.output import CERTIFICATE
from chronoscene.registration.report.coordinates import GEOREFERENCE
from chronoscene.scene import Scene
from chronoscene.statistics.measures import median_of
from chronoscene.survey.cloud import PointCloud, dense_cloud, sparse_cloud
from chronoscene.survey.difference import Volumes, measure_volumes, subtract
from chronoscene.survey.distances import measure_distances
from chronoscene.survey.figure import draw_difference
from chronoscene.survey.grid import Grid, choose_grid, natural_resolution
from chronoscene.survey.map_frame import MapFrame, map_frame
from chronoscene.survey.rasters import WHOLE, Polygon, read_polygons, write_raster
from chronoscene.survey.surface import Surface, check_heights, map_surface
from chronoscene.survey.uncertainty import UNKNOWN, certified_registration
from chronoscene.survey.views import depth_views

SUMMARY, VOLUMES = "survey.json", "volumes.csv"
FREE = (
    "the model was not held to the sparse points; with --set depth_weight=0.1, as in preset "
    "balanced of chronogs, lawns and other places without texture lie at their height"
)


@dataclass(frozen=True, slots=True)
class SurveyOptions:
    """Products to make."""

    pairs: tuple[tuple[int, int], ...]
    """Periods to compare, the earlier first."""
    resolution: float | None = None
    """Metres; None for the natural one."""
    area: Path | None = None
    """GeoJSON file with the polygons of volumes."""
    crs: str | None = None
    """Reference system of the products."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A survey at work: where it writes, and in which coordinates."""

    folder: Path
    scene: Scene
    frame: MapFrame

    def write_period(self, period: int, grid: Grid, surface: Surface) -> None:
        """Write orthophoto and surface model of a period."""
        known = np.where(np.isfinite(surface.heights), 255, 0).astype(np.uint8)
        channels = zip(("red", "green", "blue"), np.moveaxis(surface.colors, 2, 0), strict=True)
        picture = dict(channels) | {"alpha": known}
        write_raster(self._path("orthophoto", period, "tif"), grid, self.frame, picture)
        bands = {
            "height, m": surface.heights,
            "standard deviation of the height, m": surface.spread,
            "photos that see the cell": surface.views,
        }
        write_raster(self._path("surface", period, "tif"), grid, self.frame, bands)

    def write_cloud(self, period: int, cloud: PointCloud) -> dict[str, Any]:
        """Write the points of a period; return the beginning of its summary."""
        numbers: dict[str, NDArray[Any]] = {
            "period": np.full(len(cloud), period, np.uint16),
            "sigma": cloud.spread.astype(np.float32),
        }
        write_laz(
            self._path("points", period, "laz"),
            cloud.xyz,
            cloud.rgb,
            self.frame.crs,
            dimensions=numbers,
        )
        label = self.scene.periods[period].label
        return {"period": period, "label": label, "points": len(cloud)}

    def _path(self, kind: str, period: int, suffix: str) -> Path:
        label = self.scene.periods[period].label
        shown = safe_part(label).replace(" ", "-")
        name = kind if label == str(period) else f"{kind}_{shown}"
        return self.folder / f"{name}_{period}.{suffix}"

    def compare_surfaces(
        self, pair: tuple[int, int], grid: Grid, surfaces: Mapping[int, Surface],
        polygons: Mapping[str, Polygon],
    ) -> dict[str, Any]:  # fmt: skip
        """Write difference and picture of two periods; return their summary with the volumes."""
        found = subtract(self.scene, grid, surfaces, pair)
        known = np.isfinite(found.values)
        name = "difference_{}_{}".format(*pair)
        bands = {
            "height of the later period minus the earlier, m": found.values,
            "level of detection at 95 %, m": found.level,
            "significant": np.where(known, found.significant, np.nan),
        }
        write_raster(self.folder / f"{name}.tif", grid, self.frame, bands)
        first, second = (self.scene.periods[period].label for period in pair)
        picture = self.folder / f"{name}.png"
        draw_difference(picture, grid, surfaces[pair[1]], found, (first, second))
        return {
            "registration": asdict(found.registration),
            "stable_ground": asdict(found.stable),
            "level_of_detection": median_of(found.level),
            "changed_share": float(found.significant.sum() / max(known.sum(), 1)),
            "volumes": [
                asdict(measure_volumes(found, grid, name, *polygon))
                for name, polygon in polygons.items()
            ],
        }

    def compare_clouds(
        self, pair: tuple[int, int], clouds: Mapping[int, PointCloud], spacing: float, sigma: float
    ) -> dict[str, Any]:
        """Write the distances by M3C2 of two periods; return their summary."""
        first, second = (clouds[period] for period in pair)
        found = measure_distances(first, second, spacing, sigma)
        if isinstance(found, str):
            return {"m3c2": None, "m3c2_absent": found}
        significant = np.abs(found.values) > found.level
        numbers: dict[str, NDArray[Any]] = {
            "m3c2_distance": found.values.astype(np.float32),
            "level_of_detection": found.level.astype(np.float32),
            "slope": found.slope.astype(np.float32),
            "significant": significant.astype(np.uint8),
        }
        path = self.folder / "m3c2_{}_{}.laz".format(*pair)
        write_laz(path, found.cores.xyz, found.cores.rgb, self.frame.crs, dimensions=numbers)
        return {
            "m3c2": {
                "core_points": len(significant),
                "median": median_of(found.values),
                "level_of_detection": median_of(found.level),
                "changed_share": float(significant.mean()) if len(significant) else None,
            }
        }

    def coordinates(self) -> dict[str, Any]:
        """Describe coordinates and absolute position."""
        frame, root = self.frame, self.scene.root
        kind = _optional(root / GEOREFERENCE).get("height_kind", "as in the scene")
        return {
            "crs": None if frame.is_local else frame.crs,
            "note": "local metres: the scene has no georeference" if frame.is_local else None,
            "remarks": list(frame.remarks),
            "heights": "local" if frame.is_local else f"{kind}; no geoid is applied",
            "affine_map": {
                "matrix": frame.matrix.tolist(),
                "offset": frame.offset.tolist(),
                "largest_error": frame.error,
            },
            "absolute_position": _optional(root / CERTIFICATE).get("absolute_position"),
        }


def check_packages() -> None:
    """Check that the packages of the extra are installed.

    Raises:
        ConfigError: If one is missing.
    """
    for name in ("laspy", "lazrs", "py4dgeo", "rasterio"):
        import_extra(name, "survey", "chronoscene survey")


def write_survey(
    run: TrainedRun | None, scene: Scene, folder: Path, options: SurveyOptions, report: Report
) -> dict[str, Any]:
    """Write all products of a finished run, or those of a scene without one, and the summary.

    Arguments, result and errors as for `survey_run`.
    """
    scene = replace(scene, points=scene.points.select(scene.points.finite))
    if run is None:
        summary = survey_scene(scene, folder, options)
    else:
        summary = survey_run(run, scene, folder, options, report)
        rows = [
            (*pair["periods"], *v.values()) for pair in summary["pairs"] for v in pair["volumes"]
        ]
        table = csv_text(("a", "b", *(column.name for column in fields(Volumes))), rows)
        (folder / VOLUMES).write_text(table, encoding="utf-8", newline="\n")
    text = json.dumps(summary, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    (folder / SUMMARY).write_text(text, encoding="utf-8", newline="\n")
    return summary


def survey_run(
    run: TrainedRun, scene: Scene, folder: Path, options: SurveyOptions, report: Report
) -> dict[str, Any]:
    """Make the products of a finished run.

    Args:
        run: The run.
        scene: The scene that it was trained on.
        folder: An existing folder.
        options: Products to make.
        report: Progress.

    Returns:
        The summary, for JSON.

    Raises:
        ConfigError: If an option does not fit, or the models do not know the periods.
        SceneError: If the scene has no metres, or its certificate is damaged.
    """
    if options.pairs and not run.distinguishes_periods:
        raise ConfigError(
            run.folder,
            expected="a run whose models know the periods",
            found=f"{run.spec.title} under strategy {run.record.strategy}",
            todo="open one under strategy joint or separate",
        )
    work = Survey(folder, scene, map_frame(scene, options.crs))
    resolution = options.resolution or natural_resolution(scene, run.record.max_width)
    grid = choose_grid(scene, work.frame, resolution)
    polygons = {WHOLE: Polygon(np.ones(grid.shape, bool), 1.0)}
    polygons |= read_polygons(options.area, grid, work.frame) if options.area else {}
    surfaces: dict[int, Surface] = {}
    clouds: dict[int, PointCloud] = {}
    periods, pairs, steps = [], [], run.num_periods + len(options.pairs)
    for period in range(run.num_periods):
        report("survey", period, steps)
        views = list(depth_views(run, scene, period))
        render = partial(run.render, period=period)
        surface = surfaces[period] = map_surface(render, views, work.frame, grid)
        clouds[period] = dense_cloud(views, work.frame, grid)
        work.write_period(period, grid, surface)
        known = float(np.isfinite(surface.heights).mean())
        summary = {
            "known_share": known,
            "height_deviation": median_of(surface.spread),
            "sparse_points": check_heights(surface, scene, period, work.frame, grid),
        }
        periods.append(work.write_cloud(period, clouds[period]) | summary)
    for number, pair in enumerate(options.pairs, run.num_periods):
        report("survey", number, steps)
        made = work.compare_surfaces(pair, grid, surfaces, polygons)
        sigma = made["registration"]["sigma"]
        distances = work.compare_clouds(pair, clouds, resolution, sigma)
        pairs.append({"periods": list(pair)} | made | distances)
    head = {"scene": scene.name, "run": run.record.label, "coordinates": work.coordinates()}
    made = head | {"raster": asdict(grid), "periods": periods, "pairs": pairs}
    return made if getattr(run.config, "depth_weight", 1.0) else made | {"note": FREE}


def survey_scene(scene: Scene, folder: Path, options: SurveyOptions) -> dict[str, Any]:
    """Make what a scene without a model has: its sparse points, and distances between those that
    one period alone sees.

    Arguments, result and errors as for `survey_run`.
    """
    for name in ("area", "resolution"):
        if getattr(options, name) is not None:
            raise ConfigError(
                f"--{name}",
                expected="a finished run, as rasters need a model",
                found=f"the scene {scene.root}",
                todo="name the folder of a run, or leave it out",
            )
    work = Survey(folder, scene, map_frame(scene, options.crs))
    clouds = {p.id: sparse_cloud(scene, p.id, work.frame) for p in scene.periods}
    periods, pairs = [work.write_cloud(*item) for item in clouds.items()], []
    for pair in options.pairs:
        alone = {p: sparse_cloud(scene, p, work.frame, alone=True) for p in pair}
        registration = certified_registration(scene, pair) or UNKNOWN
        spacing = _spacing(alone[pair[0]].xyz)
        made = work.compare_clouds(pair, alone, spacing, registration.sigma)
        pairs.append({"periods": list(pair), "registration": asdict(registration)} | made)
    head = {"scene": scene.name, "run": None, "coordinates": work.coordinates()}
    note = "no rasters and volumes: these need a finished run"
    return head | {"periods": periods, "pairs": pairs, "note": note}


def _spacing(xyz: Array) -> float:
    """Median distance of points to their nearest other place; 1 without any."""
    from scipy.spatial import cKDTree

    xyz = np.unique(xyz, axis=0)
    return float(np.median(cKDTree(xyz).query(xyz, 2)[0][:, 1])) if len(xyz) > 1 else 1.0


def _optional(path: Path) -> dict[str, Any]:
    return dict(read_json_document(path)) if path.is_file() else {}
