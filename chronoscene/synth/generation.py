"""From settings to a scene folder."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np

from chronoscene.formats import chronoscene as scene_format
from chronoscene.io.processes import Report
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Period, Points, Scene, WorldFrame
from chronoscene.synth.city.plan import make_world
from chronoscene.synth.city.world import World
from chronoscene.synth.flights import plan_frames
from chronoscene.synth.render.renderer import PeriodRenderer
from chronoscene.synth.settings import SynthSettings
from chronoscene.synth.sparse_points import make_points
from chronoscene.synth.truth import save_image, write_truth

MONTHS = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}
FIRST_YEAR = 2016


def run(out: Path, settings: SynthSettings, report: Report, *, truth: bool) -> None:
    """Generate a scene; see `chronoscene.synth.generate`. Either all of it appears or nothing."""
    report("city", 0, 1)
    with staged_folder(out) as staged:
        raw = staged.parent / "raw"
        scene = _make(raw, settings, report, out.name, truth=truth)
        scene_format.write(scene, staged, image_source="link")
        if truth:
            (raw / "gt").rename(staged / "gt")


def _make(raw: Path, settings: SynthSettings, report: Report, name: str, *, truth: bool) -> Scene:
    """Write photos and, if wanted, ground truth below ``raw`` and return the scene."""
    world = make_world(settings)
    renderers = make_renderers(settings, world)
    scene = Scene(
        name=name,
        root=raw,
        images_root=raw / "images",
        frames=plan_frames(settings, world, renderers),
        points=Points.empty(),
        periods=make_periods(world),
        split_rule=scene_format.TEST,
        format=scene_format.NAME,
        world=WorldFrame(unit="metre"),
    )
    tests = len(scene.select(split="test")) if truth else 0
    total = len(scene.frames) + tests * (settings.periods - 1) + 2
    done = 0

    def advance(what: str) -> None:
        nonlocal done
        done += 1
        report(what, done, total)

    advance("city")
    for frame in scene.frames:
        image = renderers[frame.period].image(frame.camera, frame.cam_from_world)
        save_image(scene.image_path(frame), image)
        advance("photos")
    report("points", done, total)
    points = make_points(settings, scene, renderers)
    advance("points")
    if truth:
        report("ground truth", done, total)
        write_truth(raw / "gt", scene, world, renderers, advance)
    return replace(scene, points=points)


def make_renderers(settings: SynthSettings, world: World) -> list[PeriodRenderer]:
    """One renderer per period."""
    low, high = world.core
    box = np.array([[*(low - 16.0), 0.3], [*(high + 16.0), 33.0]])
    return [
        PeriodRenderer(
            *world.geometry(period),
            light,
            supersample=settings.supersample,
            probe_box=box,
            probe_spacing=settings.probe_spacing,
        )
        for period, light in enumerate(world.lights)
    ]


def make_periods(world: World) -> tuple[Period, ...]:
    """Labels and dates, about half a year or more apart, in the season of each light."""
    periods = []
    last = date(FIRST_YEAR, 1, 1)
    for i, light in enumerate(world.lights):
        day = date(last.year, MONTHS[light.season], 11 + i % 17)
        while (day - last).days < 170 and i:
            day = day.replace(year=day.year + 1)
        periods.append(Period(i, f"{light.name} {day.year}", day.isoformat()))
        last = day
    return tuple(periods)
