"""Scenes of a bench: all are read and checked before anything is trained."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from chronoscene.errors import ConfigError
from chronoscene.formats import DetectedFormat
from chronoscene.harness.files.predictions import safe_part
from chronoscene.harness.files.provenance import scene_hash, scene_stamp
from chronoscene.harness.files.source import read_bench_scene
from chronoscene.harness.plan.memory import PhotoNeeds, photo_needs
from chronoscene.harness.plan.parts import check_points, check_scene
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.io.log import Log
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash


@dataclass(frozen=True, slots=True, eq=False)
class BenchScene:
    """A scene with all that its runs need to know of it."""

    content: Scene
    source: DetectedFormat
    """Folder and format by which it is read; a format may take the scene from another folder."""
    hash: str
    stamp: str
    """Stamp of its files, taken before the hash."""
    split_hash: str
    needs: PhotoNeeds


def read_scenes(settings: BenchSettings, log: Log) -> Iterator[BenchScene]:
    """Read all scenes of a bench, then yield each with its fingerprints.

    Raises:
        SceneError: If one cannot be read or trained on.
        ConfigError: If two have the same name, or as `check_not_among_runs`.
    """
    scenes: dict[str, tuple[Scene, DetectedFormat]] = {}
    for found in settings.scenes:
        log(f"read {found.path}")
        scene = read_bench_scene(
            found,
            validation=settings.run.validation,
            validation_seed=settings.run.validation_seed,
            shrink=settings.run.shrink,
        )
        if scene.name in scenes:
            other = scenes[scene.name][0].root
            if other.samefile(scene.root):
                todo = "name it once"
                raise ConfigError(other, expected="each scene once", found="it twice", todo=todo)
            raise ConfigError(
                scene.root,
                expected="a scene with a unique name",
                found=f"{scene.name!r}, the name of {other} too",
                todo="rename a folder, or run the scenes with different --out",
            )
        check_not_among_runs(scene, settings.run.runs)
        check_scene(scene)
        check_points(scene)
        scenes[scene.name] = scene, found
    for scene, found in scenes.values():
        log(f"{scene.name}: fingerprint of {len(scene.frames)} images, ground truth of test views")
        needs = photo_needs(scene, settings.run)
        stamp = scene_stamp(scene)
        hashes = scene_hash(scene), stamp, split_hash(scene)
        yield BenchScene(scene, found, *hashes, needs)


def check_not_among_runs(scene: Scene, runs: Path) -> None:
    """Refuse a folder of runs that has a scene where the runs of this scene go.

    Raises:
        ConfigError: If it has.
    """
    if (runs / safe_part(scene.name)).resolve() == scene.root.resolve():
        raise ConfigError(
            f"--out {runs}",
            expected="a folder without the scene, whose runs get a folder of its name",
            found=f"the one that {scene.root} is in",
            todo="choose another place: nothing is written into a dataset",
        )
