"""Undistortion of scenes: images are resampled to PINHOLE cameras, and observations follow.

pycolmap chooses the cameras and evaluates the models; pixels are interpolated here, bicubically and
only once, for both the undistortion and the crop that centres the principal point.
Images whose camera does not change are copied byte for byte.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.images import undistortion
from chronoscene.images.decoding import load_photo
from chronoscene.images.masks import find_masks, mask_place
from chronoscene.images.store import ImageSource, Progress, place_image
from chronoscene.io.staging import staged_folder
from chronoscene.kernels.runtime import available_threads
from chronoscene.scene import Scene

JPEG_QUALITY = 95

WRITABLE = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")

MAX_EXIF_BYTES = 65533
"""Limit of a JPEG file. Some cameras write two blocks, which Pillow reads as a longer one."""

_KEPT_TAGS = (0x010F, 0x0110, 0x0112, 0x0132)
"""Make, model, orientation and time: the other tags of a TIFF describe its pixels."""

_KEPT_BLOCKS = (0x8769, 0x8825)  # EXIF proper, and GPS


@dataclass(frozen=True, slots=True, eq=False)
class Undistortion:
    """The result of an undistortion."""

    scene: Scene
    """The new scene."""
    changes: tuple[undistortion.CameraChange, ...]
    observations_lost: int
    """Observations outside the new images."""
    points_lost: int
    """Points whose last observation was lost."""


def undistort(
    scene: Scene,
    out: Path,
    *,
    center: bool = False,
    threads: int | None = None,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> Undistortion:
    """Write a scene in the ChronoScene format whose cameras are all PINHOLE.

    Poses, periods and split stay. Where a file has another size than its camera, the camera is
    scaled to the file first. Masks are resampled with their images; transparent pixels of images
    that change become part of their masks.

    Args:
        scene: Any scene.
        out: Folder that does not exist yet, or is empty.
        center: Crop the images so that the principal point is in their centre.
        threads: Images processed in parallel; None for one per processor.
        image_source: Copy or link the images that stay as they are.
        progress: Called after each image.

    Raises:
        SceneError: If ``out`` is in use, an image is damaged, or a camera cannot be undistorted.
    """
    for frame in scene.frames:
        our_format.check_writable_name(out, frame)
        path = scene.image_path(frame)
        if path.suffix.lower() not in WRITABLE:
            raise SceneError(
                path,
                expected=f"an image file that can be written: {', '.join(WRITABLE)}",
                found=repr(path.suffix),
                todo="save it as PNG, and rename it in the model",
            )
    changes = undistortion.plan_cameras(scene, center=center)
    new, observations_lost, points_lost = undistortion.move_observations(scene, changes)
    with staged_folder(out) as staged:
        our_format.write_texts(new, staged)
        _write_images(scene, staged, changes, image_source, threads, progress)
    distinct = tuple(dict.fromkeys(changes))
    masks = find_masks(out, [frame.name for frame in scene.frames])
    done = replace(new, root=out, images_root=out / "images", format=our_format.NAME, masks=masks)
    return Undistortion(done, distinct, observations_lost, points_lost)


def _write_images(
    scene: Scene,
    root: Path,
    changes: list[undistortion.CameraChange],
    image_source: ImageSource,
    threads: int | None,
    progress: Progress | None,
) -> None:
    """Write all images, camera by camera, so that each sampling map is computed once."""
    order = sorted(range(len(changes)), key=lambda i: changes[i].target.camera_id)
    pool = ThreadPoolExecutor(threads or available_threads())

    def write(i: int) -> None:
        name = scene.frames[i].name
        source, target = scene.image_path(scene.frames[i]), root / "images" / name
        mask, new_mask = scene.masks.get(name), root / mask_place(name)
        if not changes[i].is_copy:
            _resample((source, mask), (target, new_mask), changes[i])
            return
        place_image(source, target, image_source)
        if mask is not None:
            place_image(mask, new_mask, image_source)

    try:
        for done, _ in enumerate(pool.map(write, order), start=1):
            if progress is not None:
                progress(done, len(order))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        undistortion.sampling_map.cache_clear()


def _resample(
    sources: tuple[Path, Path | None], targets: tuple[Path, Path], change: undistortion.CameraChange
) -> None:
    """Resample an image, and its mask if it has one or something of it is ignored."""
    (source, old_mask), (target, new_mask) = sources, targets
    image, mask = load_photo(*sources)
    places = undistortion.sampling_map(change)
    pixels = undistortion.warp(image, *places)
    if mask is None and old_mask is not None:
        mask = np.ones(image.shape[:2], bool)  # one that ignores nothing is still a mask
    if mask is not None:
        new_mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(undistortion.warp_mask(mask, *places)).convert("L").save(new_mask)
    target.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {}
    suffix = target.suffix.lower()
    if suffix in (".jpg", ".jpeg"):
        options = {"quality": JPEG_QUALITY, "subsampling": 0}
    elif suffix == ".webp":
        options = {"lossless": True}
    if suffix != ".bmp":
        options |= _metadata(source)
    Image.fromarray(pixels).save(target, **options)


def _metadata(path: Path) -> dict[str, Any]:
    """EXIF, which has the capture date, and the colour profile if it is an RGB profile."""
    with Image.open(path) as image:
        exif = _tiff_metadata(image) if image.format == "TIFF" else image.info.get("exif")
        profile = image.info.get("icc_profile")
    kept: dict[str, Any] = {}
    if exif and not (isinstance(exif, bytes) and len(exif) > MAX_EXIF_BYTES):
        kept["exif"] = exif
    if isinstance(profile, bytes) and profile[16:20] == b"RGB ":
        kept["icc_profile"] = profile
    return kept


def _tiff_metadata(image: Image.Image) -> Image.Exif:
    """EXIF tags of a TIFF that describe the capture, without those that describe its pixels."""
    found, kept = image.getexif(), Image.Exif()
    kept.update({tag: found[tag] for tag in _KEPT_TAGS if tag in found and _fits(tag, found[tag])})
    for block in _KEPT_BLOCKS:
        tags = {tag: v for tag, v in found.get_ifd(block).items() if _fits(tag, v, block)}
        if tags:
            kept.get_ifd(block).update(tags)
            kept[block] = 0  # Pillow replaces this by the offset of the block
    return kept


def _fits(tag: int, value: Any, block: int | None = None) -> bool:
    """Return True if Pillow can write a tag that it has read: not if the type is wrong."""
    probe = Image.Exif()
    if block is None:
        probe[tag] = value
    else:
        probe.get_ifd(block)[tag] = value
        probe[block] = 0
    try:
        return bool(probe.tobytes())
    except Exception:  # struct.error, TypeError, OverflowError, AttributeError were seen
        return False
