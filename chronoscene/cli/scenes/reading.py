"""Scenes as commands read and describe them."""

from __future__ import annotations

from pathlib import Path

from chronoscene.cli.output import say
from chronoscene.formats import detect
from chronoscene.images.store import ImageSource
from chronoscene.io.wording import counted
from chronoscene.scene import Scene

LINKS: dict[str | None, ImageSource] = {None: "copy", "hard": "link", "sym": "symlink"}


def read_and_note(source: Path, dataset_format: str | None, period_by: str | None) -> Scene:
    """Read a scene, and report a model in an unusual place."""
    detected = detect(source, format=dataset_format, period_by=period_by)
    scene = detected.read()
    for note in detected.notes:
        show_note(note)
    return scene


def show_note(note: str) -> None:
    """Print one line on standard error."""
    say(f"note: {note}", fg="yellow")


def describe(scene: Scene) -> str:
    """Count the parts of a scene on one line."""
    cameras = len({frame.camera.camera_id for frame in scene.frames})
    counts = (
        (len(scene.frames), "image"),
        (cameras, "camera"),
        (len(scene.points), "point"),
        (scene.num_periods, "period"),
    )
    return ", ".join(counted(number, noun) for number, noun in counts)


def describe_period(scene: Scene, period: int) -> str:
    """Label and counts of a period on one line."""
    train = len(scene.select(split="train", period=period))
    test = len(scene.select(split="test", period=period))
    return f"period {scene.periods[period].title}: {train} train, {test} test"
