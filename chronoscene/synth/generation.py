"""From settings to a scene folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path

import numpy as np

from chronoscene.formats import chronoscene as scene_format
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Camera, Frame, Period, Points, Scene, WorldFrame
from chronoscene.synth.city.plan import make_world
from chronoscene.synth.city.world import World
from chronoscene.synth.flights import View, make_camera, plan_views
from chronoscene.synth.render.renderer import PeriodRenderer, load_open3d
from chronoscene.synth.settings import SynthSettings
from chronoscene.synth.sparse_points import make_points
from chronoscene.synth.truth import save_jpeg, write_truth

Progress = Callable[[int, int, str], None]

MONTHS = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}
FIRST_YEAR = 2016


def run(out: Path, settings: SynthSettings, progress: Progress | None = None) -> None:
    """Make a scene; see `chronoscene.synth.generate`. The folder appears complete or not at all."""
    load_open3d()
    with warnings.catch_warnings(), staged_folder(out) as staged:
        # open3d loads a TBB that Numba finds too old; Numba then takes another layer, and says so.
        warnings.filterwarnings("ignore", message="The TBB threading layer")
        raw = staged.parent / "raw"
        scene = _make(raw, settings, progress or (lambda done, total, what: None), out.name)
        scene_format.write(scene, staged, image_source="link")
        (raw / "gt").rename(staged / "gt")


def _make(raw: Path, settings: SynthSettings, progress: Progress, name: str) -> Scene:
    """Write photos and ground truth below ``raw`` and return the scene."""
    world = make_world(settings)
    renderers = make_renderers(settings, world)
    camera = make_camera(settings)
    views = plan_views(settings, world, renderers, camera)
    tests = sum(v.split == "test" for v in views)
    total = len(views) + tests * (settings.periods - 1) + 2
    done = 0

    def advance(what: str) -> None:
        nonlocal done
        done += 1
        progress(done, total, what)

    advance("city")
    for view in views:
        image = renderers[view.period].image(camera, view.cam_from_world)
        save_jpeg(raw / "images" / view.name, image)
        advance("photos")
    points = make_points(settings, renderers, camera, views, raw / "images")
    advance("points")
    periods = make_periods(world)
    write_truth(raw / "gt", world, renderers, camera, views, periods, raw / "images", advance)
    return _scene(name, raw, camera, views, points, periods)


def make_renderers(settings: SynthSettings, world: World) -> list[PeriodRenderer]:
    """One renderer per period."""
    low, high = world.core
    box = np.array([[*(low - 16.0), 0.3], [*(high + 16.0), 33.0]])
    renderers = []
    for period, light in enumerate(world.lights):
        part, ids = world.geometry(period)
        renderers.append(
            PeriodRenderer(
                part,
                ids,
                light,
                supersample=settings.supersample,
                probe_box=box,
                probe_spacing=settings.probe_spacing,
            )
        )
    return renderers


def make_periods(world: World) -> tuple[Period, ...]:
    """Labels and dates: at least half a year apart, in the season of the light."""
    periods = []
    last = date(FIRST_YEAR, 1, 1)
    for i, light in enumerate(world.lights):
        day = date(last.year, MONTHS[light.season], 11 + i % 17)
        while (day - last).days < 170 and i:
            day = day.replace(year=day.year + 1)
        periods.append(Period(i, f"{light.name} {day.year}", day.isoformat()))
        last = day
    return tuple(periods)


def _scene(
    name: str,
    raw: Path,
    camera: Camera,
    views: Sequence[View],
    points: Points,
    periods: tuple[Period, ...],
) -> Scene:
    frames = tuple(
        Frame(v.name, i + 1, camera, v.cam_from_world, v.period, v.split)
        for i, v in enumerate(views)
    )
    return Scene(
        name=name,
        root=raw,
        images_root=raw / "images",
        frames=frames,
        points=points,
        periods=periods,
        split_rule=scene_format.TEST,
        format=scene_format.NAME,
        world=WorldFrame(unit="metre"),
    )
