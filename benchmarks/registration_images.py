"""Rendered cities for `benchmarks/registration.py`: photos with GPS, through the whole command."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageEnhance

from chronoscene.errors import ChronoSceneError
from chronoscene.formats import read_scene
from chronoscene.geometry import camera_centre
from chronoscene.registration.captures import read_captures
from chronoscene.registration.certificate import certify
from chronoscene.registration.certificate_json import to_json
from chronoscene.registration.generated import Generated, pose_errors
from chronoscene.registration.georeference import Georeference
from chronoscene.registration.model import Registered
from chronoscene.registration.pipeline import Options, run
from chronoscene.registration.report import write_report
from chronoscene.registration.verdict import judge
from chronoscene.scene import Scene
from chronoscene.synth import SynthSettings, generate

ORIGIN = Georeference(48.1, 11.5, 520.0, "as stated")


@dataclass(frozen=True, slots=True)
class ImageCase:
    """One rendered scene and how its photos are treated."""

    name: str
    periods: int = 2
    kind: str = "aerial"
    views: int = 14
    seed: int = 0
    gamma: float = 1.0
    """Of the periods after the first: another exposure."""
    colour: float = 1.0
    """Saturation of the periods after the first."""
    quality: int = 92
    """JPEG."""
    gps: bool = True
    other_place: bool = False
    """Whether the last period is of another city, mirrored because the textures of all cities are
    alike: nothing can be right."""


CASES = (
    ImageCase("two periods", seed=11),
    ImageCase("two periods, no GPS", seed=12, gps=False),
    ImageCase("two periods, dark", seed=13, gamma=1.8, colour=0.4, quality=60),
    ImageCase("four periods", periods=4, seed=14),
    ImageCase("four periods, dark", periods=4, seed=15, gamma=1.6, colour=0.5, quality=70),
    ImageCase("other place", seed=16, other_place=True),
    ImageCase("two periods, very dark", seed=17, gamma=3.0, colour=0.0, quality=25),
    ImageCase("street, two periods", kind="street", seed=18),
)


def run_images(options: argparse.Namespace) -> list[object]:
    """Render, register and judge the cases, with the options of `benchmarks/registration.py`."""
    outcomes = []
    with work_folder(options.work) as work:
        for case in [c for c in CASES if options.only in c.name][: options.cases]:
            found = _run_case(case, work, options.route)
            if found is not None:
                outcomes.append(found)
                _print(case, found)
    return outcomes


@contextmanager
def work_folder(kept: Path | None) -> Iterator[Path]:
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as folder:
        yield Path(folder)


def _run_case(case: ImageCase, work: Path, route: str) -> object | None:
    from registration import outcome

    folder = work / case.name.replace(", ", "-").replace(" ", "_")
    photos, truth = _photos(case, folder)
    out = folder / f"registered-{route}"
    chosen = Options(route=None if route == "auto" else route, overwrite=True, work=folder / "work")  # type: ignore[arg-type]
    start, cpu = time.perf_counter(), time.process_time()
    try:
        model = run(read_captures(photos), out, chosen)
    except ChronoSceneError as error:
        print(f"{case.name}: refused: {error}", flush=True)
        return None
    certificate = certify(model)
    verdict = judge(certificate)
    seconds = time.process_time() - cpu
    (folder / f"registration-{route}.json").write_text(
        json.dumps(to_json(certificate, verdict), indent=1)
    )
    write_report(folder / f"report-{route}.html", model, certificate, verdict, title=case.name)
    print(
        f"{case.name}: route {model.route}, {len(model.names)} of "
        f"{len(model.names) + len(model.unregistered)} photos, "
        f"{time.perf_counter() - start:.0f} s",
        flush=True,
    )
    poses = np.stack([truth[name] for name in model.names])
    made = Generated(model, poses)
    _print_errors(model, poses)
    return outcome(case.name, made, certificate, verdict, seconds)


def _print_errors(model: Registered, truth: NDArray[np.float64]) -> None:
    """Errors of every period in the frame of all cameras together."""
    extent = float(np.linalg.norm(np.ptp(camera_centre(truth), axis=0)))
    every = np.ones(len(model.names), bool)
    rotation, centre = pose_errors(model.cam_from_world, truth, every)
    for p, label in enumerate(model.labels):
        mine = model.periods == p
        if mine.any():
            print(
                f"  frame of all cameras, {label}: rotation {np.median(rotation[mine]):.4f} "
                f"(largest {rotation[mine].max():.4f}) degrees, centre "
                f"{100 * np.median(centre[mine]) / extent:.4f} "
                f"(largest {100 * centre[mine].max() / extent:.4f}) % of the extent"
            )


def _print(case: ImageCase, found: object) -> None:
    for p, row in enumerate(found.periods, 1):  # type: ignore[attr-defined]
        print(
            f"  frame of the first period, {p}: rotation {row[0]:.4f} (largest {row[1]:.4f}) "
            f"degrees, centre {row[2]:.4f} (largest {row[3]:.4f}) % of the extent"
        )
    print(f"  verdict {found.verdict} {found.reason}", flush=True)  # type: ignore[attr-defined]


def _photos(case: ImageCase, folder: Path) -> tuple[Path, dict[str, NDArray[np.float64]]]:
    """Photos by period with noisy GPS in EXIF, and the true pose of each."""
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
            name = f"{2016 + 2 * period}/{Path(frame.name).name}"
            target = photos / name
            target.parent.mkdir(parents=True, exist_ok=True)
            known = place if case.gps else None
            _write(
                case, scene.image_path(frame), target, period, known, mirror=scene is not scenes[0]
            )
            truth[name] = frame.cam_from_world
    return photos, truth


def _render(case: ImageCase, folder: Path, seed: int) -> Scene:
    if not (folder / "sparse").is_dir():
        settings = SynthSettings(
            kind=case.kind, periods=case.periods, width=480, height=360, views=case.views,
            points=2000, blocks=2, seed=seed, supersample=2,
        )  # fmt: skip
        generate(folder, settings)
    return read_scene(folder)


def _noisy(rng: np.random.Generator, centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """GPS with 3 m of noise and one position in ten 30 to 300 m off. [N, 3]"""
    far = rng.normal(size=centres.shape)
    far *= rng.uniform(30, 300, (len(far), 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    gross = rng.random(len(centres)) < 0.1
    return centres + rng.normal(0, 3.0, centres.shape) + np.where(gross[:, None], far, 0.0)


def _write(
    case: ImageCase, source: Path, target: Path, period: int, place: NDArray[np.float64] | None,
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


if __name__ == "__main__":
    sys.exit("run benchmarks/registration.py images")
