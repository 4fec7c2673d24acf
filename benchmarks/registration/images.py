"""Photos of rendered cities, with GPS, registered by the whole command; used by `accuracy.py`."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from PIL import Image, ImageEnhance

from benchmarks.registration import outcomes as shared
from chronoscene.arrays import Array
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import read_scene
from chronoscene.geodesy import Georeference
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.pipeline import run
from chronoscene.registration.result import Registered
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.synth import SynthSettings, generate
from chronoscene.synth.city.world import World

ORIGIN = Georeference(48.1, 11.5, 520.0, "as stated")


@dataclass(frozen=True, slots=True)
class ImageCase:
    """One rendered scene and how its photos are treated."""

    name: str
    seed: int
    periods: int = 2
    kind: str = "aerial"
    views: int = 16
    rebuilt: float = 0.0
    """Share of the blocks that are torn down and rebuilt at one date."""
    gamma: float = 1.0
    """Gamma of the periods after the first, for another exposure."""
    colour: float = 1.0
    """Saturation of the periods after the first."""
    quality: int = 92
    """JPEG."""
    gps: bool = True
    blocks: int = 2
    """Blocks of the city along each axis."""
    width: int = 800
    """Pixels."""
    height: int = 600
    passes: tuple[float, ...] = ()
    """Degrees to the left of the way in which each walk around a block looks."""
    other_place: bool = False
    """True if the last period shows another city, so that nothing can be right. It is mirrored,
    because the textures of all cities are alike."""

    @property
    def folder(self) -> str:
        """Name of the folder of its scene and photos."""
        return self.name.replace(", ", "-").replace(" ", "_")


CASES = (
    ImageCase("two periods", 31),
    ImageCase("two periods, no GPS", 32, gps=False),
    ImageCase("two periods, dark", 33, gamma=1.8, colour=0.4, quality=60),
    ImageCase("two periods, half rebuilt", 34, rebuilt=0.5),
    ImageCase("two periods, all rebuilt", 35, rebuilt=1.0),
    ImageCase("two periods, all rebuilt, dark, no GPS", 36, rebuilt=1.0, gamma=1.8, gps=False),
    ImageCase("two periods, very dark", 37, gamma=3.0, colour=0.0, quality=25),
    ImageCase("four periods", 38, periods=4),
    ImageCase("four periods, half rebuilt, dark", 39, periods=4, rebuilt=0.5, gamma=1.6),
    ImageCase("four periods, all rebuilt", 40, periods=4, rebuilt=1.0),
    ImageCase("street, two periods", 41, kind="street"),
    ImageCase("street, two periods, 40 photos a date", 45, kind="street", views=40),
    ImageCase("street, two periods, 80 photos a date", 45, kind="street", views=80),
    ImageCase("street, then to the side", 45, kind="street", views=156, passes=(0.0, 90.0)),
    ImageCase("street, then diagonally", 45, kind="street", views=156, passes=(0.0, 45.0)),
    ImageCase("street, half rebuilt, dark", 42, kind="street", rebuilt=0.5, gamma=1.6),
    ImageCase("forward-facing, two periods", 46, kind="facing", views=24, gps=False),
    ImageCase("forward-facing, half rebuilt", 47, kind="facing", views=24, rebuilt=0.5, gps=False),
    ImageCase("other place", 43, other_place=True),
    ImageCase("other place, no GPS", 44, other_place=True, gps=False),
)


def run_images(options: argparse.Namespace) -> list[shared.Outcome]:
    """Render, register and judge the cases, with the options of `accuracy.py`."""
    outcomes = []
    routes = shared.ROUTES if options.route == "all" else (options.route,)
    with shared.work_folder(options.work) as work:
        for case in [c for c in CASES if options.only in c.name][: options.cases]:
            case = replace(case, seed=case.seed + options.seed)
            folder = work / case.folder
            truth = make_photos(case, folder)
            outcomes += [_run_case(case, folder, truth, route) for route in routes]
    return outcomes


def _run_case(case: ImageCase, folder: Path, truth: dict[str, Array], route: str) -> shared.Outcome:
    found: list[Inspection] = []
    start, cpu = time.perf_counter(), shared.cpu_seconds()
    try:
        if route == "frozen":
            model = _frozen(folder, found)
        else:
            out = folder / f"registered-{route}"
            options = shared.options_for(folder / "work", None if route == "auto" else route)
            model = run(read_captures(folder / "photos"), out, options, inspected=found.append)
    except ChronoSceneError as error:
        print(f"{case.name}, {route}: refused: {error}", flush=True)
        return shared.refused(case.name, route, case.periods, shared.cpu_seconds() - cpu)
    poses = true_poses(model, truth)
    outcome = shared.judged(
        case.name, route, model, poses, found[-1].verdict, shared.cpu_seconds() - cpu
    )
    print(
        f"{case.name}, {route}: route {model.route}, {len(model.names)} of "
        f"{len(model.names) + len(model.unregistered)} photos, "
        f"{time.perf_counter() - start:.0f} s",
        flush=True,
    )
    shared.print_outcome(outcome, found[-1])
    return outcome


def _frozen(folder: Path, found: list[Inspection]) -> Registered:
    """All periods but the last are registered; the last is added to them."""
    periods = sorted(p.name for p in (folder / "photos").iterdir())
    old = folder / "old"
    shutil.rmtree(old, ignore_errors=True)
    for label in periods[:-1]:
        shutil.copytree(folder / "photos" / label, old / label)
    base = folder / "registered-old"
    run(read_captures(old), base, shared.options_for(folder / "work-old", None))
    captures = read_captures(folder / "photos" / periods[-1])
    options = shared.options_for(folder / "work-frozen", None)
    out = folder / "registered-frozen"
    return run(captures, out, options, into=read_scene(base), inspected=found.append)


def true_poses(model: Registered, truth: Mapping[str, Array]) -> Array:
    """Truth of the images of a model, by the names of their photos. [N, 4, 4]"""
    return np.stack([truth[Path(name).name] for name in model.names])


def make_photos(case: ImageCase, folder: Path) -> dict[str, Array]:
    """Write photos by period with noisy GPS in EXIF; the true pose of each, by its file's name."""
    scenes = [_render(case, folder / "scene", case.seed)]
    if case.other_place:
        scenes.append(_render(case, folder / "other", case.seed + 1000))
    photos = folder / "photos"
    shutil.rmtree(photos, ignore_errors=True)
    rng = np.random.default_rng(case.seed)
    truth = {}
    for period in range(case.periods):
        scene = scenes[-1] if period == case.periods - 1 else scenes[0]
        frames = scene.select(period=period)
        centres = np.array([camera_centre(f.cam_from_world) for f in frames])
        gps = _noisy(rng, centres)
        for frame, place in zip(frames, gps, strict=True):
            target = photos / f"{2016 + 2 * period}" / Path(frame.name).name
            target.parent.mkdir(parents=True, exist_ok=True)
            known = place if case.gps else None
            _write(
                case, scene.image_path(frame), target, period, known, mirror=scene is not scenes[0]
            )
            truth[target.name] = frame.cam_from_world
    return truth


