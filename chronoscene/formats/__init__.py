"""Dataset formats, one module each; `FORMATS` lists ours, an entry point each of the others.

A module has ``NAME``, ``MARKS``, ``matches(path)`` and ``read(path)``, and where it makes sense

- ``write(scene, out, image_source=..., progress=...)`` and ``losses(scene)``, which lists what of
  the scene the format cannot hold;
- ``PERIOD_BY``, the values of ``read(path, period_by=...)``, where periods can be chosen;
- ``assign(images, names, ...)``, where the periods follow from the image names of a COLMAP model,
  which the validator then checks as it is. For such a format, `detect` looks for the model, and the
  functions are ``matches(path, model)`` and ``read(path, model=..., ...)``;
- ``remarks(path)``, which lists what of a folder does not become part of the scene, and
  ``others(path)``, names of files and folders in it that are not part of the format.

All raise a `SceneError` for a damaged scene, ``write`` also for a folder that is in use and for
missing images; a `ConfigError` for a ``period_by`` that is not in ``PERIOD_BY``. What ``write``
writes appears complete or not at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from chronoscene.checks import check_choice, line_of, load_entry
from chronoscene.colmap.raw_model import FoundModel, find_model, find_stray_model
from chronoscene.errors import ChronoSceneError, ConfigError, SceneError
from chronoscene.io.wording import joined
from chronoscene.scene import Scene
from chronoscene.scene.splits import SPLIT

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

REQUIRED = ("NAME", "MARKS", "matches", "read")
"""Names that the module of a format must define."""

USUAL = ("sparse/0", "sparse")  # Where everybody looks for a COLMAP model

COLMAP = "colmap-folders"
"""Format of a COLMAP project whose periods ``--period-by`` defines."""

FAR_UP = 4
"""Levels above a wrong folder at which the right one may be: ``dense/0/sparse/0`` has four."""


@cache
def _plugins() -> tuple[EntryPoint, ...]:
    """Formats of other packages; our own names are taken."""
    return tuple(e for e in entry_points(group=ENTRY_POINT_GROUP) if e.name not in FORMATS)


def format_names() -> tuple[str, ...]:
    """Names of all formats, sorted."""
    return tuple(sorted({*FORMATS, *(entry.name for entry in _plugins())}))


def load_format(name: str) -> Any:
    """Load the module of a format.

    Raises:
        ConfigError: If the format is unknown; lists the known ones. Or if it is of another package,
            and cannot be imported or lacks something.
    """
    check_choice("dataset format", name, format_names())
    if name in FORMATS:
        return import_module(FORMATS[name])
    module = load_entry(_plugins(), name, "dataset format")
    lacking = [needed for needed in REQUIRED if not hasattr(module, needed)]
    if lacking or name != module.NAME:
        raise ConfigError(
            f"dataset format {name}",
            expected=f"a module with {', '.join(REQUIRED)}, whose NAME is that of its entry point",
            found=f"no {lacking[0]}" if lacking else f"NAME = {module.NAME!r}",
            todo="correct the package as docs/guides/adding-a-format.md describes, or uninstall it",
        )
    return module


@dataclass(frozen=True, slots=True)
class DetectedFormat:
    """A scene folder with its format and the COLMAP model in it, ready to be read."""

    path: Path
    name: str
    model: FoundModel | None = None
    """None if there is none, or the format needs none."""
    period_by: str | None = None
    others: tuple[str, ...] = ()
    """Further formats whose marks the folder has: a user must name one."""

    @property
    def module(self) -> Any:
        """Return the module of the format."""
        return load_format(self.name)

    @property
    def options(self) -> dict[str, str]:
        """Arguments on periods of ``read`` and ``assign``.

        Raises:
            ConfigError: If the format leaves no choice of periods.
        """
        if self.period_by is None:
            return {}
        if not hasattr(self.module, "PERIOD_BY"):
            raise ConfigError(
                "--period-by",
                expected=f"no such option for {self.name}, which defines its own periods",
                found=repr(self.period_by),
                todo="leave it out, or name another --dataset-format",
            )
        return {"period_by": self.period_by}

    @property
    def is_by_names(self) -> bool:
        """True if the periods follow from the image names of a COLMAP model."""
        return hasattr(self.module, "assign")

    @property
    def notes(self) -> list[str]:
        """Place of the model that is read, if it is an unusual one."""
        if self.model is None or not self.is_by_names or self.model[0] in USUAL:
            return []
        folder, images = self.model
        return [f"the model is read from {folder or 'the folder itself'}, the images from {images}"]

    def check_single(self) -> None:
        """Raise a `SceneError` if the folder has marks of several formats."""
        if self.others:
            raise SceneError(
                self.path,
                expected="a folder of one format",
                found=f"marks of {joined([self.name, *self.others])}",
                todo="name one with --dataset-format, in chronoscene convert or in this command",
            )

    def read(self) -> Scene:
        """Read the scene; see `read_scene`."""
        self.check_single()
        model = {"model": self.model} if self.is_by_names else {}
        with _of_package(self.name, self.path):
            scene: Scene = self.module.read(self.path, **model, **self.options)
        return scene


def detect(
    path: Path, *, format: str | None = None, period_by: str | None = None
) -> DetectedFormat:
    """Find the format of a scene folder and its COLMAP model, once.

    Args:
        path: Folder of one scene.
        format: Name of its format; None to find it by its marks.
        period_by: Rule by which images are grouped: then a COLMAP project needs no folders of
            periods.

    Raises:
        SceneError: If no format matches, or several do; lists what was looked for.
        ConfigError: If the format is unknown.
    """
    if format is not None:
        model = find_model(path) if hasattr(load_format(format), "assign") else None
        return DetectedFormat(path, format, model, period_by)
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise SceneError(path, expected="a scene folder", found=found, todo="check the path")
    detected, model = _match(path, period_by)
    if detected is not None:
        detected.check_single()
        return detected
    if _has_images(path, model):
        raise _no_periods(path, model)
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
        todo=_advice(path, model),
    )


def match_format(path: Path, *, period_by: str | None = None) -> DetectedFormat | None:
    """Return the format whose marks a folder has, the first of several; None if there is none."""
    return _match(path, period_by)[0]


def _match(path: Path, period_by: str | None) -> tuple[DetectedFormat | None, FoundModel | None]:
    """Match the marks of all formats; return the COLMAP model of the folder, too."""
    # Beside split.txt, a model is of the ChronoScene format, which has it in one place only.
    model = None if (path / SPLIT).exists() else find_model(path)
    names = [name for name in format_names() if _has_marks(name, path, model)]
    if not names and period_by is not None and _has_images(path, model):
        names = [COLMAP]
    if not names:
        return None, model
    return DetectedFormat(path, names[0], model, period_by, tuple(names[1:])), model


def _has_marks(name: str, path: Path, model: FoundModel | None) -> bool:
    module = load_format(name)
    arguments = (path, model) if hasattr(module, "assign") else (path,)
    with _of_package(name, path):
        return bool(module.matches(*arguments))


@contextmanager
def _of_package(name: str, path: Path) -> Iterator[None]:
    """Name the format of another package whose code fails on a folder."""
    try:
        yield
    except (ChronoSceneError, OSError):
        raise
    except Exception as error:
        if name in FORMATS:
            raise
        raise SceneError(
            path,
            expected=f"a folder that the code of the format {name} can deal with",
            found=f"{type(error).__name__}: {error}{line_of(error)}",
            todo="correct the package of the format, or report this to its author",
        ) from error


def _has_images(path: Path, model: FoundModel | None) -> bool:
    """Return True if a folder has the images of its COLMAP model."""
    return model is not None and (path / model[1]).is_dir()


def _advice(path: Path, model: FoundModel | None) -> str:
    """Advice on a folder that no format matches."""
    if model is not None:
        place = f"in {model[0]}" if model[0] else "here"
        return f"copy the images of the COLMAP model {place} to {model[1]}/ in this folder"
    advice = "give the folder of one scene; DATASET.md describes its files"
    if (path / "images").is_dir():
        if model_folder := find_stray_model(path):
            return f"copy the COLMAP model in {model_folder} to sparse/0"
        if not (path / "sparse").exists():
            return f"register these photos (chronoscene register), or {advice}"
    return advice


def project_above(path: Path) -> Path | None:
    """The COLMAP project that a folder is a part of."""
    above = path.resolve().parents[:FAR_UP]
    return next((folder for folder in above if _has_images(folder, find_model(folder))), None)


def _no_periods(path: Path, model: FoundModel | None) -> SceneError:
    from chronoscene.formats.shared.grouping import NAME_PERIODS  # it loads pycolmap

    folder, images = model or ("", "")
    return SceneError(
        path,
        expected=f"periods of the images: folders in {images}/, or sparse/split.txt",
        found=f"neither beside the COLMAP model in {folder or 'this folder'}",
        todo=f"{NAME_PERIODS}, in chronoscene convert or in this command; or write "
        "sparse/split.txt as DATASET.md says",
    )


def find_scenes(
    path: Path, *, format: str | None = None, period_by: str | None = None
) -> list[DetectedFormat]:
    """Return the scene of a folder, or those directly inside it, sorted by name.

    Raises:
        SceneError: If there is no scene; lists what was looked for.
    """
    found = _scenes_of(path, format, period_by)
    return found or [detect(path, format=format, period_by=period_by)]


def nearby_scenes(*, format: str | None = None, period_by: str | None = None) -> Path:
    """Return the current folder if it is a scene or has scenes in it, else ``data/`` in it.

    Raises:
        SceneError: If neither has a scene.
    """
    here = Path.cwd()
    for folder in (here, here / "data"):
        if _scenes_of(folder, format, period_by):
            return folder
    raise SceneError(
        here,
        expected="a scene, or scenes in this folder or in data/",
        found="none",
        todo="give the folder of a scene; chronoscene synth makes one, download fetches published "
        "ones",
    )


def _scenes_of(path: Path, format: str | None, period_by: str | None) -> list[DetectedFormat]:
    def scene_in(folder: Path) -> DetectedFormat | None:
        found = match_format(folder, period_by=period_by) if folder.is_dir() else None
        if found is None or format is None:
            return found
        known = format in (found.name, *found.others)
        return detect(folder, format=format, period_by=period_by) if known else None

    if not path.is_dir():
        return []
    if scene := scene_in(path):
        return [scene]
    return [scene for child in sorted(path.iterdir()) if (scene := scene_in(child))]


def read_scene(
    path: str | Path, *, format: str | None = None, period_by: str | None = None
) -> Scene:
    """Read a scene folder. Writes nothing into it.

    Args:
        path: Folder of one scene.
        format: Name of its format; None to detect it.
        period_by: Rule by which images are grouped into periods, where the format leaves a choice.

    Raises:
        SceneError: If the folder is of no known format, or damaged.
        ConfigError: If the format or the grouping is unknown.
    """
    return detect(Path(path), format=format, period_by=period_by).read()


def formats_that_load() -> dict[str, Any]:
    """Modules of the formats by their sorted names, without those of packages that are broken."""
    modules = {}
    for name in format_names():
        with suppress(ConfigError):
            modules[name] = load_format(name)
    return modules


def writable_formats() -> tuple[str, ...]:
    """Names of the formats that can be written, sorted."""
    return tuple(name for name, module in formats_that_load().items() if hasattr(module, "write"))
