"""Scenes with a role, fixed by hashes: presets are tuned on some, methods are ranked on others.

    python -m leaderboard.scenes FOLDER [NAME...] [--role ranking] [--photos FOLDER]

makes the generated ones in FOLDER, checks those that are there, and names those that differ from
``scenes.toml``. Of photos that may not be passed on, only the registered model is here: such a
scene is made on request, by its name, of the photos in the folder of ``--photos``.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.formats import read_scene
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.scene.splits import split_hash
from chronoscene.synth import SynthSettings, generate
from leaderboard.photo_scenes import MODELS, make_scene

ROLES = {
    "ranking": "a ranking scene: no trial of any preset has used it",
    "tuning": "a tuning scene: presets are chosen on views of it",
    "seen": "a scene whose test views were looked at when presets were chosen: no ranking",
}
"""Roles, and what they mean for a result."""


@dataclass(frozen=True, slots=True)
class FixedScene:
    """A scene of the table."""

    role: str
    """One of `ROLES`."""
    about: str
    """One line."""
    scene_hash: str
    split_hash: str
    views_hash: str
    """By `views_hash`."""
    synth: dict[str, Any] | None = None
    """Settings that generate it; None if it cannot be generated."""
    made: str = ""
    """Photos and commands for one that is not."""


@cache
def fixed_scenes() -> dict[str, FixedScene]:
    """Read the table: scenes by name."""
    text = Path(__file__).with_name("scenes.toml").read_text(encoding="utf-8")
    return {name: FixedScene(**fields) for name, fields in tomllib.loads(text).items()}


def views_hash(views: Iterable[tuple[str, int]]) -> str:
    """Hash the test views of a scene: SHA-256 over the sorted lines ``name TAB period``."""
    lines = sorted(f"{name}\t{period}\n" for name, period in views)
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def role_of(digest: str) -> str:
    """Return the role of the scene with a `scene_hash`, or nothing."""
    return {scene.scene_hash: scene.role for scene in fixed_scenes().values()}.get(digest, "")


def meaning_of(role: str) -> str:
    """Describe a role for a reader."""
    return ROLES.get(role, "a scene without a role in the table of scenes")


def make(folder: Path, fixed: FixedScene, photos: Path | None = None) -> None:
    """Make a scene, unless its folder is there, and check its hashes.

    Args:
        folder: The scene, of which the name is that of its model.
        fixed: What it must be.
        photos: Folder of the photos, for a scene that is not generated.

    Raises:
        SceneError: If photos are missing, or the scene is other than in the table.
    """
    if not folder.exists():
        if fixed.synth is not None:
            generate(folder, SynthSettings(**fixed.synth))
        elif photos is not None and (model := MODELS / f"{folder.name}.npz").is_file():
            make_scene(model, photos, folder)
        else:
            raise SceneError(folder, expected="this scene", found="nothing there", todo=fixed.made)
    scene = read_scene(folder)
    found = (scene_hash(scene), split_hash(scene))
    if found != (fixed.scene_hash, fixed.split_hash):
        raise SceneError(
            folder,
            expected=f"scene {fixed.scene_hash[:10]}, split {fixed.split_hash[:10]}",
            found=f"scene {found[0][:10]}, split {found[1][:10]}",
            todo="make it again in another folder; if it differs again, this platform or a library "
            "draws other pixels: do not compare its results with those of the table",
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Make and check scenes; return 1 if one could not be made or differs."""
    known = fixed_scenes()
    parser = argparse.ArgumentParser(prog="python -m leaderboard.scenes", description="Make scenes")
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    parser.add_argument("--role", choices=ROLES)
    parser.add_argument("--photos", type=Path, help="of a scene that cannot be generated")
    given = parser.parse_args(arguments)
    if given.names and given.role:
        parser.error("--role chooses among all scenes: leave out either it or the names")
    generated = [n for n, s in known.items() if s.synth and given.role in (None, s.role)]
    failed = 0
    for name in given.names or generated:
        try:
            make(given.folder / name, known[check_choice("NAME", name, known)], given.photos)
            print(f"{given.folder / name}: {ROLES[known[name].role]}; hashes agree", flush=True)
        except ChronoSceneError as error:
            failed = 1
            print(f"error: {error}", file=sys.stderr, flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