def _render(case: ImageCase, folder: Path, seed: int) -> Scene:
    if not (folder / "sparse").is_dir():
        settings = SynthSettings(
            kind=case.kind, periods=case.periods, width=case.width, height=case.height,
            views=case.views, points=2000, blocks=case.blocks, seed=seed, rebuilt=case.rebuilt,
        )  # fmt: skip
        walk = partial(_around_a_block, passes=case.passes)
        with patch("chronoscene.synth.flights._walk", walk) if case.passes else nullcontext():
            generate(folder, settings, truth=False)
    return read_scene(folder)


def _around_a_block(
    world: World, count: int, rng: np.random.Generator, *, passes: tuple[float, ...]
) -> list[tuple[Array, Array]]:
    """Walk around one block for each pass, turning gradually in the corners."""
    lines = [
        sorted({round(float(a[k]), 6) for a, b in world.roads if abs(a[k] - b[k]) < 1e-6})[:2]
        for k in (0, 1)
    ]
    (left, right), (front, back) = lines
    ring = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    at = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1)))

    def place(s: float) -> Array:
        return np.array([np.interp(s % at[-1], at, ring[:, k]) for k in (0, 1)])

    planned = []
    each = count // len(passes)
    for degrees in passes:
        start = rng.uniform(0, at[-1])
        for i in range(each):
            s = start + at[-1] * (i + rng.uniform(-0.2, 0.2)) / each
            way = place(s + 4) - place(s - 4)
            way /= np.linalg.norm(way)
            side = np.array([-way[1], way[0]])
            yaw = np.radians(degrees) + rng.normal(0, 0.06)
            toward = np.cos(yaw) * way + np.sin(yaw) * side
            eye = np.array([*(place(s) + rng.uniform(-0.8, 0.8) * side), rng.uniform(1.6, 1.9)])
            target = np.array([*(eye[:2] + 10 * toward), eye[2] + rng.uniform(0.3, 1.5)])
            planned.append((eye, target))
    return planned


def _noisy(rng: np.random.Generator, centres: Array) -> Array:
    """GPS with 3 m of noise and one position in ten 30 to 300 m off. [N, 3]"""
    far = rng.normal(size=centres.shape)
    far *= rng.uniform(30, 300, (len(far), 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    gross = rng.random(len(centres)) < 0.1
    return centres + rng.normal(0, 3.0, centres.shape) + np.where(gross[:, None], far, 0.0)


def _write(
    case: ImageCase, source: Path, target: Path, period: int, place: Array | None,
    *, mirror: bool,
) -> None:  # fmt: skip
    with Image.open(source) as image:
        picture = image.convert("RGB")
    if mirror:
        picture = picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    if period > 0:
        picture = picture.point([round(255 * (v / 255) ** case.gamma) for v in range(256)] * 3)
        picture = ImageEnhance.Color(picture).enhance(case.colour)
    exif = Image.Exif()
    exif[0x0132] = f"{2016 + 2 * period}:06:01 12:00:00"
    if place is not None:
        latitude, longitude, height = ORIGIN.to_geodetic(place[None])[0]
        exif.get_ifd(0x8825).update(
            {
                1: "N" if latitude >= 0 else "S", 2: _sexagesimal(abs(latitude)),
                3: "E" if longitude >= 0 else "W", 4: _sexagesimal(abs(longitude)),
                5: b"\0", 6: float(height),
            }
        )  # fmt: skip
    picture.save(target, quality=case.quality if period else 92, exif=exif)


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes = (degrees % 1) * 60
    return float(int(degrees)), float(int(minutes)), (minutes % 1) * 60
