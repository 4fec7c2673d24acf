"""Scenes as commands read and describe them."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.formats import model_notes, read_scene
from chronoscene.images.store import ImageSource
from chronoscene.scene import Scene

LINKS: dict[str | None, ImageSource] = {None: "copy", "hard": "link", "sym": "symlink"}


def read_and_note(source: Path, dataset_format: str | None, period_by: str | None) -> Scene:
    """Read a scene; a model in an unusual place is said."""
    scene = read_scene(source, format=dataset_format, period_by=period_by)
    for note in model_notes(source, scene.format):
        say_note(note)
    return scene


def say_note(note: str) -> None:
    """One line on standard error."""
    click.secho(f"note: {note}", fg="yellow", err=True)


def describe(scene: Scene) -> str:
    """Counts of a scene on one line."""
    cameras = len({frame.camera.camera_id for frame in scene.frames})
    counts = (
        (len(scene.frames), "image"),
        (cameras, "camera"),
        (len(scene.points), "point"),
        (scene.num_periods, "period"),
    )
    return ", ".join(f"{n} {what}{'s' * (n != 1)}" for n, what in counts)


def describe_period(scene: Scene, period: int) -> str:
    """Label and counts of a period on one line."""
    train = len(scene.select(split="train", period=period))
    test = len(scene.select(split="test", period=period))
    label = scene.periods[period].label
    name = f"period {period}" + (f" ({label})" if label != str(period) else "")
    return f"{name}: {train} train, {test} test"
