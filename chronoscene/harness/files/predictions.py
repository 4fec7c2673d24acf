"""Folders of 8-bit PNG images with a manifest: predictions, and the frozen ground truth.

A view's file is ``<view name>.png`` below the folder. The manifest lists every file with its
SHA-256; a file that does not agree is refused, and no path in a manifest leads out of its folder.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, BaseModel, ConfigDict, model_validator

from chronoscene.arrays import Mask, Pixels
from chronoscene.errors import CheckpointError
from chronoscene.harness.files.records import RunRecord, damaged, read_document
from chronoscene.io.staging import replacing, write_text_atomic

MANIFEST = "manifest.json"

_PNG = b"\x89PNG\r\n\x1a\n"
_UNSAFE = re.compile(r'[%<>:"|?*\\\x00-\x1f\x7f]')


def _inside(path: str) -> str:
    pure = PurePosixPath(path)
    if not pure.parts or pure.is_absolute() or ".." in pure.parts or "\\" in path or "\0" in path:
        raise CheckpointError(
            repr(path),
            expected="a path below its folder",
            found="a path that leads outside",
            todo="do not use these files",
        )
    return path


Place = Annotated[str, AfterValidator(_inside)]
"""Path of a file below the folder of its manifest."""


class ImageEntry(BaseModel):
    """One image in the folder."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    view: str
    """Full name of the frame."""
    camera_period: int
    """Period in which the photo was taken."""
    rendered_period: int
    """Period that the image shows."""
    file: Place
    sha256: str
    width: int
    height: int
    mask_file: Place | None = None
    """The mask, 0 where the photo does not count; None if all counts."""
    mask_sha256: str | None = None
    changed_file: Place | None = None
    """The mask of changes between periods, not 0 where the view differs
    from others; None if unknown."""
    changed_sha256: str | None = None


