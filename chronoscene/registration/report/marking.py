"""A page on which a person marks tie and control points in photos; it needs no server.

Photos are embedded at a reduced size, and marks are in pixels of the originals, as stored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.colmap.model import Model, PosedImage, read_model
from chronoscene.errors import SceneError
from chronoscene.images.decoding import load_photo
from chronoscene.images.store import resize_camera
from chronoscene.io.pages import data_uri, render_page
from chronoscene.io.processes import Report
from chronoscene.registration.photos.inputs import plain_names
from chronoscene.registration.photos.photo import Capture
from chronoscene.registration.ties.tie_points import TiePoints
from chronoscene.scene.cameras import CAMERA_MODELS, PINHOLE_MODELS, POLYNOMIAL_MODELS
from chronoscene.scene.geometry import camera_centre

FILE = "points.csv"  # Name of the file that the page saves

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of the parameters on the page: that of OpenCV."""

DEPTHS = (0.1, 5.0)
"""Range of an epipolar line, as a share of the nearest and the farthest usual depth of points."""


def marking_page(
    captures: Sequence[Capture],
    *,
    points: TiePoints | None = None,
    model: Path | None = None,
    max_size: int = 1600,
    title: str = "Points",
    report: Report | None = None,
) -> str:
    """Render the page.

    Args:
        captures: The photos.
        points: Points to start with, with the names of the photos (`tie_points.by_photo`); clicks
            in others are saved with them, and not shown.
        model: Folder of a COLMAP model of these photos, by which places are predicted.
        max_size: Pixels of the longer side of an embedded photo.
        title: Of the page.
        report: Called with the progress.

    Raises:
        SceneError: If the model is damaged, or has none of the photos.
    """
    found = None if model is None else read_model(model)
    posed = {} if found is None else {image.name: image for image in found.images}
    names = [c.name for c in captures]
    images = [posed.get(name) or posed.get(f"{name}.png") for name in plain_names(names)]
    if model is not None and not any(images):
        raise SceneError(
            model,
            expected=f"images such as {names[0]}",
            found=min(posed, default="none"),
            todo="give a model of these photos, such as OUT.work/model-joint of register",
        )
    photos = []
    for i, (capture, image) in enumerate(zip(captures, images, strict=True)):
        if report is not None:
            report("photos", i, len(captures))
        photos.append(_photo(capture, image, max_size))
    state = {"points": [] if points is None else _points(points)}
    data = {
        "photos": photos,
        "state": state,
        "depths": (1.0, 100.0) if found is None else _depths(found),
        "crs": points.crs.text if points is not None and points.crs is not None else "",
        "file": FILE,
        "key": hashlib.sha256(repr((title, names, state)).encode()).hexdigest()[:12],
    }
    return render_page("marking/page", title=title, file=FILE, data=data)


def _photo(capture: Capture, image: PosedImage | None, max_size: int) -> dict[str, Any]:
    from PIL import Image

    picture = Image.fromarray(load_photo(capture.path)[0])
    picture.thumbnail((max_size, max_size), Image.Resampling.LANCZOS)
    camera = None
    if image is not None and image.camera.model in (*PINHOLE_MODELS, *POLYNOMIAL_MODELS):
        # Other programs make models of photos that they have reduced.
        resized = resize_camera(image.camera, capture.width, capture.height)
        named = CAMERA_MODELS[resized.model].distortion
        values = dict(zip(named, resized.distortion, strict=True))
        K = resized.K
        camera = {
            "pose": image.cam_from_world[:3].tolist(),
            "intrinsics": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            "distortion": [values.get(name, 0.0) for name in DISTORTION],
        }
    return {
        "name": capture.name,
        "width": capture.width,
        "height": capture.height,
        "shown": picture.width,
        "src": data_uri(picture),
        "camera": camera,
    }


def _points(points: TiePoints) -> list[dict[str, Any]]:
    return [
        {
            "name": p.name,
            "role": p.role,
            "world": "" if p.world is None else " ".join(map(repr, p.world)),
            "sigma": "" if p.sigma is None else " ".join(map(repr, p.sigma)),
            "marks": {c.image: [c.x, c.y] for c in p.clicks},
        }
        for p in points.points
    ]


def _depths(model: Model) -> tuple[float, float]:
    """Distances from a camera between which points of a photo lie."""
    poses = np.stack([image.cam_from_world for image in model.images])
    points = model.points.xyz if len(model.points) else camera_centre(poses)
    depth = poses[:, 2, :3] @ points.T + poses[:, 2, 3:]
    near, far = np.quantile(depth[depth > 0], [0.05, 0.95]) if (depth > 0).any() else (1.0, 100.0)
    return float(DEPTHS[0] * near), float(DEPTHS[1] * far)
