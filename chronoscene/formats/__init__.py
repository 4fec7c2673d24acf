"""Dataset formats, one module each; `FORMATS` lists them.

A module has ``NAME``, ``MARKS``, ``matches(path)`` and ``read(path)``, and where it makes sense

- ``write(scene, out, image_source=..., progress=...)`` and ``losses(scene)``, which lists what of
  the scene the format cannot hold;
- ``PERIOD_BY``, the values of ``read(path, period_by=...)``, where periods can be chosen;
- ``remarks(path)``, which lists what of a folder does not become part of the scene.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.colmap.raw_model import model_kind
from chronoscene.errors import ConfigError, SceneError
from chronoscene.scene import Scene

FORMATS = {
    "chronoscene": "chronoscene.formats.chronoscene",
    "cl-splats": "chronoscene.formats.cl_splats",
    "colmap-folders": "chronoscene.formats.colmap_folders",
    "matrixcity": "chronoscene.formats.matrixcity",
    "nerfstudio": "chronoscene.formats.nerfstudio",
    "neusc": "chronoscene.formats.neusc",
    "wat": "chronoscene.formats.wat",
}
"""Format name to the module that reads it."""


def format_names() -> tuple[str, ...]:
    """Names of all formats, sorted."""
    return tuple(sorted(FORMATS))


def load_format(name: str) -> Any:
    """Module of a format.

    Raises:
        ConfigError: If the format is unknown; lists the known ones.
    """
    check_choice("dataset format", name, FORMATS)
    return import_module(FORMATS[name])


def detect_format(path: Path) -> str:
    """Name of the one format whose marks a folder has.

    Raises:
        SceneError: If no format matches; lists what was looked for.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise SceneError(path, expected="a scene folder", found=found, todo="check the path")
    modules = {name: load_format(name) for name in format_names()}
    matching = [name for name, module in modules.items() if module.matches(path)]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise SceneError(
            path,
            expected="a folder of one format",
            found=f"marks of {' and '.join(matching)}",
            todo="choose one with --format (stats: --dataset-format)",
        )
    looked_for = "; ".join(f"{name}: {module.MARKS}" for name, module in modules.items())
    content = sorted(p.name + "/" * p.is_dir() for p in path.iterdir())
    raise SceneError(
        path,
        expected=f"a scene of a known format ({looked_for})",
        found=", ".join(content[:8]) + (", ..." if len(content) > 8 else "") or "an empty folder",
        todo=_advice(path),
    )


def _advice(path: Path) -> str:
    """What to do about a folder that no format matches."""
    from chronoscene.formats.shared.colmap_layout import find_model  # it loads pycolmap

    if model_kind(path):
        return "move this COLMAP model to sparse/0 in a folder with images/"
    if find_model(path) and (path / "images").is_dir():
        return (
            "assign images to periods: write sparse/split.txt, or convert the folder with "
            "--format colmap-folders --period-by table:FILE"
        )
    advice = "give the folder of one scene; DATASET.md describes its files"
    if (path / "images").is_dir() and not (path / "sparse").exists():
        return f"register these photos (chronoscene register), or {advice}"
    return advice


def find_scenes(path: Path, *, format: str | None = None) -> list[Path]:
    """The scene folder itself, or the scenes directly inside a folder, sorted by name.

    Raises:
        SceneError: If there is no scene; lists what was looked for.
    """
    modules = [load_format(name) for name in ([format] if format else format_names())]

    def is_scene(folder: Path) -> bool:
        return any(module.matches(folder) for module in modules)

    if path.is_dir() and not is_scene(path):
        inside = sorted(child for child in path.iterdir() if child.is_dir() and is_scene(child))
        if inside:
            return inside
    if format is None:
        detect_format(path)
    return [path]


def read_scene(
    path: str | Path, *, format: str | None = None, period_by: str | None = None
) -> Scene:
    """Read a scene folder. Writes nothing into it.

    Args:
        path: Folder of one scene.
        format: Name of its format; None to find out.
        period_by: How images are grouped into periods, where the format leaves a choice.

    Raises:
        SceneError: If the folder is of no known format, or damaged.
        ConfigError: If the format or the grouping is unknown.
    """
    path = Path(path)
    name = format if format is not None else detect_format(path)
    module = load_format(name)
    if period_by is not None and not hasattr(module, "PERIOD_BY"):
        raise ConfigError(
            "--period-by",
            expected=f"no such option for {name}, which defines its own periods",
            found=repr(period_by),
            todo="leave it out",
        )
    options = {} if period_by is None else {"period_by": period_by}
    scene: Scene = module.read(path, **options)
    return scene


def writable_formats() -> tuple[str, ...]:
    """Names of the formats that can be written, sorted."""
    return tuple(name for name in format_names() if hasattr(load_format(name), "write"))