class Manifest(BaseModel):
    """List of the images in a folder, and the scene that they belong to."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format_version: Literal[1]
    kind: Literal["predictions", "ground truth"]
    scene: str
    scene_hash: str
    details: Mapping[str, Any]
    """Evaluation size and the like."""
    images: tuple[ImageEntry, ...]

    @property
    def own_images(self) -> tuple[ImageEntry, ...]:
        """Images that show the period of their photo."""
        return tuple(i for i in self.images if i.rendered_period == i.camera_period)

    @model_validator(mode="after")
    def _of_distinct_views(self) -> Self:
        views = {(e.view, e.rendered_period) for e in self.images}
        if len(views) != len(self.images):
            raise ValueError("a view twice")
        return self


def safe_name(name: str) -> str:
    """Make a name a path that every file system accepts: special characters become ``%XX``."""
    return _UNSAFE.sub(lambda match: f"%{ord(match.group()):02X}", name)


def safe_part(name: str) -> str:
    """Make a name one part of a path, as `safe_name` does: no folder, and none above."""
    return safe_name(name).replace("/", "%2F") if name.strip(".") else name.replace(".", "%2E")


def image_file(view: str) -> str:
    """Return the path of a view's image below its folder.

    Raises:
        CheckpointError: If the name would lead out of the folder.
    """
    return f"{_inside(safe_name(view))}.png"


def to_bytes(rgb: ArrayLike) -> Pixels:
    """Quantise 0..1 to 0..255 by rounding; values outside are clipped. [H, W, 3]"""
    image = np.asarray(rgb)
    if image.dtype == np.uint8:
        return image
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def encode_png(image: Pixels) -> bytes:
    """Encode an RGB image [H, W, 3], or a grey one [H, W], as PNG."""
    import cv2

    done, data = cv2.imencode(
        ".png", np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image)
    )
    assert done
    return data.tobytes()


def to_grey(mask: Mask) -> Pixels:
    """Make an image of a mask: 255 where it is true. [H, W]"""
    return 255 * mask.astype(np.uint8)


def write_png(folder: Path, file: str, pixels: Pixels) -> str:
    """Write one PNG file below a folder; returns its SHA-256."""
    target, data = folder / file, encode_png(pixels)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        partial.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


class ImageWriter:
    """Writes images one by one; `close` makes the folder complete."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._entries: list[ImageEntry] = []
        folder.mkdir(parents=True, exist_ok=True)

    def add(
        self,
        view: str,
        image: ArrayLike,
        *,
        camera_period: int,
        rendered_period: int,
        mask: Mask | None = None,
    ) -> None:
        """Write one image: uint8, or floats 0..1 [H, W, 3], and where it counts [H, W]."""
        pixels, file = to_bytes(image), image_file(view)
        masked = {}
        if mask is not None:
            mask_file = image_file(f"{view}.mask")
            masked = {"mask_file": mask_file}
            masked["mask_sha256"] = write_png(self.folder, mask_file, to_grey(mask))
        self._entries.append(
            ImageEntry(
                view=view,
                camera_period=camera_period,
                rendered_period=rendered_period,
                file=file,
                sha256=write_png(self.folder, file, pixels),
                width=pixels.shape[1],
                height=pixels.shape[0],
                **masked,
            )
        )

    def close(
        self,
        *,
        kind: Literal["predictions", "ground truth"],
        scene: str,
        scene_hash: str,
        details: Mapping[str, Any],
    ) -> None:
        """Write the manifest, last of all."""
        manifest = Manifest(
            format_version=1,
            kind=kind,
            scene=scene,
            scene_hash=scene_hash,
            details=dict(details),
            images=tuple(sorted(self._entries, key=lambda e: e.view)),
        )
        write_manifest(self.folder, manifest)

    def close_run(self, run: RunRecord) -> None:
        """Write the manifest of the predictions of a run."""
        self.close(
            kind="predictions",
            scene=run.scene,
            scene_hash=run.scene_hash,
            details={"method": run.method, "strategy": run.strategy, "seed": run.seed},
        )


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a folder, in one go."""
    text = manifest.model_dump_json(indent=1, exclude_none=True)
    write_text_atomic(folder / MANIFEST, f"{text}\n")


def read_manifest(folder: Path) -> Manifest:
    """Read and check a manifest.

    Raises:
        CheckpointError: If it is missing, damaged, or names a path outside the folder.
    """
    return read_document(folder / MANIFEST, Manifest, expected="a manifest of images")


def load_image(folder: Path, entry: ImageEntry) -> Pixels:
    """Read one image. [H, W, 3]

    Raises:
        CheckpointError: If the file is missing or not the one that the manifest lists.
    """
    image = _load_png(folder, entry.file, entry.sha256, (entry.height, entry.width), color=True)
    return np.ascontiguousarray(image[..., ::-1])


def load_mask(folder: Path, entry: ImageEntry) -> Mask | None:
    """Read the mask of the pixels that count; None if all do. Errors as for `load_image`. [H, W]"""
    return _load_grey(folder, entry, entry.mask_file, entry.mask_sha256)


def load_changed(folder: Path, entry: ImageEntry) -> Mask | None:
    """Read the mask of changes between periods; None if unknown. Otherwise as `load_mask`."""
    return _load_grey(folder, entry, entry.changed_file, entry.changed_sha256)


def _load_grey(
    folder: Path, entry: ImageEntry, file: str | None, sha256: str | None
) -> Mask | None:
    if file is None or sha256 is None:
        return None
    size = entry.height, entry.width
    return np.asarray(_load_png(folder, file, sha256, size, color=False) != 0)


def _load_png(
    folder: Path, file: str, sha256: str, size: tuple[int, int], *, color: bool
) -> Pixels:
    """Decode one listed file; channels are in OpenCV's order."""
    import cv2

    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
        raise CheckpointError(
            path, expected="an image", found="no such file", todo="run bench again"
        )
    data = path.read_bytes() if path.stat().st_size <= _largest_png(size) else b""
    if hashlib.sha256(data).hexdigest() != sha256:
        raise CheckpointError(
            path,
            expected=f"the file with SHA-256 {sha256[:12]}... that {MANIFEST} lists",
            found="another file",
            todo="the image was changed after rendering: delete the run and run bench again",
        )
    if not data.startswith(_PNG):  # nothing else is decoded
        raise damaged(path, "no image")
    if struct.unpack(">II", data[16:24].ljust(8, b"\0")) != (size[1], size[0]):
        raise damaged(path, "an image of another size")
    mode = cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE
    image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise damaged(path, "no image")
    return np.asarray(image, np.uint8)


def _largest_png(size: tuple[int, int]) -> int:
    """Return bytes that no PNG file of this height and width exceeds, even uncompressed."""
    return 8 * size[0] * size[1] + 1_000_000
