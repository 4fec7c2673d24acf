"""Dataset formats, one module each; `FORMATS` lists ours, an entry point each of the others.

A module has ``NAME``, ``MARKS``, ``matches(path)`` and ``read(path)``, and where it makes sense

- ``write(scene, out, image_source=..., progress=...)`` and ``losses(scene)``, which lists what of
  the scene the format cannot hold;
- ``PERIOD_BY``, the values of ``read(path, period_by=...)``, where periods can be chosen;
- ``assign(images, names, ...)``, which a format has whose periods follow from the image names of a
  COLMAP model: so the validator can look at that model as it is;
- ``remarks(path)``, which lists what of a folder does not become part of the scene.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.colmap.raw_model import find_model, find_stray_model
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
"""Format name to the module that reads it, for those that come with ChronoScene."""

ENTRY_POINT_GROUP = "chronoscene.formats"
"""Other packages name modules in it."""

USUAL = ("sparse/0", "sparse")  # Where everybody looks for a COLMAP model

COLMAP = "colmap-folders"
"""What a COLMAP project is read as where ``--period-by`` says what its periods are."""

FAR_UP = 4
"""How far above a wrong folder the right one may be: ``dense/0/sparse/0`` has four folders."""


@cache
def installed_formats() -> dict[str, str]:
    """`FORMATS` and those of other packages."""
    return {e.name: e.value for e in entry_points(group=ENTRY_POINT_GROUP)} | FORMATS


def format_names() -> tuple[str, ...]:
    """Names of all formats, sorted."""
    return tuple(sorted(installed_formats()))


def load_format(name: str) -> Any:
    """Module of a format.

    Raises:
        ConfigError: If the format is unknown; lists the known ones.
    """
    check_choice("dataset format", name, installed_formats())
    return import_module(installed_formats()[name])


def detect_format(path: Path, *, period_by: str | None = None) -> str:
    """Name of the one format whose marks a folder has.

    Args:
        path: Folder of one scene.
        period_by: How images are to be grouped: then a COLMAP project needs no folders of periods.

    Raises:
        SceneError: If no format matches; lists what was looked for.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise SceneError(path, expected="a scene folder", found=found, todo="check the path")
    matching = matching_formats(path, period_by)
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise SceneError(
            path,
            expected="a folder of one format",
            found=f"marks of {' and '.join(matching)}",
            todo="name one with --dataset-format, in chronoscene convert or in this command",
        )
    if _is_colmap(path):
        raise _no_periods(path)
    if project := project_above(path):
        raise SceneError(
            path,
            expected="the folder of a scene",
            found="a part of one",
            todo=f"give the folder of the whole project, {project}",
        )
    looked_for = "; ".join(f"{name}: {load_format(name).MARKS}" for name in format_names())
    content = sorted(p.name + "/" * p.is_dir() for p in path.iterdir())
    raise SceneError(
        path,
        expected=f"a scene of a known format ({looked_for})",
        found=", ".join(content[:8]) + (", ..." if len(content) > 8 else "") or "an empty folder",
        todo=_advice(path),
    )


def matching_formats(path: Path, period_by: str | None) -> list[str]:
    """Names of the formats whose marks a folder has; see `detect_format`."""
    matching = [name for name in format_names() if load_format(name).matches(path)]
    return matching or ([COLMAP] if period_by is not None and _is_colmap(path) else [])


def _is_colmap(path: Path) -> bool:
    """Whether a folder has a COLMAP model and the images that it is of."""
    found = find_model(path)
    return found is not None and (path / found[1]).is_dir()


def _advice(path: Path) -> str:
    """What to do about a folder that no format matches."""
    if model := find_model(path):
        place = f"in {model[0]}" if model[0] else "here"
        return f"copy the images of the COLMAP model {place} to {model[1]}/ in this folder"
    advice = "give the folder of one scene; DATASET.md describes its files"
    if (path / "images").is_dir():
        if model_folder := find_stray_model(path):
            return f"copy the COLMAP model in {model_folder} to sparse/0"
        if not (path / "sparse").exists():
            return f"register these photos (chronoscene register), or {advice}"
    return advice


def model_notes(path: Path, format: str) -> list[str]:
    """Where the COLMAP model is that is read, if not where everybody would look for it."""
    found = find_model(path) if hasattr(load_format(format), "assign") else None
    if found is None or found[0] in USUAL:
        return []
    return [f"the model is read from {found[0] or 'the folder itself'}, the images from {found[1]}"]


def project_above(path: Path) -> Path | None:
    """The COLMAP project that a folder is a part of."""
    above = path.resolve().parents[:FAR_UP]
    return next((folder for folder in above if _is_colmap(folder)), None)


def _no_periods(path: Path) -> SceneError:
    from chronoscene.formats.shared.grouping import NAME_PERIODS  # it loads pycolmap

    model, images = find_model(path) or ("", "")
    return SceneError(
        path,
        expected=f"periods of the images: folders in {images}/, or sparse/split.txt",
        found=f"neither beside the COLMAP model in {model or 'this folder'}",
        todo=f"{NAME_PERIODS}, in chronoscene convert or in this command; or write "
        "sparse/split.txt as DATASET.md says",
    )


def find_scenes(
    path: Path, *, format: str | None = None, period_by: str | None = None
) -> list[Path]:
    """The scene folder itself, or the scenes directly inside a folder, sorted by name.

    Raises:
        SceneError: If there is no scene; lists what was looked for.
    """

    def is_scene(folder: Path) -> bool:
        matching = matching_formats(folder, period_by)
        return bool(matching) if format is None else format in matching

    if path.is_dir() and not is_scene(path):
        inside = sorted(child for child in path.iterdir() if child.is_dir() and is_scene(child))
        if inside:
            return inside
    if format is None:
        detect_format(path, period_by=period_by)
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
    name = format if format is not None else detect_format(path, period_by=period_by)
    scene: Scene = load_format(name).read(path, **period_options(name, period_by))
    return scene


def period_options(name: str, period_by: str | None) -> dict[str, str]:
    """Arguments of ``read`` and ``assign`` of a format.

    Raises:
        ConfigError: If the format leaves no choice of periods.
    """
    if period_by is None:
        return {}
    if not hasattr(load_format(name), "PERIOD_BY"):
        raise ConfigError(
            "--period-by",
            expected=f"no such option for {name}, which defines its own periods",
            found=repr(period_by),
            todo="leave it out, or name another --dataset-format",
        )
    return {"period_by": period_by}


def writable_formats() -> tuple[str, ...]:
    """Names of the formats that can be written, sorted."""
    return tuple(name for name in format_names() if hasattr(load_format(name), "write"))
