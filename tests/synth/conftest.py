"""One tiny scene, made once, with the objects that it was made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from chronoscene.formats import chronoscene as scene_format
from chronoscene.scene import Scene
from chronoscene.synth import SynthSettings, generate, preset


@dataclass(frozen=True)
class Made:
    """A generated folder, its settings, and what is read back from it."""

    folder: Path
    settings: SynthSettings
    scene: Scene


@pytest.fixture(scope="session")
def made(made_once: Callable[..., Path]) -> Made:
    settings = preset("tiny", off_centre=True)
    folder = made_once("synth", lambda folder: generate(folder / "tiny", settings)) / "tiny"
    return Made(folder, settings, scene_format.read(folder))


@pytest.fixture(scope="session")
def world(made: Made):  # type: ignore[no-untyped-def]
    from chronoscene.synth.city.plan import make_world

    return make_world(made.settings)


@pytest.fixture(scope="session")
def renderers(made: Made, world):  # type: ignore[no-untyped-def]
    from chronoscene.synth.generation import make_renderers

    return make_renderers(made.settings, world)
